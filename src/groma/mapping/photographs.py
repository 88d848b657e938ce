# SPDX-License-Identifier: BSD-3-Clause
"""The folder of photographs: which files there are, how they are read, whether they fit the model.

Pixels are taken as they are stored. An EXIF orientation is not applied, here as in COLMAP: the two must agree, and the
camera of a model has the size of the stored image.
"""

from __future__ import annotations

import hashlib
import math
import posixpath
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from groma._counted import counted, first_of
from groma._typing import FloatArray
from groma.bounded.images import decoded
from groma.bounded.names import IMAGES, UNREAD, VIDEOS, files_below, is_text, masks_among
from groma.bounded.text import shown
from groma.cameras import model as camera_model
from groma.errors import FileFormatError, GromaError, InputError
from groma.execution import map_work
from groma.features.images import GrayImage, smoothed, to_gray
from groma.gates import gate
from groma.io.colmap.files import is_model
from groma.scene import Scene


@dataclass(frozen=True)
class CopyGates:
    """When two images of different sizes are one photograph."""

    alike: float = gate(
        0.8, "share", "correlation of the curvature of grey levels",
        "chosen on 10 internet photographs in two sizes (0.98 and more; others 0.01); half a pixel leaves 0.8 to 0.95",
    )  # fmt: skip
    glance: int = gate(32, "px", "side of the images that are compared first", "cost: time")
    glance_alike: float = gate(
        0.9, "share", "their correlation, from which images are compared as a whole", "cost: time"
    )
    tries: int = gate(3, "images", "that one is compared with, the most alike first", "cost: time")


COPIES = CopyGates()
_START_OF_SCAN, _END_OF_IMAGE = b"\xff\xda", b"\xff\xd9"


def image_files(folder: Path) -> list[Path]:
    """Return the images in a folder and its sub-folders, sorted; hidden files and folders are skipped."""
    if not folder.is_dir():
        what = "is a file, not a folder of images" if folder.exists() else "is not a folder of images"
        video = folder.suffix.lower() in VIDEOS
        remedy = "Take pictures out of it, or follow it with groma track." if video else "Check the path."
        raise InputError(f"{folder} {what}. {remedy}")
    if folder.resolve() == folder.resolve().parent:
        raise InputError(
            f"{folder} is the whole disk, not a folder of images: every picture on it would be taken. Pass the folder "
            "that holds the photographs."
        )
    found = _with_endings(folder, IMAGES)
    masks = masks_among(found)
    files = [path for name, path in found.items() if name not in masks]
    if not files:
        if others := _with_endings(folder, UNREAD):
            raise InputError(f"{folder} holds {_of_unread_kind(others)}. Convert them to JPEG or PNG.")
        if is_model(folder):
            raise InputError(f"{folder} holds a model, but no images. Pass the folder of its photographs.")
        raise InputError(f"{folder} holds no images ({', '.join(IMAGES)}). Check the path.")
    wrong = next((name for name in found if not is_text(name)), None)
    if wrong is not None:
        raise InputError(
            f"The name of the image {shown(wrong)} cannot stand in a model: it must be UTF-8, in one line. Rename it."
        )
    return files


def _with_endings(folder: Path, endings: tuple[str, ...]) -> dict[str, Path]:
    """The files in a folder and below whose names end so, by name."""
    files = (path for path in files_below(folder) if path.name.lower().endswith(endings))
    return {path.relative_to(folder).as_posix(): path for path in files}


def _of_unread_kind(names: Collection[str]) -> str:
    return f"{counted(len(names), 'photographs')} of a kind that is not read: {first_of(list(names), 3)}"


def other_images(folder: Path, names: Sequence[str]) -> list[str]:
    """Say which files of a folder are photographs of a kind that is not read, and which are masks beside photographs.

    A raw file is none of them if the camera wrote a JPEG beside it.
    """
    read = {posixpath.splitext(name)[0] for name in names}
    alone = [name for name in _with_endings(folder, UNREAD) if posixpath.splitext(name)[0] not in read]
    masks = sorted(masks_among(_with_endings(folder, IMAGES)))
    of_masks = f"{counted(len(masks), 'images')} beside photographs are not mapped, but taken for their masks"
    return [
        *([f"{_of_unread_kind(alone)}. Convert them to JPEG or PNG."] if alone else []),
        *([f"{of_masks} ({first_of(masks, 3)}); --masks {folder} uses them."] if masks else []),
    ]


