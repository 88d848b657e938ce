# SPDX-License-Identifier: BSD-3-Clause
"""Whether the depths of a frame go with a pose: keyframes know where things are, on walls without features too."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from groma._typing import FloatArray
from groma.features.depth.points import DEPTH_POINTS
from groma.gates import NORMAL
from groma.tracking.frame.camera import TrackCamera, back, into
from groma.tracking.frame.depth import depth_sigma
from groma.tracking.frame.features import grid_pixels, grid_shape
from groma.tracking.gates import DEFAULT, TrackingGates
from groma.tracking.map.track_map import Keyframe


def depth_agreement(
    camera: TrackCamera,
    keyframes: Sequence[Keyframe],
    grid: FloatArray,
    pose: FloatArray,
    gates: TrackingGates = DEFAULT,
) -> tuple[float, float]:
    """Compare depths that keyframes measured with those of a frame at a pose.

    Parameters
    ----------
    camera
        The camera.
    keyframes
        Keyframes that see what the frame sees.
    grid : (N,)
        Depths of the frame at :func:`~groma.tracking.frame.features.grid_pixels`; NaN where unknown.
    pose : (7,)
        Supposed pose of the frame.
    gates
        When two depths agree.

    Returns
    -------
    float, float
        Share of the places in view that are measured where they are, and share that the frame looks through (it
        measures something farther away). The rest is hidden. Both NaN where too few are known.
    """
    away, tolerance, _ = _compared(camera, keyframes, grid, pose, gates)
    if len(away) < gates.depth_check.min_places:
        return np.nan, np.nan
    return float((np.abs(away) < tolerance).mean()), float((away > tolerance).mean())


def left_open(
    camera: TrackCamera,
    keyframes: Sequence[Keyframe],
    grid: FloatArray,
    pose: FloatArray,
    gates: TrackingGates = DEFAULT,
) -> bool:
    """Return whether depths of a frame leave open that a pose is right: some agree, few are beyond what keyframes know.

    At the right pose a frame looks through a place at edges, and as seldom as noise exceeds the tolerance. Counted are
    cells of the frame's grid, since places in one are measured once. Parameters are those of :func:`depth_agreement`;
    False where too few depths are known.
    """
    from scipy.special import gammainc

    away, tolerance, pixel = _compared(camera, keyframes, grid, pose, gates)
    if len(away) < gates.depth_check.min_places:
        return False
    through, there = (_num_cells(pixel[some], gates.depth.grid) for some in (away > tolerance, away > -tolerance))
    by_noise = float(gammainc(through, NORMAL.outlier * there)) if there else 1.0  # so many or more, Poisson
    return there > through and (through <= gates.depth_check.edges * there or by_noise > NORMAL.gross)


def _num_cells(pixel: FloatArray, size: int) -> int:
    """Number of cells of a grid that pixels are in."""
    return len(np.unique(np.floor(pixel / size), axis=0))


def _compared(
    camera: TrackCamera, keyframes: Sequence[Keyframe], grid: FloatArray, pose: FloatArray, gates: TrackingGates
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """How far beyond the places of keyframes a frame measures, (n,), with tolerances (n,) and pixels (n, 2)."""
    rays = camera.bearings(grid_pixels(camera, gates.depth))
    places = [back(k.pose, (rays * k.depth_grid[:, None])[np.isfinite(k.depth_grid)]) for k in keyframes]
    in_cam = into(pose, np.concatenate(places))
    pixel = camera.project(in_cam)
    rows = np.flatnonzero(camera.inside(pixel))
    measured = _read(camera, grid, pixel[rows], gates)
    known = np.isfinite(measured)
    rows, measured = rows[known], measured[known]
    tolerance = DEPTH_POINTS.jump_share * measured + NORMAL.far * depth_sigma(measured, gates.depth)
    return measured - in_cam[rows, 2], tolerance, pixel[rows]


def _read(camera: TrackCamera, grid: FloatArray, pixel: FloatArray, gates: TrackingGates) -> FloatArray:
    """Depths (M,) at pixels between the places of a grid; NaN at its border and where it is not smooth."""
    rows, columns = grid_shape(camera, gates.depth)
    at = pixel * (columns / camera.width, rows / camera.height) - 0.5
    u, v = at[:, 0], at[:, 1]
    inside = (u >= 0) & (v >= 0) & (u < columns - 1) & (v < rows - 1)
    j, i = (np.where(inside, x, 0.0).astype(np.int64) for x in (u, v))
    a, b = u - j, v - i
    near = np.stack([grid[(i + y) * columns + j + x] for y in (0, 1) for x in (0, 1)])
    weight = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b])
    smooth = near.max(axis=0) < (1.0 + gates.depth_check.smooth) * near.min(axis=0)
    return np.where(inside & smooth, (weight * near).sum(axis=0), np.nan)
