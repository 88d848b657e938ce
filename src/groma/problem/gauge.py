# SPDX-License-Identifier: BSD-3-Clause
r"""The freedom that a scene has as a whole: to move, to turn and to scale.

Measurements between cameras and landmarks do not change when the world frame is moved by a similarity

.. math:: X' = (1 + \sigma)\,\mathrm{Exp}(\varphi)\,X + a .

The seven directions :math:`(a, \varphi, \sigma)` are candidates for the null space of the normal equations; which of
them are free depends on the factors (a prior on one pose leaves only the scale).
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.geometry._manifold import Manifold

GAUGE_NAMES = (
    "translation along x",
    "translation along y",
    "translation along z",
    "rotation about x",
    "rotation about y",
    "rotation about z",
    "scale",
)
_STEP = 1e-6


def move_world(
    kind: str, ambient: FloatArray, translation: FloatArray, rotation: FloatArray, scale: float
) -> FloatArray:
    r"""Ambient numbers of objects after the world frame moved by :math:`X' = s R X + a`.

    Poses keep their metric form: :math:`R'_{cw} = R_{cw} R^\top`, :math:`t'_{cw} = s\,t_{cw} - R'_{cw} a`.
    """
    R, a, s = rotation, translation, scale
    if kind == "point":
        return s * ambient @ R.T + a
    if kind == "direction":
        return ambient @ R.T
    if kind == "line":
        d = ambient[:, 3:] @ R.T
        return np.hstack([s * ambient[:, :3] @ R.T + np.cross(a, d), d])
    if kind == "plane":
        n = ambient[:, :3] @ R.T
        return np.hstack([n, s * ambient[:, 3:] - (n @ a)[:, None]])
    if kind == "pose":
        T = ambient.reshape(-1, 3, 4)
        R_cw = T[:, :, :3] @ R.T
        t_cw = s * T[:, :, 3] - R_cw @ a
        return np.concatenate([R_cw, t_cw[:, :, None]], axis=2).reshape(-1, 12)
    return ambient


def gauge_directions(manifold: Manifold, state: FloatArray) -> FloatArray:
    """Increments (7, count, dof) of variables under the seven world motions, by central differences."""
    directions = np.zeros((7, len(state), manifold.dof))
    if manifold.kind in ("intrinsics", "vector") or len(state) == 0:
        return directions
    ambient = manifold.ambient(state)
    for k in range(7):
        ends = []
        for sign in (1.0, -1.0):
            h = sign * _STEP
            a = np.eye(3)[k] * h if k < 3 else np.zeros(3)
            R = _rotation(k - 3, h) if 3 <= k < 6 else np.eye(3)
            s = 1.0 + h if k == 6 else 1.0
            moved = manifold.from_ambient(move_world(manifold.kind, ambient, a, R, s))
            ends.append(manifold.local(state, moved))
        directions[k] = (ends[0] - ends[1]) / (2 * _STEP)
    return directions


def _rotation(axis: int, angle: float) -> FloatArray:
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i] = R[j, j] = np.cos(angle)
    R[j, i] = np.sin(angle)
    R[i, j] = -np.sin(angle)
    return R
