# SPDX-License-Identifier: BSD-3-Clause
r"""How well each variable is determined, in units that compare: radians, and lengths over the viewing distance.

For a variable with increments :math:`\delta` let :math:`J\delta` be its motion where it is seen: the shift of a point
over its distance; the turn of a line or plane, and its shift at the place nearest to the cameras over
the distance; the turn of a camera, and the shift of its centre over the distance of what it sees; the relative change
of intrinsics. With the QR decomposition J = QR the information matrix V of the increments becomes
:math:`R^{-\top} V R^{-1}`, whose smallest eigenvalue is the inverse variance of the motion determined least, whatever
the chart. A standard deviation of 1 means that the distance could as well be twice as large, or the direction any.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry.algebra import norm
from groma.geometry.manifold import Manifold
from groma.problem.problem import Problem

#: Kinds of variables that cameras observe.
SEEN = ("point", "line", "plane", "direction")


@dataclass(frozen=True)
class Observers:
    """Which poses see the variables of a group: one pair for each observation, in no particular order."""

    variable: IntArray
    #: Row of the pose in ``centers``.
    pose: IntArray
    #: (C, 3) centres of all poses.
    centers: FloatArray
    #: (count,) number of observations, and the mean distance from where they are made, of every variable.
    count: IntArray
    distance: FloatArray
    #: (count, 3) mean of the centres that see it.
    middle: FloatArray

    def of(self, chosen: BoolArray) -> tuple[IntArray, IntArray]:
        """Return the distinct pairs (variable, pose) of the chosen variables, sorted."""
        mine = np.flatnonzero(chosen[self.variable])
        key = distinct(self.variable[mine] * max(len(self.centers), 1) + self.pose[mine])
        return key // max(len(self.centers), 1), key % max(len(self.centers), 1)


def camera_centers(problem: Problem) -> dict[str, FloatArray]:
    """Centres (count, 3) of the poses of each group that factors use as world poses."""
    centers = {}
    for factor in problem.factors:
        for slot, ref in factor.references():
            group = problem.variables[ref.group]
            if slot.kind == "pose" and slot.name != "extrinsics" and ref.group not in centers:
                T = group.ambient().reshape(-1, 3, 4)
                centers[ref.group] = -np.einsum("nij,ni->nj", T[:, :, :3], T[:, :, 3])
    return centers


def observers(problem: Problem, name: str, centers: dict[str, FloatArray]) -> Observers:
    """Find the poses that see each variable of a group, directly or by what lies on it."""
    number = len(problem.variables[name])
    offsets, every = {}, [np.zeros((0, 3))]
    for group, part in centers.items():
        offsets[group] = sum(len(x) for x in every)
        every.append(part)
    all_centers = np.ascontiguousarray(np.concatenate(every))
    none = np.zeros(0, np.int64)
    variables, poses = [none], [none]
    for factor in (one for one in problem.factors if not one.is_incidence):
        mine = [ref for _, ref in factor.references() if ref.group == name]
        from_pose = [ref for slot, ref in factor.references() if ref.group in offsets and slot.name != "extrinsics"]
        if len(mine) == 1 and len(from_pose) == 1 and from_pose[0].group != name:
            variables.append(mine[0].index.astype(np.int64))
            poses.append(from_pose[0].index.astype(np.int64) + offsets[from_pose[0].group])
    variable, pose = np.concatenate(variables), np.concatenate(poses)
    group, count, seen_from = problem.variables[name], np.bincount(variable, minlength=number), all_centers[pose]
    sums = [np.bincount(variable, column, number) for column in seen_from.T]
    middle = np.column_stack(sums) / np.maximum(count, 1)[:, None]
    away = nearest_place(group.manifold, group.state, middle)[variable] - seen_from
    distance = np.bincount(variable, norm(away), number) / np.maximum(count, 1)
    fallback = float(np.median(distance[count > 0])) if (count > 0).any() else 1.0
    distance = np.where(distance > 0, distance, max(fallback, 1e-300))
    return Observers(variable, pose, all_centers, count, distance, middle)


def distinct(values: IntArray) -> IntArray:
    """Sorted distinct values; several times faster than ``np.unique`` on large arrays."""
    ordered = np.sort(values)
    return ordered[np.concatenate([[True], ordered[1:] != ordered[:-1]])] if len(ordered) else ordered


def nearest_place(manifold: Manifold, state: FloatArray, middle: FloatArray) -> FloatArray:
    """Place (count, 3) of points, or the place of lines and planes nearest to ``middle``."""
    ambient = manifold.ambient(state)
    if manifold.kind == "point":
        return np.ascontiguousarray(ambient)
    if manifold.kind == "line":
        m, d = ambient[:, :3], ambient[:, 3:]
        size = np.maximum((d * d).sum(axis=1, keepdims=True), 1e-300)
        return np.cross(d, m) / size + d * (d * middle).sum(axis=1, keepdims=True) / size
    if manifold.kind == "plane":
        n, w = ambient[:, :3], ambient[:, 3]
        size = np.maximum((n * n).sum(axis=1), 1e-300)
        return middle - n * (((n * middle).sum(axis=1) + w) / size)[:, None]
    return np.zeros((len(ambient), 3))


def motion(manifold: Manifold, state: FloatArray, middle: FloatArray, distance: FloatArray) -> FloatArray:
    """Derivative J (count, m, dof) of the motion in comparable units, by the increments of the chart."""
    kind, count = manifold.kind, len(state)
    basis = manifold.basis(state)
    if basis is None:
        basis = np.broadcast_to(np.eye(manifold.dof), (count, manifold.dof, manifold.dof))
    if kind == "point":
        return basis / distance[:, None, None]
    if kind == "pose":
        return np.concatenate([basis[:, :3] / distance[:, None, None], basis[:, 3:]], axis=1)
    if kind == "direction":
        return basis
    if kind == "line":
        ambient = manifold.ambient(state)
        size = np.linalg.norm(ambient[:, 3:], axis=1)[:, None, None]
        d = (ambient[:, 3:] / size[:, 0])[:, None, :]
        at = nearest_place(manifold, state, middle)
        turn = (basis[:, 3:] - np.swapaxes(d, 1, 2) * (d @ basis[:, 3:])) / size
        moment = basis[:, :3] / size - np.cross(at[:, :, None], basis[:, 3:] / size, axis=1)
        shift = np.cross(np.swapaxes(d, 1, 2), moment, axis=1)
        return np.concatenate([shift / distance[:, None, None], turn], axis=1)
    if kind == "plane":
        ambient = manifold.ambient(state)
        size = np.linalg.norm(ambient[:, :3], axis=1)[:, None, None]
        n = (ambient[:, :3] / size[:, 0])[:, None, :]
        at = nearest_place(manifold, state, middle)
        turn = (basis[:, :3] - np.swapaxes(n, 1, 2) * (n @ basis[:, :3])) / size
        shift = (basis[:, 3:] + at[:, None, :] @ basis[:, :3]) / size
        return np.concatenate([shift / distance[:, None, None], turn], axis=1)
    size = np.maximum(np.abs(state[:, : manifold.dof]), 1.0)
    return np.eye(manifold.dof) / size[:, :, None]


def weakest(information: FloatArray, J: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Standard deviations (count, dof), largest first, of the motions J delta, and these motions (count, m, dof)."""
    size = np.linalg.norm(J, axis=1)  # of each increment, whatever its unit
    _, R = np.linalg.qr(J / np.where(size > 0.0, size, 1.0)[:, None, :])
    good = np.abs(np.einsum("nii->ni", R)).min(axis=1) > 1e-12
    R = np.where(good[:, None, None], R * size[:, None, :], np.eye(R.shape[1]))
    inverse = np.linalg.inv(R)
    scaled = np.swapaxes(inverse, 1, 2) @ information @ inverse
    values, vectors = np.linalg.eigh(0.5 * (scaled + np.swapaxes(scaled, 1, 2)))
    floor = 1e-15 * np.maximum(values[:, -1:], 1e-300)
    sigma = 1.0 / np.sqrt(np.maximum(values, floor))
    sigma = np.where(values[:, -1:] > 0, sigma, np.inf)
    return sigma, J @ (inverse @ vectors)
