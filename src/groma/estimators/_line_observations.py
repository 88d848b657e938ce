# SPDX-License-Identifier: BSD-3-Clause
"""What the estimators of lines share: the result, its status, and observations stored by line."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.geometry.algebra import apply, cofactor, dot, matrices, ratio, stack, vectors


class TriangulationStatus(IntEnum):
    """The outcome for a line."""

    #: A line.
    OK = 0
    #: Fewer than two usable observations: zero line.
    TOO_FEW_VIEWS = 1
    #: All planes nearly coincide: the line lies in the epipolar plane of all its views, or the camera moved along it.
    #: The line is the best that can be had, and uncertain by noise / sine; zero where the planes share no finite line.
    DEGENERATE_BASELINE = 2
    #: A line, but in front of fewer than two of its cameras.
    BEHIND_CAMERA = 3
    #: A line, but the refinement had not converged when it stopped.
    NOT_CONVERGED = 4
    #: A number is not finite, or there is no finite line: zero line.
    INVALID = 5


@dataclass(frozen=True)
class LineTriangulation:
    """Triangulated lines."""

    #: (L, 6) lines (m, d) with unit d, world frame; zero where the status is TOO_FEW_VIEWS or INVALID.
    line: FloatArray
    #: (L,) quality: sine of the largest angle that the planes span, see the estimator. 0 to 1.
    sine: FloatArray
    #: (L,) root mean square of what the planes disagree by: distance of the line from the planes over its distance
    #: from the cameras (linear estimators), or pixels (refinement).
    residual: FloatArray
    #: (L,) :class:`TriangulationStatus`.
    status: IntArray
    #: (L, 6, 6) covariance of ``line`` from unit weights in pixels, rank 4; None unless requested.
    covariance: FloatArray | None = None
    #: (L,) number of steps of the refinement.
    iterations: IntArray | None = None


def checked_pointers(line_pointers: IntArray, count: int) -> IntArray:
    """Pointers that rise from 0 to the number of observations; raise unless they are valid."""
    pointers = np.asarray(line_pointers)
    if pointers.ndim != 1 or len(pointers) == 0 or not np.issubdtype(pointers.dtype, np.integer):
        raise ShapeError(
            f"line_pointers must be integers of shape (L + 1,); got shape {pointers.shape}, {pointers.dtype}. The "
            "observations of line i are line_pointers[i] : line_pointers[i + 1]."
        )
    if pointers[0] != 0 or pointers[-1] != count or (np.diff(pointers) < 0).any():
        raise InputError(
            f"line_pointers must rise from 0 to the number of observations, {count}; got {pointers[0]} to "
            f"{pointers[-1]}. Sort the observations by line."
        )
    return pointers.astype(np.int64)


def sum_by_line(values: FloatArray, pointers: IntArray) -> FloatArray:
    """Sums over the observations of each line, (M, ...) to (L, ...); zero for lines without observations."""
    out = np.zeros((len(pointers) - 1, *values.shape[1:]))
    filled = np.diff(pointers) > 0
    if filled.any():
        out[filled] = np.add.reduceat(values, pointers[:-1][filled], axis=0)
    return out


def camera_centers(cameras: FloatArray) -> FloatArray:
    """Centres (C, 3) of camera matrices (C, 3, 4); NaN for affine cameras, whose centre is at infinity."""
    left = cameras[:, :, :3]
    adjugate = np.swapaxes(cofactor(left), -1, -2)
    determinant = dot(left[:, 0, :], adjugate[:, :, 0])
    return ratio(-apply(adjugate, cameras[:, :, 3]), determinant[:, None], (determinant != 0.0)[:, None])


def checked_observations(
    cameras: FloatArray, image_idx: IntArray, segments: FloatArray, pointers: IntArray
) -> tuple[FloatArray, IntArray, FloatArray, IntArray]:
    """Consistent camera matrices, image indices, segments and pointers; raise unless they are valid."""
    cameras, segments = matrices(cameras, 3, 4, "cameras"), vectors(segments, 4, "segments")
    image_idx = np.asarray(image_idx)
    if cameras.ndim != 3 or segments.ndim != 2 or image_idx.shape != (len(segments),):
        raise ShapeError(
            f"cameras, image_idx and segments must have shapes (C, 3, 4), (M,) and (M, 4); got {cameras.shape}, "
            f"{image_idx.shape} and {segments.shape}. Pass one image index per segment."
        )
    if len(image_idx) and not (0 <= image_idx.min() and image_idx.max() < len(cameras)):
        raise InputError(
            f"image_idx must lie in 0 to {len(cameras) - 1}; got {image_idx.min()} to {image_idx.max()}. Indices count "
            "the rows of cameras."
        )
    return cameras, image_idx, segments, checked_pointers(pointers, len(segments))


def to_world(line: FloatArray, scale: FloatArray, center: FloatArray) -> FloatArray:
    """Lines (L, 6) from local frames X = center + scale X' to the world; the length of d is kept."""
    along = line[:, 3:]
    return stack(scale[:, None] * line[:, :3] + np.cross(center, along), along)
