# SPDX-License-Identifier: BSD-3-Clause
r"""Which motions of a whole scene its measurements leave open, and coordinates of frames that hold these and no others.

Of a shift a, a turn :math:`\varphi` and a scale :math:`\sigma` of the world about its middle, a place q that is known
tells :math:`a + \varphi \times q + \sigma q`, one on a known plane the part of it along the normal, one on a held line
those across it, a known direction v the turns across it, a distance the scale. The null space G of all that is open. As
many coordinates of frames as it has columns are held, those in which G is largest and independent (QR with pivots), so
that nothing measured is touched.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.geometry import line3
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.problem.gauge import gauge_directions
from groma.scene import Scene
from groma.scene.survey import Kind, accepted

#: Singular values below this fraction of the largest do not count.
_RANK = 1e-6


def coordinates_to_hold(scene: Scene, usable: BoolArray) -> BoolArray:
    """Return coordinates (F, 6) of frames that hold what measurements leave open.

    Parameters
    ----------
    scene : Scene
        With measurements of other instruments.
    usable : (F,) bool
        Frames that may be held.
    """
    frames = scene.frames.rig_from_world
    centers = scene.cam_centers_in_world
    middle = centers.mean(axis=0)
    length = float(np.median(np.linalg.norm(centers - middle, axis=1))) or 1.0
    motions = _open(_told(scene, middle, length))
    held = np.zeros((len(frames), 6), bool)
    if motions.shape[1]:
        from scipy.linalg import qr  # takes a quarter of a second to import

        moved = gauge_directions(POSE_CHARTS["left"], frames, middle, length).transpose(1, 2, 0) @ motions
        moved[:, :3] /= length
        moved[~usable] = 0.0
        found: Any = qr(moved.reshape(-1, motions.shape[1]).T, mode="r", pivoting=True)
        held.reshape(-1)[found[-1][: motions.shape[1]]] = True
    return held


def num_open_motions(scene: Scene) -> int:
    """Return how many of the seven motions the measurements of a scene leave open."""
    centers = scene.cam_centers_in_world
    middle = centers.mean(axis=0)
    length = float(np.median(np.linalg.norm(centers - middle, axis=1))) or 1.0
    return _open(_told(accepted(scene), middle, length)).shape[1]


def _open(told: FloatArray) -> FloatArray:
    """Return the motions (7, k) that none of the rows (n, 7) notices."""
    _, values, vectors = np.linalg.svd(told)
    size = np.append(values, np.zeros(7 - len(values)))
    return vectors[size <= _RANK * max(float(size.max(initial=0.0)), 1.0)].T


def _told(scene: Scene, middle: FloatArray, length: float) -> FloatArray:
    """Return rows (n, 7): derivatives of the measurements by the motions, in units of the length."""
    centers, marked = scene.cam_centers_in_world, scene.control_points.xyz
    rows = [np.zeros((1, 7))]
    held = {kind: scene.held.idx[scene.held.kind == kind] for kind in Kind}
    images = held[Kind.IMAGE]
    places = [centers[scene.camera_positions.image_idx], centers[scene.camera_poses.image_idx], centers[images]]
    places += [marked[scene.control_points.is_control], marked[held[Kind.CONTROL_POINT]]]
    places += [scene.points.xyz[held[Kind.POINT]]]
    rows += [_of_places((one - middle) / length).reshape(-1, 7) for one in places]
    rows += [_of_lines(scene.lines.plucker[held[Kind.LINE]], middle, length)]
    rows += [_of_planes(scene.planes.hesse[held[Kind.PLANE]], middle, length)]
    table = scene.known_planes
    on = table.anchor.copy()
    for kind, xyz in ((Kind.IMAGE, centers), (Kind.CONTROL_POINT, marked)):
        of = table.kind == kind
        on[of] = xyz[table.idx[of]]
    rows.append(np.einsum("ni,nik->nk", table.hesse[:, :3], _of_places((on - middle) / length)))
    known = np.concatenate([scene.known_directions.vector, scene.directions.vectors[held[Kind.DIRECTION]]])
    across = np.zeros((len(known), 3, 7))
    across[:, :, 3:6] = _across(known)
    turns = np.zeros((3 * min(len(images) + len(scene.camera_poses), 1), 7))
    turns[:, 3:6] = np.eye(3)[: len(turns)]
    scale = np.zeros((min(len(scene.distances) + scene.is_metric, 1), 7))
    scale[:, 6] = 1.0
    return np.concatenate([*rows, across.reshape(-1, 7), turns, scale])


def _of_places(q: FloatArray) -> FloatArray:
    """Return how places (N, 3) move with the seven motions, (N, 3, 7)."""
    moved = np.zeros((len(q), 3, 7))
    moved[:, :, :3], moved[:, :, 6] = np.eye(3), q
    moved[:, [0, 1, 2], [4, 5, 3]], moved[:, [1, 2, 0], [3, 4, 5]] = q[:, [2, 0, 1]], -q[:, [2, 0, 1]]
    return moved


def _of_lines(plucker: FloatArray, middle: FloatArray, length: float) -> FloatArray:
    """Return how lines (N, 6) move across themselves, at the places nearest to the middle and a length from there."""
    d = plucker[:, 3:]
    foot = (line3.closest_point(plucker, np.tile(middle, (len(plucker), 1))) - middle) / length
    both = np.concatenate([foot, foot + d])
    return (_across(np.concatenate([d, d])) @ _of_places(both)).reshape(-1, 7)


def _of_planes(hesse: FloatArray, middle: FloatArray, length: float) -> FloatArray:
    """Return how planes (N, 4) move along their normals, at the foot of the middle, and turn."""
    n = hesse[:, :3]
    foot = -((n @ middle + hesse[:, 3]) / length)[:, None] * n
    turns = np.zeros((len(n), 3, 7))
    turns[:, :, 3:6] = _across(n)
    along = np.einsum("ni,nik->nk", n, _of_places(foot))
    return np.concatenate([along, turns.reshape(-1, 7)])


def _across(v: FloatArray) -> FloatArray:
    """Return the projections (N, 3, 3) across unit vectors."""
    return np.eye(3) - v[:, :, None] * v[:, None]
