# SPDX-License-Identifier: BSD-3-Clause
"""What of a map is needed to find photographs in it: built once, kept in a file beside the map.

For each image of the map: descriptors of the points that have a place in the world, descriptors of the segments that
show lines of the map, and one descriptor of the whole image. For each point and line: its covariance.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.fit import noise_of
from groma.bounded.arrays import form, opened_arrays
from groma.errors import GromaError, InputError, OutputError
from groma.execution import map_work
from groma.features.matching.descriptor import describe
from groma.features.segments import Segments
from groma.geometry import se3
from groma.io import atomic_output
from groma.localization.errors.common_errors import CommonErrors, Responses, common_errors
from groma.localization.errors.map_errors import SeenByImage, images_compared, shared_errors
from groma.localization.features import Bytes, DescribedPoints, describe_places, find_points
from groma.localization.matching import lengths_of
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.matches import Matches
from groma.localization.pose.records import landmark_covariances, residual_squares
from groma.localization.repeated import Described, most_alike, telling_points
from groma.localization.retrieval import VladRetrieval
from groma.localization.triangulation import triangulate_features
from groma.mapping.lines.neighbors import covisible_neighbors
from groma.mapping.photographs import read_gray
from groma.mapping.shown import check_points_shown
from groma.scene import PointObservations, Points, Scene

#: Of the format of the file; another one is built anew.
_VERSION = 8
#: Images that the features of an image are matched with (cost: time).
_NEIGHBORS = 12

#: What a damaged file of arrays raises.
UNREADABLE = (OSError, KeyError, ValueError, zipfile.BadZipFile, GromaError)

#: What each array of the file is.
_FORMS = {
    "xyz": form("f", None, 3), "point_covariance": form("f", None, 3, 3), "line_covariance": form("f", None, 6, 6),
    **dict.fromkeys(("begin", "point", "segment_begin", "segment"), form("iu", None)),
    "pixel": form("f", None, 2), "descriptor": form("u", None, 128), "segment_descriptor": form("f", None, 72),
    "vocabulary": form("f", None, 128), "image": form("f", None, None),
    **dict.fromkeys(("within", "telling"), form("f", None)),
    "shared_error": form("f", 2), "common": form("f", None, None),
    "point_seen": form("iu", None, 3), "point_motion": form("f", None, 3, None),
    "line_seen": form("iu", None, 3), "line_motion": form("f", None, 6, None),
}  # fmt: skip

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class MapIndex:
    """Described points, lines and images of a map."""

    #: (P, 3) places of points in the world, (P, 3, 3) their covariances.
    xyz: FloatArray
    point_covariance: FloatArray
    #: (I + 1,) where the features of each image begin; (F,) their points, (F, 2) pixels, (F, 128) descriptors.
    begin: IntArray
    point: IntArray
    pixel: FloatArray
    descriptor: Bytes
    #: (L, 6, 6) covariances of (moment, direction) of the lines of the map; NaN for those that are not determined.
    line_covariance: FloatArray
    #: (I + 1,) where the segments of each image begin; (S,) rows of the map's line observations, (S, 72) descriptors.
    segment_begin: IntArray
    segment: IntArray
    segment_descriptor: npt.NDArray[np.float32]
    #: (K, 128) words, (I, K * 128) descriptions of images.
    vocabulary: npt.NDArray[np.float32]
    image: npt.NDArray[np.float32]
    #: (2,) what landmarks in one part of an image are off by together, radians as seen from it: where poses come from
    #: points alone, and from points and lines.
    shared_error: FloatArray = field(default_factory=lambda: np.zeros(2))
    #: (P,) how far the descriptor of a view that shows a point, and no other place, is from its own; and the share of
    #: its views that are so near, zero where it does not tell places apart.
    within: FloatArray = field(default_factory=lambda: np.zeros(0))
    telling: FloatArray = field(default_factory=lambda: np.zeros(0))
    #: (n, n) covariance of the poses and calibrations of the map; none where they are exact, or not determined. For
    #: each observation of points and of lines: landmark, frame and camera (., 3), and how the landmark follows these.
    common: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    point_seen: IntArray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    point_motion: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 3, 6), np.float32))
    line_seen: IntArray = field(default_factory=lambda: np.zeros((0, 3), np.int64))
    line_motion: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 6, 6), np.float32))

    @cached_property
    def length(self) -> FloatArray:
        """(F,) lengths of the descriptors."""
        return lengths_of(self.descriptor)

    @cached_property
    def views(self) -> tuple[IntArray, IntArray]:
        """(F,) rows of the views in the order of the points, and (P + 1,) where those of each point begin."""
        return np.argsort(self.point, kind="stable"), np.searchsorted(np.sort(self.point), np.arange(len(self.xyz) + 1))

    def common_errors(self, scene: Scene) -> CommonErrors | None:
        """Return the errors of poses and calibrations of the map; None where nothing is told of them."""
        if not len(self.common):
            return None
        points, lines = Responses(self.point_seen, self.point_motion), Responses(self.line_seen, self.line_motion)
        return CommonErrors(self.common, scene.num_frames, points, lines)

    @property
    def is_whole(self) -> bool:
        """Whether the arrays fit each other; those of a damaged file need not."""
        count, images = len(self.point), len(self.begin) - 1
        told = (
            self.xyz, self.pixel, self.segment_descriptor, self.vocabulary, self.image, self.shared_error, self.common,
            self.point_motion, self.line_motion,
        )  # fmt: skip
        return (
            len(self.pixel) == len(self.descriptor) == count
            and len(self.segment_descriptor) == len(self.segment)
            and len(self.point_covariance) == len(self.within) == len(self.telling) == len(self.xyz)
            and len(self.segment_begin) - 1 == len(self.image) == images
            and self.image.shape[1] == 128 * len(self.vocabulary)
            and _divides(self.begin, count)
            and _divides(self.segment_begin, len(self.segment))
            and bool(((self.point >= 0) & (self.point < len(self.xyz))).all())
            and bool((self.segment >= 0).all() and (self.shared_error >= 0.0).all())
            and self.common.shape[0] == self.common.shape[1]
            and self.point_motion.shape[2] == self.line_motion.shape[2] >= 6
            and _fit(self.point_seen, self.point_motion, len(self.xyz))
            and _fit(self.line_seen, self.line_motion, len(self.line_covariance))
            and all(np.isfinite(part).all() for part in told)
        )

    def is_of(self, scene: Scene) -> bool:
        """Whether the index can be one of a map."""
        counts = len(self.begin) - 1 == scene.num_images and len(self.line_covariance) == scene.num_lines
        inside = (self.segment < len(scene.line_observations)).all() and len(self.xyz) >= scene.num_points
        sizes = np.array([scene.num_frames, len(scene.cameras)])
        told = len(self.common) in (0, sizes @ [6, self.point_motion.shape[2] - 6])
        views = all((seen[:, 1:] < sizes).all() for seen in (self.point_seen, self.line_seen))
        return bool(counts and inside and told and views)

    def write(self, path: Path, digest: str, folder: Path) -> None:
        """Write the index whole or not at all; ``digest`` is that of the map, ``folder`` holds its photographs."""
        arrays = {item.name: getattr(self, item.name) for item in fields(self)}
        with atomic_output(path, force=True) as draft, draft.open("wb") as file:
            np.savez(file, digest=np.array(digest), folder=np.array(str(folder)), **arrays)


def read_index(path: Path, digest: str) -> MapIndex | None:
    """Read an index; None where there is none, where it is damaged, and where it belongs to another map."""
    try:
        with opened_arrays(path) as members:
            if str(members.read("digest", form("U"))) != digest:
                return None
            found = MapIndex(**{name: members.read(name, check) for name, check in _FORMS.items()})
    except UNREADABLE:
        return None
    return found if found.is_whole else None


def _fit(seen: IntArray, motion: npt.NDArray[np.float32], count: int) -> bool:
    """Whether rows are of so many landmarks, in their order."""
    landmark = seen[:, 0]
    inside = len(seen) == len(motion) and (seen >= 0).all() and (landmark < count).all()
    return bool(inside and (np.diff(landmark.astype(np.int64)) >= 0).all())


def _divides(begin: IntArray, count: int) -> bool:
    """Whether rows from each begin to the next are all rows, in order."""
    return bool(len(begin) and begin[0] == 0 and begin[-1] == count and (np.diff(begin) >= 0).all())


def images_told(path: Path) -> Path | None:
    """Return the folder of photographs that an index tells, if it is there."""
    try:
        with opened_arrays(path) as members:
            folder = Path(str(members.read("folder", form("U"))))
            return folder if folder.is_dir() else None
    except UNREADABLE:
        return None


def digest_of(scene: Scene, files: Sequence[Path]) -> str:
    """Return a number that changes with the map, and with the files of its images."""
    told = hashlib.sha256(str(_VERSION).encode())
    for name, file in zip(scene.images.names, files, strict=True):
        told.update(f"{name} {file.stat().st_size}".encode())
    for array in (
        scene.cam_from_world, scene.cameras.params, scene.points.xyz, scene.lines.plucker,
        scene.line_observations.segment, scene.point_observations.pixel,
    ):  # fmt: skip
        told.update(np.ascontiguousarray(array).tobytes())
    return told.hexdigest()


def build_index(
    scene: Scene, files: Sequence[Path], say: Progress, estimated: tuple[bool, bool] = (True, True)
) -> MapIndex:
    """Describe a map; ``estimated`` says whether its poses and its calibrations were, or were held.

    Raises
    ------
    InputError
        If an image of the map cannot be read, or none of its points can be described, or images do not show them.
    """
    check_points_shown(scene, files)
    work = [(file, *_seen_in(scene, image)) for image, file in enumerate(files)]
    found = map_work(_describe_image, work, partial(say, "describing the images of the map"))
    neighbors = covisible_neighbors(scene, _NEIGHBORS)
    pairs = [(min(i, j), max(i, j)) for i, row in enumerate(neighbors) for j in row.tolist()]
    pairs = np.unique(np.array(pairs, np.int64).reshape(-1, 2), axis=0)
    features = [one.features for one in found]
    made = triangulate_features(scene, features, pairs, partial(say, "placing the points of the map"))
    own_covariance, own_noise = _covariances(scene, "points")
    line_covariance, line_noise = _covariances(scene, "lines")
    rows, offset = [], pointers_of([len(one) for one in features])
    known = np.isfinite(own_covariance[:, 0, 0])
    points, pixels, descriptors, sigmas = [], [], [], []
    for image, one in enumerate(found):
        point = made.point[offset[image] : offset[image + 1]]
        placed, own = point >= 0, known[one.point]
        points.append(np.concatenate([point[placed], one.point[own] + len(made.xyz)]))
        pixels.append(np.concatenate([one.features.pixels[placed], one.own.pixels[own]]))
        descriptors.append(np.concatenate([one.features.descriptors[placed], one.own.descriptors[own]]))
        sigmas.append(np.concatenate([made.noise * one.features.sigma[placed], own_noise * one.own_sigma[own]]))
        rows.append(one.segment)
    if not sum(map(len, points)) and not scene.num_lines:
        raise InputError("Nothing in the images of the map can be described: no points, no lines. Pass another map.")
    retrieval = VladRetrieval.learned([one.descriptors for one in features])
    begin, point = pointers_of([len(part) for part in points]), np.concatenate(points)
    described = Described(point, np.concatenate(pixels), np.concatenate(descriptors), point >= len(made.xyz))
    xyz = np.concatenate([made.xyz, scene.points.xyz])
    images = np.stack([retrieval.gather(one.descriptors) for one in features])

    def seen_at(image: int, point: IntArray) -> FloatArray:
        camera = QueryCamera.of(scene.cameras, int(scene.images.camera_idx[image]))
        return camera.project(scene.cam_from_world[image], xyz[point])

    within, telling = telling_points(described, begin, _longer_sides(scene), most_alike(images), seen_at, len(xyz))
    index = MapIndex(
        xyz,
        np.concatenate([made.covariance, np.nan_to_num(own_covariance)]),
        begin,
        *described[:3],
        line_covariance,
        pointers_of([len(part) for part in rows]),
        np.concatenate(rows),
        np.concatenate([one.segment_descriptors for one in found]),
        retrieval.vocabulary,
        images,
        within=within,
        telling=telling,
    )
    sigma = np.concatenate(sigmas)
    index, difference = _with_common_errors(scene, index, sigma, (own_noise, line_noise), estimated)
    compared = images_compared(scene.num_images).tolist()
    seen = [_seen_by(scene, index, image, sigma, line_noise, difference[image]) for image in compared]
    return replace(index, shared_error=shared_errors(seen, partial(say, "comparing images of the map with the rest")))


def _with_common_errors(
    scene: Scene, index: MapIndex, sigma: FloatArray, noise: tuple[float, float], estimated: tuple[bool, bool]
) -> tuple[MapIndex, FloatArray]:
    """The index with what is known of errors of poses and calibrations; and (I, 6, 6) by how much more than landmarks
    make them the poses of its images differ from held ones.
    """
    image = np.repeat(np.arange(scene.num_images), np.diff(index.begin))
    described = scene.keep(points=[], lines=[], planes=[], directions=[]).replace(
        points=Points.at(index.xyz),
        point_observations=PointObservations.numbered(image, index.point, index.pixel, sigma),
    )
    found, by_frame = common_errors(scene, described, noise, estimated)
    turned = se3.adjoint(scene.sensors.cam_from_rig[scene.images.sensor_idx])
    difference = turned @ by_frame[scene.images.frame_idx] @ np.swapaxes(turned, 1, 2)
    if found is None:
        return index, difference
    points, lines = found.points, found.lines
    told = replace(
        index, common=found.covariance, point_seen=points.seen, point_motion=points.motion, line_seen=lines.seen,
        line_motion=lines.motion,
    )  # fmt: skip
    return told, difference


def _longer_sides(scene: Scene) -> FloatArray:
    """Longer side of each image, pixels."""
    return np.maximum(scene.cameras.width, scene.cameras.height)[scene.images.camera_idx].astype(np.float64)


def _seen_by(
    scene: Scene, index: MapIndex, image: int, sigma: FloatArray, line_noise: float, difference: FloatArray
) -> SeenByImage:
    """What an image sees of a described map, with the noise (pixels) that landmarks were estimated with."""
    own = slice(index.begin[image], index.begin[image + 1])
    point, table = index.point[own], scene.line_observations
    rows = np.flatnonzero(table.image_idx == image)
    rows = rows[np.isfinite(index.line_covariance[table.line_idx[rows], 0, 0])]
    line = table.line_idx[rows]
    matches = Matches(
        index.pixel[own], index.xyz[point], table.segment[rows].reshape(-1, 2, 2), scene.lines.segments[line],
        sigma[own], line_noise * table.sigma[rows], index.point_covariance[point], index.line_covariance[line],
    )  # fmt: skip
    camera = QueryCamera.of(scene.cameras, int(scene.images.camera_idx[image]))
    return SeenByImage(camera, matches, scene.cam_from_world[image], difference)


@dataclass(frozen=True, eq=False)
class _ImageOfMap:
    """What is described in one image of a map."""

    features: DescribedPoints
    #: Places of points of the map, which, and their standard deviations in the map, pixels.
    own: DescribedPoints
    point: IntArray
    own_sigma: FloatArray
    #: Rows of line observations, and their descriptors.
    segment: IntArray
    segment_descriptors: npt.NDArray[np.float32]


def _seen_in(scene: Scene, image: int) -> tuple[FloatArray, IntArray, FloatArray, FloatArray, IntArray]:
    """What an image sees of the map: pixels, numbers and deviations of points; ends and rows of segments."""
    points, lines = scene.point_observations, scene.line_observations
    rows, segments = np.flatnonzero(points.image_idx == image), np.flatnonzero(lines.image_idx == image)
    return points.pixel[rows], points.point_idx[rows], points.sigma[rows], lines.segment[segments], segments


def _describe_image(work: tuple[Path, FloatArray, IntArray, FloatArray, FloatArray, IntArray]) -> _ImageOfMap:
    path, pixels, points, sigma, ends, rows = work
    image = read_gray(path)
    own, kept = describe_places(image, pixels)
    descriptors = describe(image, Segments.from_ends(ends)).astype(np.float32)
    return _ImageOfMap(find_points(image), own, points[kept], sigma[kept], rows, descriptors)


def _covariances(scene: Scene, kind: str) -> tuple[FloatArray, float]:
    """Covariances of the points or lines of a map with its poses held, and the noise that its residuals show."""
    count = len(getattr(scene, kind))
    other = {"points": "lines", "lines": "points"}[kind]
    alone = scene.keep(**{other: []}, planes=[], directions=[])
    table = alone.point_observations if kind == "points" else alone.line_observations
    if not count or not len(table):
        return np.full((count, 6, 6) if kind == "lines" else (count, 3, 3), np.nan), 1.0
    problem = assemble(alone, AssemblyOptions(refine_poses=False, point_chart="euclidean", gauge="free")).problem
    noise = noise_of(residual_squares(problem, kind, len(table)))
    return landmark_covariances(problem, kind, count) * noise**2, noise


def kept_index(
    scene: Scene, files: Sequence[Path], path: Path | None, say: Progress, estimated: tuple[bool, bool] = (True, True)
) -> tuple[MapIndex, str]:
    """Return the index of a map, from its file or built and kept there; and a sentence if it cannot be kept."""
    if path is None:
        return build_index(scene, files, say, estimated), ""
    digest = f"{digest_of(scene, files)} {estimated}"
    index = read_index(path, digest)
    if index is not None and index.is_of(scene):
        return index, ""
    index = build_index(scene, files, say, estimated)
    try:
        index.write(path, digest, _common_folder(scene, files))
    except OutputError as error:
        return index, f"The index of the map cannot be written and will be computed again: {error}"
    return index, ""


def _common_folder(scene: Scene, files: Sequence[Path]) -> Path:
    """The folder that the names of images begin in, or that all of their files are in."""
    first = files[0].absolute()
    folder = first.parents[len(Path(scene.images.names[0]).parts) - 1]
    every = all(file.absolute() == folder / name for name, file in zip(scene.images.names, files, strict=True))
    return folder if every else Path(os.path.commonpath([file.absolute().parent for file in files]))
