# SPDX-License-Identifier: BSD-3-Clause
r"""Poses at which planes of a frame lie on planes of the map.

Seen from another side, features of a box are other ones, and its planes are the same. Two of them that cross tell how
the camera is turned, :math:`R n_k = n'_k`, and where it is but along both; what was seen is in view, where it was
expected or some pixels off.
"""

from __future__ import annotations

import math

import numpy as np

from groma._typing import FloatArray
from groma.geometry import quaternion, se3
from groma.tracking.frame.camera import TrackCamera, into
from groma.tracking.frame.planes import FramePlanes
from groma.tracking.gates import TrackingGates


def poses_on_planes(
    camera: TrackCamera, seen: FramePlanes, world: FloatArray, predicted: FloatArray, centre: FloatArray,
    gates: TrackingGates,
) -> list[FloatArray]:  # fmt: skip
    """Return poses (k, 7) for each way to lay two planes of a frame on two of the map.

    They leave what was seen in view: the camera has turned by less than its field of view from where it was predicted.

    Parameters
    ----------
    camera, seen, gates
        The camera, the planes of a frame, and the gates.
    world : (n, 4)
        Planes of the map.
    predicted : (7,)
        Where the camera is expected.
    centre : (3,)
        A place that is seen from there.
    """
    own = seen.plane[: gates.finding.planes]
    first = np.column_stack(np.triu_indices(len(own), 1))
    second = np.argwhere(~np.eye(len(world), dtype=bool))
    rows = np.array([(*one, *two) for one in first for two in second], np.int64).reshape(-1, 4)
    mine, theirs = own[rows[:, :2], :3], world[rows[:, 2:], :3]
    angle, known_angle = (np.arccos(np.clip((n[:, 0] * n[:, 1]).sum(axis=1), -1.0, 1.0)) for n in (mine, theirs))
    good = (np.abs(angle - known_angle) < gates.planes.wider * gates.planes.angle) & (
        np.sin(angle) > gates.finding.crossing
    )
    rows, mine, theirs = rows[good], mine[good], theirs[good]
    rotation = _rotations(mine, theirs)
    turn = se3.compose(_poses(rotation), np.tile(se3.inverse(predicted[None]), (len(rows), 1)))
    view = 2.0 * math.atan(0.5 * camera.width / camera.fx)
    out, at = [], into(predicted, centre[None])[0]
    for k in np.flatnonzero(np.linalg.norm(se3.log(turn)[:, 3:], axis=1) < view):
        # n . (R x + t) + d = 0 in the camera for all x with n' . x + d' = 0.
        start = at - rotation[k] @ centre
        offsets = world[rows[k, 2:], 3] - own[rows[k, :2], 3]
        place = start + np.linalg.pinv(mine[k]) @ (offsets - mine[k] @ start)
        along = np.cross(*mine[k])
        way = np.arange(-gates.finding.shifts, gates.finding.shifts + 1) * 6.0 * gates.finding.near * at[2] / camera.fx
        poses = _poses(np.tile(rotation[k], (len(way), 1, 1)))
        poses[:, 4:] = place + way[:, None] * along / np.linalg.norm(along)
        out.append(poses)
    return out


def _rotations(mine: FloatArray, theirs: FloatArray) -> FloatArray:
    """Rotations (n, 3, 3) that turn two normals each (n, 2, 3) of the world into those of the camera."""
    both = [np.concatenate([n, np.cross(n[:, 0], n[:, 1])[:, None]], axis=1) for n in (mine, theirs)]
    U, _, Vt = np.linalg.svd(np.swapaxes(both[0], 1, 2) @ both[1])
    U[..., 2] *= np.linalg.det(U @ Vt)[:, None]
    return U @ Vt


def _poses(rotation: FloatArray) -> FloatArray:
    return np.column_stack([quaternion.from_matrix(rotation), np.zeros((len(rotation), 3))])
