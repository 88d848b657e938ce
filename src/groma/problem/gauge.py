# SPDX-License-Identifier: BSD-3-Clause
r"""The freedom that a scene has as a whole: to move, to turn and to scale.

Measurements between cameras and landmarks do not change when the world frame is moved by a similarity

.. math:: X' = (1 + \sigma)\,\mathrm{Exp}(\varphi)\,X + a .

The seven directions :math:`(a, \varphi, \sigma)` are candidates for the null space of the normal equations; which of
them are free depends on the factors (a prior on one pose leaves only the scale). To first order the motion changes the
factor coordinates of points, directions, lines, planes and poses (left twist) by

.. math:: \delta X &= a + \varphi\times X + \sigma X, \qquad \delta v = \varphi\times v, \\
          \delta(m, d) &= (\sigma m + \varphi\times m + a\times d,\; \varphi\times d), \qquad
          \delta(n, w) = (\varphi\times n,\; \sigma w - n\cdot a), \\
          \delta(\rho, \omega) &= (\sigma t - R a + (R\varphi)\times t,\; -R\varphi),

and the increments of a chart with the basis B are the solution of :math:`B\,\delta = \delta(\text{coordinates})`, for
lines and planes up to their scale.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.geometry.manifold import Manifold
from groma.problem.problem import Problem


def gauge_directions(
    manifold: Manifold, state: FloatArray, center: FloatArray | None = None, length: float = 1.0, mounted: bool = False
) -> FloatArray:
    """Increments (7, count, dof) of variables under the seven world motions.

    Parameters
    ----------
    manifold : Manifold
        The chart of the variables.
    state : (count, state_size) float
        Where they are.
    center : (3,) float, optional
        Fixed point of the rotations and of the scale; the origin by default.
    length : float
        Length of the unit translations, scene units.
    mounted : bool
        The variables are poses of cameras on their rig: they do not move with the world, but share its scale.

    Returns
    -------
    (7, count, dof) float
        Translation along x, y, z, rotation about x, y, z, scale. Zero for kinds without a place in the world.
    """
    directions = np.zeros((7, len(state), manifold.dof))
    if manifold.kind not in ("point", "direction", "line", "plane", "pose") or len(state) == 0:
        return directions
    ambient = manifold.ambient(state)
    center = np.zeros(3) if center is None else center
    if manifold.kind == "pose":
        moved = _pose_motions(ambient, center, length, mounted)
        return _increments(manifold, state, ambient, moved).transpose(2, 0, 1)
    moved = np.empty((len(state), manifold.factor_columns, 7))
    for k in range(7):
        a, rotation, scale = np.zeros(3), np.zeros(3), float(k == 6)
        # derived from three translations, three rotations and a scale
        if k < 3:
            a[k] = length
        elif k < 6:  # derived from the same
            rotation[k - 3] = 1.0
        a = a - np.cross(rotation, center) - scale * center
        moved[:, :, k] = _coordinate_motion(manifold.kind, ambient, a, rotation, scale)
    return _increments(manifold, state, ambient, moved).transpose(2, 0, 1)


def world_motions(problem: Problem, center: FloatArray | None = None, length: float = 1.0) -> dict[str, FloatArray]:
    """Increments (7, count, dof) of every group of a problem under the seven world motions."""
    mounted = {
        ref.group for factor in problem.factors for slot, ref in factor.references() if slot.name == "extrinsics"
    }
    return {
        name: gauge_directions(group.manifold, group.state, center, length, name in mounted)
        for name, group in problem.variables.items()
    }


def _coordinate_motion(kind: str, ambient: FloatArray, a: FloatArray, rotation: FloatArray, scale: float) -> FloatArray:
    """Change (count, factor_columns) of the factor coordinates but of poses; formulas at the top of this module."""
    turning = _turning(rotation)
    if kind == "point":
        return a + ambient @ turning + scale * ambient
    if kind == "direction":
        return ambient @ turning
    if kind == "line":
        m, d = ambient[:, :3], ambient[:, 3:]
        return np.hstack([scale * m + m @ turning + d @ _turning(a), d @ turning])
    n, w = ambient[:, :3], ambient[:, 3:]
    return np.hstack([n @ turning, scale * w - (n @ a)[:, None]])


def _pose_motions(ambient: FloatArray, center: FloatArray, length: float, mounted: bool) -> FloatArray:
    r"""Left twists (count, 6, 7) of poses under the seven motions about ``center``, which lies at c in the cameras.

    With :math:`a = -\varphi\times o` of a rotation about o, :math:`-R a + (R\varphi)\times t` is
    :math:`(R\varphi)\times c`.
    """
    T = ambient.reshape(-1, 3, 4)
    R, t = T[:, :, :3], T[:, :, 3]
    moved = np.zeros((len(T), 6, 7))
    if mounted:
        moved[:, :3, 6] = t
        return moved
    c = R @ center + t
    x, y, z = c[:, 0, None], c[:, 1, None], c[:, 2, None]
    moved[:, :3, :3] = -length * R
    moved[:, 0, 3:6] = R[:, 1] * z - R[:, 2] * y
    moved[:, 1, 3:6] = R[:, 2] * x - R[:, 0] * z
    moved[:, 2, 3:6] = R[:, 0] * y - R[:, 1] * x
    moved[:, 3:, 3:6] = -R
    moved[:, :3, 6] = c
    return moved


def _turning(v: FloatArray) -> FloatArray:
    """Return the matrix M of the cross product with every row: x @ M is v x x."""
    return np.array([[0.0, v[2], -v[1]], [-v[2], 0.0, v[0]], [v[1], -v[0], 0.0]])


def _increments(manifold: Manifold, state: FloatArray, ambient: FloatArray, moved: FloatArray) -> FloatArray:
    """Solve B delta = moved (count, factor_columns, k), for lines and planes modulo the scale of their numbers."""
    basis = manifold.basis(state)
    if basis is None:
        return moved
    if manifold.kind == "pose":
        return np.linalg.solve(basis, moved).astype(np.float64)
    if manifold.kind in ("line", "plane"):
        # far objects keep their digits when lengths are measured in their distance
        near, far = (slice(3, 6), slice(0, 3)) if manifold.kind == "line" else (slice(0, 3), slice(3, 4))
        size = np.linalg.norm(ambient[:, near], axis=1, keepdims=True)
        distance = np.linalg.norm(ambient[:, far], axis=1, keepdims=True) / np.where(size > 0.0, size, np.inf)
        lengths = np.ones_like(ambient)
        lengths[:, far] = np.maximum(distance, 1.0)
        unit = ambient / lengths
        unit = unit / np.linalg.norm(unit, axis=1, keepdims=True)
        basis, moved = basis / lengths[:, :, None], moved / lengths[:, :, None]
        basis = basis - unit[:, :, None] * (unit[:, None, :] @ basis)
        moved = moved - unit[:, :, None] * (unit[:, None, :] @ moved)
    norms = np.linalg.norm(basis, axis=1)
    norms = np.where(norms > 1e-14 * norms.max(axis=1, keepdims=True, initial=0.0), norms, np.inf)[:, :, None]
    basis = basis / np.swapaxes(norms, 1, 2)
    gram, target = np.swapaxes(basis, 1, 2) @ basis, np.swapaxes(basis, 1, 2) @ moved
    result = np.zeros_like(target)
    regular = np.abs(np.linalg.det(gram)) > 1e-8
    result[regular] = np.linalg.solve(gram[regular], target[regular])
    if not regular.all():
        rest = ~regular
        result[rest] = np.linalg.pinv(basis[rest]) @ moved[rest]
    return result / norms
