# SPDX-License-Identifier: BSD-3-Clause
"""A first model of points and poses from photographs alone, by pycolmap: SIFT, matching, incremental mapping.

Features and matches are kept in a database, so that a killed run resumes in the middle of either. pycolmap gets small
batches, for progress, Ctrl-C and resuming.

The result does not depend on how threads take turns: images and cameras are entered in the order of their names before
anything runs in parallel, and every source of random numbers is seeded.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from groma import cameras as camera_models
from groma._counted import counted, first_of
from groma.errors import GromaError, InputError, OutputError, did_you_mean
from groma.io.colmap.large_photographs import features_of_large
from groma.io.colmap.load import find_sift, load_pycolmap, opened, quiet
from groma.io.colmap.mappers import MAPPERS, Task
from groma.io.colmap.masks import Masks
from groma.io.colmap.model import from_pycolmap
from groma.io.colmap.pairs import EXHAUSTIVE_LIMIT, OVERLAP, blocks_of_pairs, places_by_gps
from groma.io.colmap.rigs import RigDescription, by_frames, camera_of, check_rigs, map_frames
from groma.scene import Scene

#: Bytes that must be free before work is handed to pycolmap, whose threads end the process where they find a full disk:
#: in any case, for the features of an image, for the matches of a pair (cost: disk space).
_ROOM, _IMAGE_ROOM, _PAIR_ROOM = 8 << 20, 4 << 20, 1 << 18
#: Matches per image from which a failure is not one of overlap or texture (convention: a word in a message).
FEW_MATCHES = 100
#: Field of view of a fisheye of unknown focal length, radians over the diagonal (convention: full-frame fisheyes).
_FISHEYE_VIEW = math.pi
#: Images that a model needs.
_LEAST_IMAGES = 3

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class PointModelOptions:
    """Options of :func:`reconstruct_points`."""

    #: A camera model that COLMAP and groma share; its distortion is estimated.
    camera_model: str = "SIMPLE_RADIAL"
    #: Parameters of the camera, in the model's order, if they are known: they are then kept.
    camera_params: tuple[float, ...] | None = None
    #: Seed of the random numbers of matching and mapping.
    seed: int = 0
    #: Most threads of pycolmap; None: as many as there are processors.
    threads: int | None = None
    #: Mapper: ``incremental`` or ``global``.
    mapper: str = "incremental"
    #: Which images were taken at the same moment by cameras fixed to each other; none: every image stands alone.
    rigs: tuple[RigDescription, ...] = ()
    #: Estimate the poses of the cameras on their rig; otherwise they are held.
    refine_rigs: bool = False
    #: What may be used of the images; None: all.
    masks: Masks | None = None

    def __post_init__(self) -> None:
        if self.mapper not in MAPPERS:
            raise InputError(
                f"The mapper must be one of {', '.join(MAPPERS)}; got {self.mapper!r}."
                + did_you_mean(self.mapper, MAPPERS)
            )
        known = {model.name: model for model in camera_models.models() if model.colmap_name is not None}
        model = known.get(self.camera_model)
        if model is None:
            raise InputError(
                f"The camera model must be one of {', '.join(known)}; got {self.camera_model!r}."
                + did_you_mean(self.camera_model, known)
            )
        given = self.camera_params
        if given is not None and len(given) != model.num_parameters:
            raise InputError(
                f"Camera model {model.name} has {model.num_parameters} parameters "
                f"({', '.join(model.parameter_names)}); got {len(given)}. Pass them in this order."
            )
        if given is not None and not (all(map(math.isfinite, given)) and given[0] > 0):
            raise InputError(
                f"The camera parameters ({', '.join(model.parameter_names)}) must be numbers, the focal length "
                f"positive; got {', '.join(f'{value:g}' for value in given)}."
            )

    @property
    def is_calibrated(self) -> bool:
        """Whether the calibration of all cameras is known, and kept."""
        return bool(self._calibrated) and all(self._calibrated)

    @property
    def is_partly_calibrated(self) -> bool:
        """Whether the calibration of some camera is known, and kept."""
        return any(self._calibrated)

    @property
    def _calibrated(self) -> list[bool]:
        if self.camera_params is not None:
            return [True]
        return [camera.camera_params is not None for rig in self.rigs for camera in rig.cameras]


def reconstruct_points(
    images: str | os.PathLike[str],
    work: str | os.PathLike[str],
    names: Sequence[str],
    options: PointModelOptions | None = None,
    progress: Progress | None = None,
) -> Scene:
    """Reconstruct poses and points from photographs.

    Images of the same size and the same EXIF camera share one camera. The EXIF orientation is not applied: pixels are
    taken as they are stored.

    Parameters
    ----------
    images : path
        Folder of photographs.
    work : path
        Folder for the database; finished work in it is not repeated.
    names : sequence of str
        The images, by their names in the folder.
    options : PointModelOptions, optional
        Camera model, seed, threads.
    progress : callable, optional
        Called with the name of a stage, the number of parts done, and their total.

    Returns
    -------
    Scene
        The model with most images. Images that could not be placed are not in it.

    Raises
    ------
    InputError
        If no model comes out: too few images, no overlap, or no texture.
    OutputError
        If there is no room in ``work``, or pycolmap fails otherwise.
    """
    pycolmap = load_pycolmap()
    options = options or PointModelOptions()
    say = progress or (lambda stage, done, total: None)
    folder, names = Path(work), sorted(names)
    check_rigs(options.rigs, names)
    database = folder / "database.db"
    pycolmap.set_random_seed(options.seed)
    with quiet(pycolmap), explained(folder):
        folder.mkdir(parents=True, exist_ok=True)
        check_room(folder)
        _enter_images(pycolmap, database, Path(images), names, options)
        _expect_fisheyes(pycolmap, database)
        find_features(pycolmap, database, Path(images), names, options, say)
        with opened(pycolmap, database) as content:
            ordered = by_frames(options.rigs, names)
            places = places_by_gps(content, ordered)
        match_pairs(pycolmap, database, ordered, blocks_of_pairs(len(names), places), options, say)
        check_room(folder)
        models = map_frames(
            pycolmap,
            database,
            options.rigs,
            lambda content: MAPPERS[options.mapper](
                Task(pycolmap, content, Path(images), folder, len(names), options), say
            ),
        )
    if not models:
        with opened(pycolmap, database) as content:
            features, matches = content.num_keypoints(), content.num_inlier_matches()
            linked = _most_linked(pycolmap, content)
        raise InputError(
            f"No reconstruction came out of the {counted(len(names), 'images')} in {images}: {features:,} points "
            f"were found in them and {matches:,} matches between them. "
            f"{_why_none(features, matches, len(names), linked)} "
            "Take more images with more overlap, from places some steps apart, or pass a model with --model."
        )
    # Of equally many images the one with more points, so that the choice does not depend on an order.
    return from_pycolmap(max(models, key=lambda model: (model.num_reg_images(), model.num_points3D())))


def _most_linked(pycolmap: Any, content: Any) -> int:
    """Return how many images the largest group holds that pairs of many matches link."""
    pairs, matches = content.read_two_view_geometry_num_inliers()
    group = {image.image_id: {image.image_id} for image in content.read_all_images()}
    for pair, shared in zip(pairs, matches, strict=True):
        one, other = (group[number] for number in pycolmap.pair_id_to_image_pair(pair))
        if shared >= FEW_MATCHES and one is not other:
            one |= other
            group.update(dict.fromkeys(other, one))
    return max(map(len, group.values()), default=0)


def _why_none(features: int, matches: int, count: int, linked: int) -> str:
    """Return the probable reason that nothing was reconstructed."""
    if features == 0:
        return "They show no texture."
    if matches < FEW_MATCHES * count:
        return "They overlap too little, or show too little texture."
    if linked < _LEAST_IMAGES:
        return (
            f"No {_LEAST_IMAGES} of them are linked by pairs with {FEW_MATCHES} matches and more: they overlap too "
            "little, or were taken from too different directions."
        )
    return "They match, but no two show depth: the camera only turned, or moved too little for its distance."


# ------------------------------------------------------------------------------------------------------------ stages


def _enter_images(pycolmap: Any, database: Path, images: Path, names: list[str], options: PointModelOptions) -> None:
    """Enter cameras and images in order, so that their identifiers do not depend on threads."""
    try:
        with opened(pycolmap, database) as content:
            if content.num_images() == len(names):
                return
            content.clear_all_tables()  # a run was killed here
    except RuntimeError:  # damaged: start again
        for path in database.parent.glob(f"{database.name}*"):
            path.unlink()
        with opened(pycolmap, database):
            pass
    groups: dict[tuple[Any, ...], list[str]] = {}
    unread = []
    for name in names:
        bitmap = pycolmap.Bitmap.read(str(images / name), False)
        if bitmap is None:
            unread.append(name)
            continue
        key = (bitmap.width, bitmap.height, bitmap.exif_camera_model(), camera_of(options.rigs, name))
        groups.setdefault(key, []).append(name)
    if unread:
        raise InputError(
            f"pycolmap, which finds the points, cannot read {counted(len(unread), 'images')} in {images}: "
            f"{first_of(unread, 9)}. Convert to JPEG or PNG."
        )
    if options.camera_params is not None and len({key[:3] for key in groups}) > 1:
        sizes = ", ".join(sorted({f"{key[0]}x{key[1]}" for key in groups}))
        raise InputError(
            f"One set of camera parameters was given, but the images come from {len(groups)} cameras ({sizes}). "
            "Leave the parameters out, or map the images of one camera."
        )
    for (*_, mounted), members in groups.items():
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model = camera_models.model(options.camera_model).colmap_name
        params = options.camera_params
        if mounted is not None and mounted.camera_params is not None:
            reader.camera_model, params = mounted.camera_model, mounted.camera_params
        reader.camera_params = "" if params is None else ",".join(repr(float(value)) for value in params)
        pycolmap.import_images(database, images, pycolmap.CameraMode.SINGLE, members, reader)


def _expect_fisheyes(pycolmap: Any, database: Path) -> None:
    """Give fisheyes of unknown focal length the one that spans :data:`_FISHEYE_VIEW` over the diagonal.

    Without calibration pycolmap relates two images by a fundamental matrix, which fisheyes lack, and finds no pair.
    """
    with opened(pycolmap, database) as content:
        for camera in content.read_all_cameras():
            if camera.is_perspective_fisheye() and not camera.has_prior_focal_length:
                params = camera.params
                params[camera.focal_length_idxs()] = math.hypot(camera.width, camera.height) / _FISHEYE_VIEW
                camera.params, camera.has_prior_focal_length = params, True
                content.update_camera(camera)


def find_features(
    pycolmap: Any, database: Path, images: Path, names: list[str], options: PointModelOptions, say: Progress
) -> None:
    """Find the features of the images that have none yet, as far as their masks allow."""
    with opened(pycolmap, database) as content:
        entered = content.read_all_images()
        done = {image.name for image in entered if content.exists_descriptors(image.image_id)}
        cameras = {camera.camera_id: (camera.width, camera.height) for camera in content.read_all_cameras()}
    size_of = {image.name: cameras[image.camera_id] for image in entered}
    missing = [name for name in names if name not in done]
    extraction, reader = pycolmap.FeatureExtractionOptions(), pycolmap.ImageReaderOptions()
    masks = options.masks
    if masks is not None:
        reader.mask_path = database.with_name("masks")
    extraction.num_threads = options.threads or -1
    batch = options.threads or os.cpu_count() or 1
    for start in range(0, len(missing), batch):
        say("finding points in images", len(names) - len(missing) + start, len(names))
        wanted = missing[start : start + batch]
        check_room(database.parent, 2 * len(wanted) * _IMAGE_ROOM)  # large ones are in two databases for a moment
        if masks is not None:
            for name in wanted:
                masks.write(reader.mask_path, name, size_of[name])
        wanted = features_of_large(pycolmap, database, images, wanted, extraction, reader)
        if wanted:
            find_sift(pycolmap, database, images, wanted, extraction, reader)


def match_pairs(
    pycolmap: Any,
    database: Path,
    names: list[str],
    blocks: list[list[tuple[int, int]]],
    options: PointModelOptions,
    say: Progress,
) -> None:
    """Match pairs of images, which come in blocks of few images each."""
    matching, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    matching.num_threads = options.threads or -1
    verification.ransac.random_seed = options.seed
    common = {"matching_options": matching, "verification_options": verification, "device": pycolmap.Device.cpu}
    total = sum(map(len, blocks))
    if any(name.split() != [name] for name in names):
        # Lists of pairs are split at white space; these calls need no list, but report no progress.
        say("matching points of image pairs", 0, total)
        check_room(database.parent, total * _PAIR_ROOM)
        if len(names) <= EXHAUSTIVE_LIMIT:
            pycolmap.match_exhaustive(database, **common)
        else:
            pairing = pycolmap.SequentialPairingOptions()
            pairing.overlap = OVERLAP
            pycolmap.match_sequential(database, pairing_options=pairing, **common)
        return
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = database.with_name("pairs.txt")
    done = 0
    for block in blocks:
        say("matching points of image pairs", done, total)
        check_room(database.parent, len(block) * _PAIR_ROOM)
        done += len(block)
        lines = "".join(f"{names[i]} {names[j]}\n" for i, j in block)
        pairing.match_list_path.write_text(lines, encoding="utf-8")
        pycolmap.match_image_pairs(database, pairing_options=pairing, **common)


# ----------------------------------------------------------------------------------------------------------- helpers


def check_room(folder: Path, more: int = 0) -> None:
    """Raise OutputError if the disk may be too full."""
    free, needed = shutil.disk_usage(folder).free, _ROOM + more
    if free < needed:
        raise OutputError(
            f"The disk of {folder} has {free >> 20} MiB left; the points of the images need {-(-needed >> 20)} MiB. "
            "Make room there; the same command then goes on."
        )
    if hasattr(os, "posix_fallocate"):  # respects quotas and limits
        with tempfile.TemporaryFile(dir=folder) as probe:
            try:
                os.posix_fallocate(probe.fileno(), 0, needed)
            except OSError as error:
                if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
                    raise


@contextmanager
def explained(folder: Path) -> Iterator[None]:
    """Turn what pycolmap and the file system raise into errors of groma."""
    try:
        yield
    except GromaError:
        raise
    except (OSError, RuntimeError, ValueError) as error:
        reason = getattr(error, "strerror", None) or str(error).strip() or type(error).__name__
        raise OutputError(
            f"The points of the images cannot be reconstructed in {folder}: {reason.rstrip('.')}. See that there is "
            "room and you may write there; the same command then goes on. If it fails again, remove that folder."
        ) from error