def content_digest(path: Path) -> str:
    """Return what tells the content of a photograph from that of any other."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def copies_among(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Return the images whose file is a copy of another's, by name, and that other, whose name is the shortest.

    A copy is no second measurement: its noise is that of the other, and it shows everything from the same place.
    """
    alike: defaultdict[int, list[str]] = defaultdict(list)
    for name in sorted(names, key=lambda name: (len(name), name)):
        with suppress(OSError):
            alike[(folder / name).stat().st_size].append(name)
    first: dict[str, str] = {}
    found = {}
    for name in (name for group in alike.values() if len(group) > 1 for name in group):
        with suppress(OSError):
            other = first.setdefault(content_digest(folder / name), name)
            if other != name:
                found[name] = other
    return found


def smaller_copies(folder: Path, sizes: Mapping[str, tuple[int, int]]) -> dict[str, str]:
    """Return the images that are another one in a smaller size, by name, and the largest of that picture.

    Made smaller, the larger one has the edges of the smaller where this has them, to a fraction of a pixel all over the
    image; a second photograph has not, however near it was taken. Copies of one size are not looked for: a camera that
    stood still cannot be told from them.

    Parameters
    ----------
    folder : Path
        The photographs.
    sizes : mapping
        Width and height by name.
    """
    names = sorted(sizes, key=lambda name: (-math.prod(sizes[name]), len(name), name))
    size, kind = np.unique(np.reshape([sizes[name] for name in names], (-1, 2)), axis=0, return_inverse=True)
    ratio, kind = size / size[:, None], kind.ravel()
    # derived from sizes that are whole pixels
    alike = (np.abs(ratio[..., 0] - ratio[..., 1]) <= (1.0 / size).sum(axis=1)[:, None]) & (ratio < 1.0).all(axis=2)
    rows = np.flatnonzero((alike.any(axis=0) | alike.any(axis=1))[kind])
    if not len(rows):
        return {}
    glance = np.zeros((len(names), COPIES.glance**2))
    for row, numbers in zip(rows, map_work(_glance, [folder / names[row] for row in rows]), strict=True):
        glance[row] = numbers
    found: dict[str, str] = {}
    for row in rows:
        likeness = np.where(alike[kind, kind[row]], glance @ glance[row], 0.0)
        for other in np.argsort(-likeness, kind="stable")[: COPIES.tries]:
            if likeness[other] < COPIES.glance_alike:
                break
            if names[other] not in found and _is_made_smaller(folder / names[other], folder / names[row]):
                found[names[row]] = names[other]
                break
    return found


def _glance(path: Path) -> FloatArray:
    """Return a photograph as a few numbers, without its mean and of length one."""
    levels = cv2.resize(read_gray(path), (COPIES.glance,) * 2, interpolation=cv2.INTER_AREA).astype(float).ravel()
    levels -= levels.mean()
    return levels / max(float(np.linalg.norm(levels)), 1e-12)


def _is_made_smaller(larger: Path, smaller: Path) -> bool:
    small = read_gray(smaller)
    made = np.asarray(cv2.resize(read_gray(larger), small.shape[::-1], interpolation=cv2.INTER_AREA), np.uint8)
    first, second = (cv2.Laplacian(smoothed(one), cv2.CV_32F).ravel() for one in (made, small))
    return bool(first @ second >= COPIES.alike * np.linalg.norm(first) * np.linalg.norm(second))


def image_reader(folder: Path, names: Sequence[str]) -> Callable[[int], GrayImage]:
    """Return what reads the images of some names by their number."""
    return partial(_read_by_number, folder, names)


def _read_by_number(folder: Path, names: Sequence[str], i: int) -> GrayImage:
    return read_gray(folder / names[i])


