# SPDX-License-Identifier: BSD-3-Clause
"""Matches between a photograph and a map: points and segments of the image, points and lines of the world."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from groma._numba import loop
from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, ShapeError


def _empty(*shape: int) -> FloatArray:
    return np.zeros((0, *shape))


#: Stands for standard deviations of one pixel, and for landmarks that are exact.
_LEFT_OUT: FloatArray = np.zeros(0)
_LEFT_OUT.flags.writeable = False


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _nearest(claim, distance, agrees, nearest):
    """The agreeing row that is nearest for each claim, the first of equal ones; left as it is where none agrees."""
    for i in range(claim.shape[0]):
        other = nearest[claim[i]]
        if agrees[i] and (other < 0 or distance[i] < distance[other]):
            nearest[claim[i]] = i


# ----------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class Matches:
    """What may be seen of what; several rows may claim one point or one segment of the image.

    Standard deviations are pixels of the image, covariances belong to the places in the world.
    """

    #: (N, 2) places in the image, (N, 3) in the world.
    points2d: FloatArray = field(default_factory=lambda: _empty(2))
    points3d: FloatArray = field(default_factory=lambda: _empty(3))
    #: (M, 2, 2) ends of segments in the image; (M, 2, 3) two places on each line in the world.
    segments2d: FloatArray = field(default_factory=lambda: _empty(2, 2))
    segments3d: FloatArray = field(default_factory=lambda: _empty(2, 3))
    #: (N,) and (M,) standard deviations in the image: of a coordinate, and of the ends across the segment.
    point_sigma: FloatArray = field(default_factory=lambda: _LEFT_OUT)
    segment_sigma: FloatArray = field(default_factory=lambda: _LEFT_OUT)
    #: (N, 3, 3) covariances of the points, and (M, 6, 6) of (moment, direction) of the lines with a unit direction.
    point_covariance: FloatArray = field(default_factory=lambda: _LEFT_OUT)
    line_covariance: FloatArray = field(default_factory=lambda: _LEFT_OUT)
    #: What the landmarks that one cell of the image shows are off by together, seen from the camera, radians.
    shared_error: float = field(default=0.0, kw_only=True)

    def __post_init__(self) -> None:
        points, lines = len(np.atleast_1d(self.points2d)), len(np.atleast_1d(self.segments2d))
        shapes = {
            "points2d": (points, 2), "points3d": (points, 3), "segments2d": (lines, 2, 2), "segments3d": (lines, 2, 3),
            "point_sigma": (points,), "segment_sigma": (lines,),
            "point_covariance": (points, 3, 3), "line_covariance": (lines, 6, 6),
        }  # fmt: skip
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is _LEFT_OUT:
                value = np.ones(shape) if name.endswith("sigma") else np.zeros(shape)
            array = np.ascontiguousarray(value, dtype=np.float64)
            if name == "segments2d" and array.shape == (lines, 4):
                array = array.reshape(lines, 2, 2)
            if array.shape != shape:
                raise ShapeError(f"{name} must have shape {shape}, one row a match; got {array.shape}.")
            if not np.isfinite(array).all():
                raise InputError(f"{name} must be finite; got NaN or infinity. Leave those matches out.")
            if name.endswith("sigma") and not (array > 0.0).all():
                raise InputError(f"{name} must be positive, in pixels; got {array.min():g}.")
            object.__setattr__(self, name, array)
        apart = np.abs(self.segments3d[:, 0] - self.segments3d[:, 1]).max(axis=1, initial=0.0)
        if lines and not (apart > 0.0).all():
            raise InputError(f"segments3d must be two different places each; row {int(apart.argmin())} is one place.")

    @property
    def num_points(self) -> int:
        """Number of matches of points."""
        return len(self.points2d)

    @property
    def num_lines(self) -> int:
        """Number of matches of lines."""
        return len(self.segments2d)

    def take(self, points: IntArray | BoolArray, lines: IntArray | BoolArray) -> Matches:
        """The chosen matches of points and of lines."""
        chosen = {name: getattr(self, name)[points] for name in _OF_POINTS}
        chosen |= {name: getattr(self, name)[lines] for name in _OF_LINES}
        return Matches(**chosen, shared_error=self.shared_error)

    def with_sigma(self, sigma: float) -> Matches:
        """The same matches with one standard deviation for all, pixels."""
        return replace(self, point_sigma=np.full(self.num_points, sigma), segment_sigma=np.full(self.num_lines, sigma))

    @cached_property
    def claims(self) -> tuple[IntArray, IntArray]:
        """Numbers (N,) and (M,) of what is claimed in the image: equal for rows that claim the same."""
        return _groups(self.points2d), _groups(self.segments2d.reshape(-1, 4))


_OF_POINTS = ("points2d", "points3d", "point_sigma", "point_covariance")
_OF_LINES = ("segments2d", "segments3d", "segment_sigma", "line_covariance")


def _groups(rows: npt.NDArray[np.float64]) -> IntArray:
    if not len(rows):
        return np.zeros(0, np.int64)
    order = np.lexsort(rows.T)
    changes = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    group = np.zeros(len(rows), np.int64)
    group[order[1:]] = np.cumsum(changes)
    return group


def nearest_claims(claim: IntArray, distance: FloatArray, agrees: BoolArray) -> BoolArray:
    """Which of the agreeing rows (N,) are the nearest of those that claim the same: a pixel shows one place."""
    nearest = np.full(int(claim.max(initial=-1)) + 1, -1)
    _nearest(claim, distance, agrees, nearest)
    kept = np.zeros(len(agrees), bool)
    kept[nearest[nearest >= 0]] = True
    return kept
