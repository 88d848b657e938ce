# SPDX-License-Identifier: BSD-3-Clause
"""Photographs in a map: retrieval, matching, pose, guided matching, verdict."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from groma._log import log_warnings, logged_stages
from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, ShapeError, check_kind, given_or_default
from groma.features.images import GrayImage, to_gray
from groma.gates import gate
from groma.io import read_scene
from groma.localization.candidates import (
    Candidates,
    MirrorImage,
    closest_of,
    described_alike,
    found_near,
    lines_alike,
    points_alike,
)
from groma.localization.expected import FoundAgain, nearest_images, shown_of
from groma.localization.features import MIN_LENGTH, DescribedImage, DescribedPoints, find_features
from groma.localization.landmarks import DescribedLandmarks, coarsest, seen_in
from groma.localization.map_images import (
    OPTIONS,
    estimated_in_summary,
    files_in_summary,
    image_paths,
    images_in_summary,
)
from groma.localization.map_index import images_told, kept_index
from groma.localization.pose.absolute_pose import (
    UNKNOWN_LENS,
    AbsolutePose,
    MapQuestions,
    MirrorQuestions,
    PoseOptions,
    pose_from_matches,
)
from groma.localization.pose.camera import CAMERA_WAY, QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import Refined
from groma.localization.pose.verdict import Shown
from groma.localization.repeated import GATES as REPEATED
from groma.localization.repeated import Described, alike_limits
from groma.localization.retrieval import VladRetrieval
from groma.mapping.photographs import check_cameras, read_gray
from groma.scene import Scene
from groma.solver.linear.blas import one_blas_thread


@dataclass(frozen=True)
class LocalizerGates:
    """How much of a map a query is compared with."""

    plain: int = gate(50, "cells", "that agree with a coarse pose; or all is matched", "convention: good to a seventh")
    near: int = gate(5, "images", "of those, whose points and lines are looked for near a pose", "cost: of matching")


GATES = LocalizerGates()


@dataclass(frozen=True)
class LocalizeOptions:
    """Options of localisation."""

    #: Use lines in addition to points.
    lines: bool = True
    #: Minimum segment length, pixels.
    min_segment_length: float = MIN_LENGTH
    #: Whether poses and calibrations of the map were estimated, so that the covariance of each pose includes their
    #: errors. Poses that were held are as exact as the points of the map say, calibrations are exact. None: from the
    #: summary of the map; both where there is none.
    estimated: tuple[bool, bool] | None = None
    #: Thresholds of image retrieval.
    gates: LocalizerGates = field(default_factory=LocalizerGates)
    #: Options of the pose estimation.
    pose: PoseOptions = field(default_factory=PoseOptions)


@dataclass(frozen=True, eq=False)
class LocalizedImage:
    """A localised photograph: its file, camera and pose."""

    pose: AbsolutePose
    #: Points and lines of the map that its matches show, as rows of the index and of the map.
    point: IntArray
    line: IntArray
    #: Seconds that it took: finding features, and the rest.
    feature_seconds: float
    seconds: float


_Found = tuple[AbsolutePose, Candidates]


class Localizer:
    """Localises photographs in a map.

    Parameters
    ----------
    map_ : path or Scene
        OUT of ``groma map`` or ``groma track``, a COLMAP model, or a scene.
    images : path, optional
        Folder of the photographs of the map, or a folder above. By default where they were when the map was indexed,
        or made.
    index : path, optional
        File of the index of the map, which is made once. By default beside the map; a scene
        without a file is indexed again.
    options : LocalizeOptions, optional
        Lines, retrieval, poses.
    progress : callable, optional
        Called with the name of a stage, what is done and what there is to do.
    """

    def __init__(
        self,
        map_: str | os.PathLike[str] | Scene,
        images: str | os.PathLike[str] | None = None,
        index: str | os.PathLike[str] | None = None,
        options: LocalizeOptions | None = None,
        progress: Callable[[str, int, int], None] | None = None,
    ) -> None:
        say = logged_stages("localization", progress)
        self.options = given_or_default(options, LocalizeOptions)
        self.scene = map_ if isinstance(map_, Scene) else read_scene(map_)
        check_map(self.scene)
        if index is None and not isinstance(map_, Scene):
            index = index_file(Path(map_))
        path = None if index is None else Path(index)
        #: Files of the images of the map, in their order.
        self.files = _files(self.scene, map_, images, path)
        #: The descriptions; and what could not be done as wanted, in words.
        estimated = self.options.estimated
        if estimated is None:
            estimated = (True, True) if isinstance(map_, Scene) else estimated_in_summary(Path(map_))
        self.index, self.warning = kept_index(self.scene, self.files, path, say, estimated)
        if self.warning:
            log_warnings("localization", [self.warning])
        self._retrieval = VladRetrieval(self.index.vocabulary)
        upright = np.arange(len(self.index.xyz)) >= len(self.index.xyz) - self.scene.num_points
        self._landmarks = DescribedLandmarks.of(self.index, upright)
        of_points = Described(self.index.point, self.index.pixel, self.index.descriptor, upright[self.index.point])
        self._alike_limits = alike_limits(of_points)
        self._common = self.index.common_errors(self.scene)
        self._again = FoundAgain.of(self.scene, self.index, self.options.gates.near)

    def camera_of_map(self, width: int, height: int) -> QueryCamera | None:
        """The camera of the map for images of this size; None where there is none, or more than one."""
        table = self.scene.cameras
        rows = np.flatnonzero((table.width == width) & (table.height == height))
        found = [QueryCamera.of(table, int(row)) for row in rows]
        alike = found and all(
            one.model == found[0].model and np.allclose(one.params, found[0].params, rtol=1e-2) for one in found
        )
        return found[0] if alike else None

    def photograph_of_map(self, width: int, height: int) -> Path | None:
        """The first photograph of the map of this size; None where there is none."""
        table, camera = self.scene.cameras, self.scene.images.camera_idx
        rows = np.flatnonzero((table.width[camera] == width) & (table.height[camera] == height))
        return self.files[rows[0]] if len(rows) else None

    def localize(
        self,
        image: str | os.PathLike[str] | npt.NDArray[np.generic],
        camera: QueryCamera | None = None,
        refine_lens: bool = False,
        used: BoolArray | None = None,
    ) -> LocalizedImage:
        """Find where a photograph was taken.

        Parameters
        ----------
        image : path or (H, W) or (H, W, 3) uint8
            The photograph.
        camera : QueryCamera, optional
            Its calibration; by default that of the map for images of this size. Where there is none, or the photograph
            shows another focal length, because its lens was focused anew, it is estimated.
        refine_lens : bool
            Estimate focal length and distortion, from those of the camera.
        used : (H, W) bool, optional
            What may be used of the photograph, as of its mask; by default all.
        """
        gray = to_gray(image) if isinstance(image, np.ndarray) else read_gray(Path(image))
        height, width = gray.shape
        options = replace(self.options.pose, refine_lens=refine_lens)
        assumed, camera = camera is None and not refine_lens, camera or self.camera_of_map(width, height)
        if camera is None:
            camera = unknown_camera(width, height)
            options = replace(options, refine_lens=True, focal_factors=UNKNOWN_LENS)
        check_kind(camera, QueryCamera, "camera", CAMERA_WAY)
        if (camera.width, camera.height) != (width, height):
            raise InputError(
                f"The image has {width}x{height} pixels, its camera {camera.width}x{camera.height}. Pass the "
                "calibration of this size."
            )
        if used is not None and used.shape != gray.shape:
            raise ShapeError(f"used must have the shape of the image, {gray.shape}; got {used.shape}.")
        return self._localize(gray, camera, options, used, assumed and not options.refine_lens)

    def _localize(
        self, gray: GrayImage, camera: QueryCamera, options: PoseOptions, used: BoolArray | None, assumed: bool
    ) -> LocalizedImage:
        start = time.perf_counter()
        with one_blas_thread():
            query = find_features(gray, camera, self.options.lines, self.options.min_segment_length, used)
            described = time.perf_counter()
            images = self._alike(query.points)
            pose, last = self._found(query, camera, options, images)
            if pose.other_focal and assumed:
                again = self._found(query, camera, replace(options, refine_lens=True), images)
                if again[0].status == "localized":
                    said = f"{again[0].sentence} The calibration was estimated: that of the map does not fit."
                    pose, last = replace(again[0], sentence=said), again[1]
        done = time.perf_counter()
        return LocalizedImage(pose, last.points[:, 1], last.lines[:, 1], described - start, done - described)

    def _found(self, query: DescribedImage, camera: QueryCamera, options: PoseOptions, images: IntArray) -> _Found:
        pose, last = self._coarsely(query, camera, options, images)
        if pose.status == "localized" or pose.settled:
            return pose, last
        return self._fully(query, camera, options, images)

    def _coarsely(self, query: DescribedImage, camera: QueryCamera, options: PoseOptions, images: IntArray) -> _Found:
        """Look for the coarsest points among all that the images see: enough where the place is plain."""
        few = query.with_points(query.points.take(coarsest(query.points)))

        def matched(points: DescribedPoints, images: IntArray) -> Candidates:
            return Candidates(self._landmarks.match(points, seen_in(self.index, images)), np.zeros((0, 2), np.int64))

        enough = self.options.gates.plain
        return self._pose(query, few, camera, options, images, matched(few.points, images), matched, enough)

    def _fully(self, query: DescribedImage, camera: QueryCamera, options: PoseOptions, images: IntArray) -> _Found:
        """Match all points with one image after the other; lines, too, if these neither place it nor speak against the
        place.
        """

        def matched(points: DescribedPoints, images: IntArray) -> Candidates:
            return described_alike(self.index, images, points_alike(points, self.index, images))

        pairs = points_alike(query.points, self.index, images)
        found = described_alike(self.index, images, pairs)
        pose, last = self._pose(query, query, camera, options, images, found, matched)
        if pose.status == "localized" or pose.contradicted or not self.options.lines:
            return pose, last
        lines = lines_alike(query, self.scene, self.index, images, pairs)
        if not len(lines):
            return pose, last
        return self._pose(query, query, camera, options, images, replace(found, lines=lines), matched)

    def _pose(
        self,
        query: DescribedImage,
        part: DescribedImage,
        camera: QueryCamera,
        options: PoseOptions,
        images: IntArray,
        found: Candidates,
        matched: Callable[[DescribedPoints, IntArray], Candidates],
        enough: int = 0,
    ) -> _Found:
        """The pose from matches of a part of a query, those that it guides to, and what mirrored points match."""
        near = nearest_images(self.index, images, found.points[:, 1], self.options.gates.near)
        matches = found.matches(part, self.scene, self.index)
        own_camera = None if options.refine_lens else self._own_camera(camera)
        tried = [(matches, found)]

        def guided(best: Refined) -> Matches:
            reach = self._reach(query, best)
            seen = found_near(
                query, self.scene, self.index, near, best.camera, best.pose, (reach, reach), self.options.lines
            )
            tried.append((seen.matches(query, self.scene, self.index), seen))
            return tried[-1][0]

        def seen_in_them(used: Matches) -> Candidates:
            return next(seen for made, seen in tried if made is used)

        def closest(best: Refined, used: Matches, other: Refined) -> tuple[int, int]:
            distance = seen_in_them(used).distance[best.point_inliers]
            return closest_of(distance, mirror.distances(other, self._reach(query, best)))

        def expected(best: Refined, used: Matches) -> Shown:
            agreeing = seen_in_them(used).points[best.point_inliers, 1]
            distance = seen_in_them(used).distance[best.point_inliers]
            limit = self._alike_limits[self._landmarks.upright[agreeing].astype(np.int64)]
            alike = agreeing[distance <= limit], agreeing[distance <= self.index.within[agreeing]]
            around = nearest_images(self.index, images, agreeing, self.options.gates.near)
            return shown_of(
                self.scene, self.index, self._again, around, best, used, alike, self.options.lines, query.used
            )

        def telling(used: Matches) -> BoolArray:
            return seen_in_them(used).telling(part, self.index)

        def common(best: Refined, used: Matches, step: int) -> FloatArray:
            assert self._common is not None
            landmarks = seen_in_them(used).points[::step, 1], seen_in_them(used).lines[::step, 1]
            return self._common.of_query(best, landmarks, own_camera)

        mirror = MirrorImage(
            query, part, camera, self.scene, self.index, lambda points: matched(points, self._alike(points)),
            self.options.gates.near,
        )  # fmt: skip
        errors = None if self._common is None else common
        of_map = MapQuestions(guided, MirrorQuestions(mirror.matches, closest), expected, errors, telling)
        pose = pose_from_matches(camera, matches, options, max(len(images), 1), enough, of_map)
        return pose, seen_in_them(pose.matches)

    def _own_camera(self, camera: QueryCamera) -> int | None:
        """The camera of the map with this very calibration."""
        table = self.scene.cameras
        alike = [row for row in range(len(table)) if table.models[row] == camera.model]
        same = [row for row in alike if np.array_equal(table.params_of(row), camera.params)]
        return same[0] if same else None

    @staticmethod
    def _reach(query: DescribedImage, best: Refined) -> float:
        """How far from where a pose says points are looked for, pixels."""
        sigma = best.sigma0 * max(1.0, float(np.median(query.points.sigma)) if len(query.points) else 1.0)
        return max_errors(Matches(point_sigma=np.zeros(0)))[0] * sigma

    def _alike(self, points: DescribedPoints) -> IntArray:
        """The images of the map to match with, the most alike first."""
        wanted = REPEATED.images
        if len(self.index.image) <= wanted:
            return np.arange(len(self.index.image))
        described = self._retrieval.gather(points.descriptors)
        return np.argsort(-self._retrieval.similarity(described, self.index.image), kind="stable")[:wanted]  # type: ignore[arg-type]


def _files(scene: Scene, map_: object, images: str | os.PathLike[str] | None, index: Path | None) -> list[Path]:
    """Files of the images of a map: from a folder as given, else from several or one that the map tells."""
    names = scene.images.names
    told = {} if images is not None or isinstance(map_, Scene) else files_in_summary(Path(str(map_)))
    if told.keys() >= set(names):
        return [told[name] for name in names]
    return image_paths(names, _folder(map_, images, index))


def _folder(map_: object, images: str | os.PathLike[str] | None, index: Path | None) -> Path:
    """Folder of the photographs of a map: as given, else as the description or the summary of the map tells."""
    if images is not None:
        return Path(images)
    told = None if index is None else images_told(index)
    if told is None and not isinstance(map_, Scene):
        told = images_in_summary(Path(str(map_)))
    if told is None:
        name = "The scene" if isinstance(map_, Scene) else str(map_)
        raise InputError(f"The folder of the photographs of {name} is unknown. Pass it ({OPTIONS}).")
    return told


def check_photographs(map_: str | os.PathLike[str], images: str | os.PathLike[str] | None = None) -> None:
    """Check that the photographs of a map are in a folder as given, or that the map tells where they are; InputError
    where it does not.
    """
    if images is not None or files_in_summary(Path(map_)):
        return
    try:
        _folder(map_, None, index_file(Path(map_)))
    except InputError:
        read_scene(map_)  # what is no map at all tells nothing of photographs, either
        raise


def unknown_camera(width: int, height: int, focal: float | None = None) -> QueryCamera:
    """Return a camera without distortion, by default as wide as its image is long: where an estimate begins."""
    focal = focal or float(max(width, height))
    params = np.array([focal, focal, 0.5 * width, 0.5 * height, 0.0, 0.0, 0.0, 0.0])
    return QueryCamera("OPENCV", params, width, height)


def index_file(map_: Path) -> Path:
    """Return the file beside a map in which its descriptions are kept."""
    path = map_.absolute()
    return path.parent / f"{path.name}.index.npz"


def check_map(scene: Scene) -> None:
    """Check that a map has images with poses, and that a plane holds their views."""
    if not scene.num_images:
        raise InputError("The map has no images with poses. Pass an output of groma map or groma track.")
    check_cameras(scene.cameras.models)