def read_gray(path: Path) -> GrayImage:
    """Read an image of any type as grey levels.

    Raises
    ------
    InputError
        If the file is missing, is no image, or ends too early.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror or error}. Check the file.") from error
    if content[:2] == b"\xff\xd8" and content.rfind(_END_OF_IMAGE) < content.rfind(_START_OF_SCAN):
        # Decoders fill missing parts with grey. An embedded preview has both markers, so the last ones count.
        raise InputError(f"{path} ends in the middle of the picture (JPEG without its end). Copy it again.")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = decoded(content, flags)
        if image is None:  # kinds that are not turned into grey while they are read: floating point TIFF
            image = decoded(content, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except FileFormatError as error:
        raise InputError(f"{path}: {error}") from error
    try:
        if image is not None:
            return to_gray(image)
    except GromaError:
        pass
    raise InputError(
        f"{path} cannot be read as an image: it is damaged or of an unknown kind. Replace it, or leave it out of the "
        "folder and the model."
    )


def check_names(folder: Path, names: Sequence[str], scene: Scene) -> None:
    """Check that every image of a model is among the files; if only the folder differs, name the right one."""
    again = next((name for name, number in Counter(scene.images.names).items() if number > 1), None)
    if again is not None:
        raise InputError(
            f"The model has more than one image named {again!r}; images are found by name. Rename or remove the others."
        )
    files = set(names)
    missing = [name for name in scene.images.names if name not in files]
    if not missing:
        return
    number = f"{len(missing):,} of the {scene.num_images:,} images of the model are not"
    if len(missing) == scene.num_images:
        number = f"None of the {scene.num_images:,} images of the model is"
    there = "there is 1 image," if len(names) == 1 else f"there are {len(names):,} images, for example"
    raise InputError(
        f"{number} in {folder}, for example {missing[0]!r}; {there} {names[0]!r}. "
        + _suggestion(folder, names, missing)
    )


def check_number(
    folder: Path, names: Sequence[str], copies: Collection[str], model: Scene | None, min_images: int
) -> None:
    """Check that there are images enough for a map, copies not counted, and all those of the model."""
    if model is None:
        if len(names) < 3:
            held = counted(len(names), "images") + (" and copies" if copies else "")
            raise InputError(f"{folder} holds {held}; a map needs at least 3 that overlap. Take more.")
        return
    if model.num_images < max(2, min_images):
        posed = counted(model.num_images, "images")
        raise InputError(
            f"The model has {posed} with a pose; a map needs at least {max(2, min_images)} that "
            "overlap. Pass a model with more, or none to have it made."
        )
    check_names(folder, names, model)


def check_cameras(models: Sequence[str]) -> None:
    """Check that a plane can hold the view of every camera, as photographs are placed by such images."""
    for name in models:
        if not camera_model(name).is_planar:
            raise InputError(
                f"groma localize places images that are flat, and {name} images are panoramas. Map perspective views "
                "of them that are held in a rig, as COLMAP's panorama_sfm.py cuts them."
            )


def checked_photographs(
    folder: Path,
    files: Sequence[Path],
    model: Scene | None,
    min_images: int,
    without_copies: bool,
    say: Callable[[str, int, int], None],
) -> tuple[dict[str, tuple[int, int]], dict[str, str]]:
    """Return the photographs to map, by name with width and height, and those left out as copies of others.

    Raises
    ------
    InputError
        If they are too few, cannot be read, or are not those of the model.
    """
    names = [path.relative_to(folder).as_posix() for path in files]
    copies = copies_among(folder, names) if without_copies else {}
    names = [name for name in names if name not in copies]
    check_number(folder, names, copies, model, min_images)
    sizes = check_images(folder, names, model, say)
    if without_copies:
        copies |= smaller_copies(folder, sizes)
        sizes = {name: size for name, size in sizes.items() if name not in copies}
        check_number(folder, list(sizes), copies, model, min_images)
    return sizes, copies


def photographs_left_out(
    folder: Path, files: Sequence[Path], copies: Mapping[str, str], used: Sequence[str], model_given: bool
) -> list[str]:
    """Say which photographs of a folder are not in a map, and why, a sentence for each reason."""
    names = [path.relative_to(folder).as_posix() for path in files]
    others = [] if model_given else other_images(folder, names)
    rest = [name for name in names if name not in copies]
    return [*others, *copies_left_out(copies, len(names)), *images_left_out(rest, used, model_given)]


def images_left_out(names: Sequence[str], used: Sequence[str], model_given: bool) -> list[str]:
    """Say which images of the folder have no pose, in at most one sentence."""
    left = sorted(set(names) - set(used))
    if not left:
        return []
    one = len(left) == 1
    why = f"{'has' if one else 'have'} no pose in the model" if model_given else "could not be placed"
    remedy = " They share too few points with the others: take images between them, or pass a --model."
    return [
        f"{len(left)} of {len(names)} images {why} and {'was' if one else 'were'} not used: {first_of(left, 3)}."
        + ("" if model_given else remedy)
    ]


def copies_left_out(copies: Mapping[str, str], count: int) -> list[str]:
    """Say which of some images are copies of others (:func:`copies_among`), in at most one sentence."""
    if not copies:
        return []
    pairs = first_of([f"{name} of {other}" for name, other in sorted(copies.items())], 3)
    which = "is a copy of another and was" if len(copies) == 1 else "are copies of others and were"
    return [f"{len(copies)} of {count} images {which} not used: {pairs}."]


def _suggestion(folder: Path, names: Sequence[str], missing: list[str]) -> str:
    """What to do about image names that are not there."""
    by_end = {posixpath.basename(name): name for name in names}
    found = [(name, by_end[posixpath.basename(name)]) for name in missing if posixpath.basename(name) in by_end]
    for wanted, there in found:
        if there.endswith(f"/{wanted}"):
            return f"Pass the folder {folder / there[: -len(wanted) - 1]}."
        if wanted.endswith(f"/{there}"):
            above = wanted[: -len(there) - 1]
            if folder.absolute().as_posix().endswith(f"/{above}"):
                return f"Pass the folder {Path(folder.absolute().as_posix()[: -len(above) - 1])}."
            return f"The model's names begin with {above!r}: move the images to such a folder, and pass its parent."
    by_case = {name.lower(): name for name in names}
    by_stem = {posixpath.splitext(name)[0]: name for name in names}
    for wanted in missing:
        if wanted.lower() in by_case:
            return f"They differ in upper and lower case ({by_case[wanted.lower()]!r}); rename the files."
        stem = posixpath.splitext(wanted)[0]
        if stem in by_stem:
            return f"There is {by_stem[stem]!r}, of another kind; convert the images, or pass the original ones."
    return "Pass the folder the model was made from; names must match."


def check_images(
    folder: Path, names: Sequence[str], model: Scene | None, say: Callable[[str, int, int], None]
) -> dict[str, tuple[int, int]]:
    """Check that every image of the model, or of the folder, can be read, and has the size of its camera.

    Returns
    -------
    dict
        Width and height of the images by name.
    """
    sizes = {} if model is None else _sizes(model)
    used = names if model is None else model.images.names
    work = [(folder / name, sizes.get(name, (0, 0))) for name in used]
    found = dict(zip(used, map_work(_check_image, work, partial(say, "checking images")), strict=True))
    wrong = {name: said for name, said in found.items() if isinstance(said, str)}
    if wrong:
        first, *others = wrong
        more = f" Of {len(used):,} images {len(others):,} more cannot be used: {first_of(others, 9)}." if others else ""
        raise InputError(wrong[first] + more)
    return {name: size for name, size in found.items() if not isinstance(size, str)}


def _check_image(image: tuple[Path, tuple[int, int]]) -> tuple[int, int] | str:
    """Return the size of an image; if it cannot be read or is not that of its camera, where known, say so."""
    path, size = image
    try:
        height, width = read_gray(path).shape
    except InputError as error:
        return str(error)
    if size in ((0, 0), (width, height)):
        return width, height
    remedy = "Pass the images the model was made from."
    if size == (height, width):
        remedy = "It is turned by 90 degrees: pass the images as they were stored when the model was made."
    return f"{path} has {width}x{height} pixels, its camera {size[0]}x{size[1]}. {remedy}"


def _sizes(model: Scene) -> dict[str, tuple[int, int]]:
    """Width and height of the camera of every image."""
    cameras = model.cameras
    of_camera = list(zip(cameras.width.tolist(), cameras.height.tolist(), strict=True))
    return {name: of_camera[camera] for name, camera in zip(model.images.names, model.images.camera_idx, strict=True)}
