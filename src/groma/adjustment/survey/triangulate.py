# SPDX-License-Identifier: BSD-3-Clause
r"""Places of marked points at the poses of a scene, found robustly.

The point nearest to the rays :math:`c_i + \lambda d_i` of some marks solves
:math:`\sum_i (I - d_i d_i^\top)(X - c_i) = 0`. Of all pairs of marks the one is taken whose point is near
most of the rays, in angle; then all rays near it.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.geometry import quaternion
from groma.geometry.algebra import unit
from groma.scene import Marks, Scene

#: Rays farther from a point than this angle (radians) do not agree with it.
_ANGLE = 0.01
#: Pairs of marks that are tried at most (cost: time).
_PAIRS = 200


def triangulated(scene: Scene, marks: Marks, count: int) -> tuple[FloatArray, BoolArray]:
    """Return places (count, 3) of marked points, NaN where less than two rays meet, and which marks (M,) agree."""
    centers = scene.cam_centers_in_world[marks.image_idx]
    rays = rays_of(scene, marks)
    places, agrees = np.full((count, 3), np.nan), np.ones(len(marks), bool)
    for point in range(count):
        rows = np.flatnonzero((marks.point_idx == point) & np.isfinite(rays).all(axis=1))
        if len(rows) >= 2:
            places[point], agrees[rows] = _meet(centers[rows], rays[rows])
    return places, agrees


def rays_of(scene: Scene, marks: Marks) -> FloatArray:
    """Return unit directions (M, 3) of marks in the world; NaN outside the range of a camera."""
    rays = np.full((len(marks), 3), np.nan)
    for model, rows, params in scene.cameras.rows_by_model(scene.images.camera_idx[marks.image_idx]):
        rays[rows] = model.unproject(params, np.ascontiguousarray(marks.pixel[rows]))
    turn = quaternion.conjugate(scene.cam_from_world[marks.image_idx, :4])
    return unit(quaternion.rotate(turn, rays))


def _meet(centers: FloatArray, rays: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the point that most rays meet in, and which ones."""
    best, most, agree = np.full(3, np.nan), (0, -np.inf), np.zeros(len(rays), bool)
    for pair in list(combinations(range(len(rays)), 2))[:_PAIRS]:
        point = _nearest(centers[list(pair)], rays[list(pair)])
        if point is None:
            continue
        angles = _angles(point, centers, rays)
        near = angles <= _ANGLE
        score = int(near.sum()), -float(np.median(angles))
        if score > most:
            best, most, agree = point, score, near
    if agree.sum() >= 2 and (point := _nearest(centers[agree], rays[agree])) is not None:
        best = point
    return best, agree


def _nearest(centers: FloatArray, rays: FloatArray) -> FloatArray | None:
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    normal = across.sum(axis=0)
    if np.linalg.eigvalsh(normal)[0] < 1e-8:
        return None
    middle = centers.mean(axis=0)
    return middle + np.linalg.solve(normal, np.einsum("nij,nj->i", across, centers - middle))


def _angles(point: FloatArray, centers: FloatArray, rays: FloatArray) -> FloatArray:
    away = unit(point - centers)
    return np.arctan2(np.linalg.norm(np.cross(away, rays), axis=1), np.einsum("ni,ni->n", away, rays))
