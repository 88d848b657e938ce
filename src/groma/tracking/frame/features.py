# SPDX-License-Identifier: BSD-3-Clause
"""The features of one frame: described points, segments with depth, planes; computed on first access."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, replace
from functools import cache, cached_property
from threading import RLock
from typing import Any, Generic, TypeVar, overload

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray, IntArray
from groma.features.depth.noise import DepthNoise
from groma.features.depth.points import DEPTH_POINTS, depth_at
from groma.features.images import GrayImage, SmoothImage, smoothed
from groma.features.point_tracks import corners
from groma.features.segments import Segments
from groma.io.sequences.frame import Frame
from groma.mapping.image_segments import is_used, segments_used
from groma.tracking.frame.camera import TrackCamera, back
from groma.tracking.frame.coarse_alignment import SmallImage, small_image
from groma.tracking.frame.depth import DepthImage, depth_sigma, segment_inverse_depths
from groma.tracking.frame.planes import FramePlanes, frame_planes
from groma.tracking.frame.rectification import (
    RightCamera,
    retargeted,
    retargeted_depths,
    retargeted_ends,
    turned_disparities,
)
from groma.tracking.frame.sparse_depth import fill_sparse
from groma.tracking.frame.stereo import Disparities, dense_disparities, match_right
from groma.tracking.gates import DEFAULT, DepthGates, FeatureGates
from groma.tracking.options import TrackOptions

Descriptors = npt.NDArray[np.uint8]
_Found = TypeVar("_Found")


class _FoundOnce(Generic[_Found]):
    """A cached property, computed by the first thread that reads it while others wait."""

    def __init__(self, find: Callable[[Any], _Found]) -> None:
        self._find, self._name, self.__doc__ = find, find.__name__, find.__doc__

    @overload
    def __get__(self, instance: None, owner: type) -> _FoundOnce[_Found]: ...

    @overload
    def __get__(self, instance: FrameFeatures, owner: type) -> _Found: ...

    def __get__(self, instance: FrameFeatures | None, owner: type) -> _FoundOnce[_Found] | _Found:
        if instance is None:
            return self
        found = vars(instance)  # the value is stored there under the same name
        with instance.lock_of(self._name):
            if self._name not in found:
                found[self._name] = self._find(instance)
            return found[self._name]


@dataclass(frozen=True)
class Features:
    """Described features (ORB) of a frame. The arrays are never written to: frames and keyframes share them."""

    #: (N, 2) pixels, (N,) response, (N,) size of a pixel of the image in the pyramid where each was found, pixels.
    pixel: FloatArray
    response: FloatArray
    scale: FloatArray
    #: (N, 32) descriptors.
    descriptor: Descriptors
    #: (N,) depth; NaN where unknown.
    depth: FloatArray
    #: (N,) the point of the map at this feature, -1 for none.
    point: IntArray

    def __post_init__(self) -> None:
        point = self.point.view()
        point.flags.writeable = False
        object.__setattr__(self, "point", point)

    @classmethod
    def none(cls) -> Features:
        """Return no features."""
        none = np.zeros(0)
        return cls(np.zeros((0, 2)), none, none, np.zeros((0, 32), np.uint8), none, np.zeros(0, np.int64))

    @cached_property
    def _by_response(self) -> IntArray:
        return np.argsort(-self.response, kind="stable")

    def strongest(self, count: int) -> Descriptors:
        """Descriptors (count, 32) of the strongest features: what stands out in one image does in another."""
        return self.descriptor[self._by_response[:count]]

    def linked(self, rows: IntArray, points: IntArray) -> Features:
        """Return the features, some of them linked to points of the map."""
        point = self.point.copy()
        point[rows] = points
        return replace(self, point=point)


@dataclass(frozen=True)
class DetectedSegments:
    """Segments of a frame, with inverse depths of their ends where known."""

    segments: Segments
    inverse_depth: FloatArray
    inverse_depth_sigma: FloatArray


class FrameFeatures:
    """One frame and its features, computed on demand."""

    def __init__(
        self, frame: Frame, camera: TrackCamera, options: TrackOptions, right_camera: RightCamera | None = None
    ) -> None:
        self.frame, self.camera, self.options = frame, camera, options
        self.gray = np.ascontiguousarray(frame.gray)
        self._right_camera = right_camera or RightCamera(camera, options.gates.rectification, options.gates.features)
        self._turn = np.zeros(3)
        self._work: list[Future] = []
        self._locks: dict[str, Any] = {}

    @_FoundOnce
    def features(self) -> Features:
        """ORB features over several scales."""
        return describe(self.gray, self.options.num_features, self.depths, self.options.gates.features, self.frame.used)

    @_FoundOnce
    def detected(self) -> DetectedSegments:
        """Segments by the chosen detector."""
        segments = self.options.make_detector().detect(self.gray)
        if self.frame.used is not None:
            segments = segments_used(segments, self.frame.used)
        inverse, sigma = self.inverse_depths(segments.ends)
        return DetectedSegments(segments, inverse, sigma)

    @property
    def corner_cell(self) -> int:
        """Width of the image cells with one point each, pixels."""
        return max(12, int(math.sqrt(self.gray.size / self.options.num_points)))

    @_FoundOnce
    def corners(self) -> FloatArray:
        """Corners (N, 2) for tracking, strongest first."""
        distance = self.options.gates.points.corner_distance * self.corner_cell
        found = corners(self.gray, self.options.num_points, distance)
        return found if self.frame.used is None else found[is_used(self.frame.used, found)]

    def lock_of(self, name: str) -> Any:
        """Return the lock of one property."""
        return self._locks.setdefault(name, RLock())

    def prepare(self, pool: Executor) -> None:
        """Start the computations for a keyframe in other threads; :meth:`wait` ends them."""
        self._work += [pool.submit(getattr, self, name) for name in self._missing()]

    def prepare_ahead(self, pool: Executor, searching: Executor | None = None) -> None:
        """Start computations of this image alone in another thread, with an executor those of a relocalisation, too.

        Those are done one after another, since the frame before needs the other cores.
        """
        if self.frame.right is not None:  # the estimated rotation of that camera may change
            return
        pool.submit(self._find, ("planes", "small"))
        if searching is not None:
            searching.submit(self._find, self._missing())

    def _missing(self) -> list[str]:
        """What a keyframe needs and is not found yet."""
        wanted = {"features": True, "detected": self.options.lines, "corners": self.options.points}
        return [name for name, is_wanted in wanted.items() if is_wanted and name not in vars(self)]

    def _find(self, names: Sequence[str]) -> None:
        for name in names:
            getattr(self, name)

    def wait(self) -> None:
        """Wait for the computations that :meth:`prepare` started; others follow on access."""
        for future in self._work:
            if not future.cancel():
                future.result()
        self._work.clear()

    @_FoundOnce
    def smooth(self) -> SmoothImage:
        """The smoothed image in which edges are measured."""
        return smoothed(self.gray)

    @_FoundOnce
    def small(self) -> SmallImage:
        """A small image for coarse rotations."""
        return small_image(self.gray, self.options.gates.turns)

    @_FoundOnce
    def planes(self) -> FramePlanes | None:
        """Planes of the depth image; None without one."""
        if self.depth is None or not self.options.planes:
            return None
        return frame_planes(self.camera, self.depth, self.options.max_depth, self.options.gates)

    @_FoundOnce
    def depth(self) -> DepthImage | None:
        """The depth image; small holes are filled where most of it is missing."""
        if self.frame.depth is None:
            return None
        depth = (
            self.frame.depth
            if self.frame.used is None
            else np.where(self.frame.used, self.frame.depth, np.float32(0.0))
        )
        return fill_sparse(depth, self.options.max_depth, self.options.gates)

    def depths(self, pixels: FloatArray) -> FloatArray:
        """Depths (N,) at pixels from the depth image or the right image; NaN where unknown."""
        if self.depth is not None:
            return depth_at(self.depth, pixels, self.options.max_depth)
        if self.frame.right is not None:
            disparity = pixels[:, 0] - self.right_pixels(pixels)[:, 0]
            with np.errstate(divide="ignore"):
                depth = self.camera.fx * self.camera.baseline / disparity
            gates = self.options.gates
            far = self.camera.fx * self.camera.baseline * gates.depth.far_share / gates.stereo.disparity_sigma
            return np.where((depth > 0) & (depth < far), depth, np.nan)
        return np.full(len(pixels), np.nan)

    @_FoundOnce
    def right(self) -> GrayImage | None:
        """The right image of a pair, its rows moved to those of the left image."""
        if self.frame.right is None:
            return None
        image = self._right_camera.rows_aligned(self.gray, self.frame.right)
        self._turn = self._right_camera.turn.angles
        return image

    def keep_up(self) -> None:
        """Correct what was found in the right image, if how that is turned has become known better since."""
        found = vars(self)
        old, new = self._turn, self._right_camera.turn.angles
        if "right" not in found or np.array_equal(old, new):
            return
        for name in ("right", "disparities"):
            found.pop(name, None)
        if "features" in found:
            depth = retargeted_depths(self.camera, self.features.pixel, self.features.depth, old, new)
            found["features"] = replace(self.features, depth=depth)
        if "depth_grid" in found:
            pixels = grid_pixels(self.camera, self.options.gates.depth)
            found["depth_grid"] = retargeted_depths(self.camera, pixels, self.depth_grid, old, new)
        if "detected" in found:
            ends = self.detected.segments.ends
            inverse = retargeted_ends(self.camera, ends, self.detected.inverse_depth, old, new)
            found["detected"] = replace(self.detected, inverse_depth=inverse)
        self._turn = new

    @_FoundOnce
    def disparities(self) -> Disparities | None:
        """Dense disparities of a pair of images."""
        if self.right is None:
            return None
        found = dense_disparities(self.gray, self.right, self.options.gates.stereo)
        return turned_disparities(self.camera, found, self._turn)

    def right_pixels(self, pixels: FloatArray, expected: FloatArray | None = None) -> FloatArray:
        """Pixels (N, 2) in the right image; NaN where not found or without one.

        With ``expected`` (N,) columns only points that have one are searched.
        """
        if self.right is None:
            return np.full((len(pixels), 2), np.nan)
        gates = self.options.gates.stereo
        coarse = self.disparities if expected is None else None
        expected = np.full(len(pixels), np.nan) if expected is None else expected
        raw = np.ascontiguousarray(self.frame.right)
        turn, none = self._turn, np.zeros(3)
        return match_right(
            self.gray,
            raw,
            pixels,
            expected,
            coarse,
            gates,
            lambda p: retargeted(self.camera, p, none, -turn),
            lambda p: retargeted(self.camera, p, none, turn),
        )

    @_FoundOnce
    def depth_grid(self) -> FloatArray:
        """Depths at :func:`grid_pixels`; NaN where unknown."""
        return self.depths(grid_pixels(self.camera, self.options.gates.depth))

    def spread_places(self, pose: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels spread over a frame with a pose, and their places in the world, where it has a depth image."""
        if self.depth is None:
            return np.zeros((0, 2)), np.zeros((0, 3))
        known = np.isfinite(self.depth_grid)
        pixel = grid_pixels(self.camera, self.options.gates.depth)[known]
        return pixel, back(pose, self.camera.bearings(pixel) * self.depth_grid[known, None])

    def depth_sigma(self, depth: FloatArray) -> FloatArray:
        """Standard deviations of depths from :meth:`depths`."""
        if self.frame.right is not None and self.frame.depth is None:
            return self.options.gates.stereo.disparity_sigma * depth**2 / (self.camera.fx * self.camera.baseline)
        return depth_sigma(depth, self.options.gates.depth)

    def inverse_depths(self, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Inverse depths at the ends of segments (L, 2) and their standard deviations; NaN where unknown."""
        gates = self.options.gates
        if self.depth is not None and len(ends):
            noise = replace(segment_noise(gates.depth), max_depth=self.options.max_depth)
            return segment_inverse_depths(self.depth, ends, self.camera.params, noise, gates.depth)
        if self.frame.right is not None and len(ends):
            assert self.disparities is not None
            scale = self.camera.fx * self.camera.baseline
            with np.errstate(divide="ignore"):
                depth = np.where(self.disparities > 0, np.float32(scale) / self.disparities, np.float32(0.0))
            quadratic = 2.0 * gates.stereo.disparity_sigma / scale
            farthest = scale / gates.stereo.disparity_sigma
            noise = replace(segment_noise(gates.depth), constant=0.0, quadratic=quadratic, max_depth=farthest)
            return segment_inverse_depths(depth, ends, self.camera.params, noise, gates.depth)
        unknown = np.full((len(ends), 2), np.nan)
        return unknown, unknown.copy()


def segment_noise(gates: DepthGates = DEFAULT.depth) -> DepthNoise:
    """Errors of depth beside a segment."""
    return DepthNoise(
        gates.min_sigma, gates.inverse_sigma, 0.0, correlation=DEPTH_POINTS.correlation, tilt=0.0, shift=0.0
    )


@cache
def grid_pixels(camera: TrackCamera, gates: DepthGates = DEFAULT.depth) -> FloatArray:
    """Pixels (N, 2) of an even grid over the image, row by row: the middles of cells. It cannot be written to."""
    rows, columns = grid_shape(camera, gates)
    v, u = np.mgrid[0:rows, 0:columns].reshape(2, -1)
    pixels = (np.column_stack([u, v]) + 0.5) * (camera.width / columns, camera.height / rows)
    pixels.flags.writeable = False
    return pixels


def grid_shape(camera: TrackCamera, gates: DepthGates = DEFAULT.depth) -> tuple[int, int]:
    """Rows and columns of :func:`grid_pixels`."""
    return max(camera.height // gates.grid, 2), max(camera.width // gates.grid, 2)


def describe(
    gray: npt.NDArray[np.uint8],
    count: int,
    depths: Callable[[FloatArray], FloatArray],
    gates: FeatureGates = DEFAULT.features,
    used: BoolArray | None = None,
) -> Features:
    """Find and describe ORB features, in all parts of the image rather than where contrast is strongest."""
    finder = cv2.ORB.create(nfeatures=gates.candidates * count, fastThreshold=gates.fast_threshold)
    mask = None if used is None else used.astype(np.uint8)
    keypoints = finder.detect(gray, mask)  # pyright: ignore[reportCallIssue, reportArgumentType]
    response = np.array([keypoint.response for keypoint in keypoints])
    octave = np.array([keypoint.octave for keypoint in keypoints], np.int64)
    pixel = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64).reshape(-1, 2)
    keypoints = [keypoints[row] for row in _in_turn(pixel, response, octave, count, gates)]
    keypoints, descriptor = finder.compute(gray, keypoints)
    if not keypoints:
        return Features.none()
    pixel = np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64) + 0.5
    response = np.array([keypoint.response for keypoint in keypoints])
    scale = finder.getScaleFactor() ** np.array([keypoint.octave for keypoint in keypoints], np.float64)
    none = np.full(len(pixel), -1)
    return Features(pixel, response, scale, np.asarray(descriptor, np.uint8), depths(pixel), none)


def _in_turn(pixel: FloatArray, response: FloatArray, octave: IntArray, count: int, gates: FeatureGates) -> IntArray:
    """Rows of the chosen: the strongest of each cell, then the second of each, ..., on each scale by its share."""
    if len(pixel) <= count:
        return np.arange(len(pixel))
    at = (pixel // gates.cell).astype(np.int64)
    cell = (octave * (at[:, 1].max() + 1) + at[:, 1]) * (at[:, 0].max() + 1) + at[:, 0]
    order = np.lexsort((-response, cell))
    start = np.flatnonzero(np.diff(cell[order], prepend=-1))
    turn = np.empty(len(order), np.int64)
    turn[order] = np.arange(len(order)) - np.repeat(start, np.diff(start, append=len(order)))
    order = np.lexsort((-response, turn, octave))
    of = np.bincount(octave)
    place = np.arange(len(order)) - np.repeat(np.cumsum(of) - of, of)
    return np.sort(order[place < count / len(order) * of[octave[order]]])
