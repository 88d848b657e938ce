# SPDX-License-Identifier: BSD-3-Clause
r"""Quantities between variables and their uncertainty: lengths, distances, angles.

Each is the length of a small vector of smooth functions, :math:`q = \lVert e \rVert`; the angle between two directions
is :math:`\mathrm{atan2}(\lVert d\times d'\rVert, d\cdot d')`. Where e is larger than its own uncertainty, q varies as e
does along itself. Where it is not (two lines that are parallel within the noise), q has no derivative; the standard
deviation is then the largest of e in any direction, and q should be read as *zero within sigma*.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError, check_kind
from groma.solver.covariance.marginals import Covariances, Variable


@dataclass(frozen=True)
class Quantity:
    """A length or an angle with its standard deviation."""

    #: Scene units or radians.
    value: float
    sigma: float


def length_between_points(covariances: Covariances, first: Variable, second: Variable) -> Quantity:
    """Distance between two points."""
    return _norm(covariances, first, second, ("point", "point"), lambda a, b: b - a)


def distance_between_cameras(covariances: Covariances, first: Variable, second: Variable) -> Quantity:
    """Distance between the centres of two poses ``cam_from_world``."""
    return _norm(covariances, first, second, ("pose", "pose"), lambda a, b: _center(b) - _center(a))


def distance_point_plane(covariances: Covariances, point: Variable, plane: Variable) -> Quantity:
    """Signed distance of a point from a plane, positive on the side of the normal."""
    _check(covariances, (point, plane), ("point", "plane"))
    derived = covariances.derived(lambda p, h: (h[:3] @ p + h[3]) / np.linalg.norm(h[:3]), (point, plane))
    return Quantity(float(derived.value[0]), float(derived.sigma[0]))


def distance_point_line(covariances: Covariances, point: Variable, line: Variable) -> Quantity:
    """Distance of a point from a line."""
    return _norm(
        covariances, point, line, ("point", "line"), lambda p, q: (q[:3] - np.cross(p, q[3:])) / np.linalg.norm(q[3:])
    )


def distance_between_planes(
    covariances: Covariances, first: Variable, second: Variable, at: FloatArray | None = None
) -> Quantity:
    """Signed distance of the second plane from a point on the first, along the first's normal.

    Planes that are not exactly parallel have different distances in different places; ``at`` (3,) says where, and is
    projected on the first plane. By default the foot point of the origin.
    """
    _check(covariances, (first, second), ("plane", "plane"))
    place = np.zeros(3) if at is None else np.asarray(at, float)

    def function(a: FloatArray, b: FloatArray) -> float:
        a, b = a / np.linalg.norm(a[:3]), b / np.linalg.norm(b[:3])
        on_first = place - (a[:3] @ place + a[3]) * a[:3]
        return -(b[:3] @ on_first + b[3]) / (a[:3] @ b[:3])

    derived = covariances.derived(function, (first, second))
    return Quantity(float(derived.value[0]), float(derived.sigma[0]))


def angle_between_lines(covariances: Covariances, first: Variable, second: Variable) -> Quantity:
    """Angle between two lines, 0 to pi/2: lines have no orientation."""
    return _angle(covariances, first, second, ("line", "line"), slice(3, 6), slice(3, 6))


def angle_between_planes(covariances: Covariances, first: Variable, second: Variable) -> Quantity:
    """Angle between the normals of two planes, 0 to pi/2."""
    return _angle(covariances, first, second, ("plane", "plane"), slice(0, 3), slice(0, 3))


def angle_line_plane(covariances: Covariances, line: Variable, plane: Variable) -> Quantity:
    """Angle of a line above a plane, 0 to pi/2."""
    off = _angle(covariances, line, plane, ("line", "plane"), slice(3, 6), slice(0, 3))
    return Quantity(np.pi / 2 - off.value, off.sigma)


def _angle(
    covariances: Covariances, first: Variable, second: Variable, kinds: tuple[str, str], a: slice, b: slice
) -> Quantity:
    """Angle between the directions at ``a`` and ``b`` of what factors read of the two variables."""
    _check(covariances, (first, second), kinds)
    ambients = [
        covariances.problem.variables[g].manifold.ambient(covariances.problem.variables[g].state[i : i + 1])[0]
        for g, i in (first, second)
    ]
    u, v = (x[part] / np.linalg.norm(x[part]) for x, part in zip(ambients, (a, b), strict=True))
    sign = 1.0 if u @ v >= 0 else -1.0
    # two rows perpendicular to both directions and between them: e rotates and opens the angle
    axis = np.cross(u, sign * v)
    sine = float(np.linalg.norm(axis))
    value = float(np.arctan2(sine, abs(float(u @ v))))

    def opening(x: FloatArray, y: FloatArray) -> FloatArray:
        x, y = x[a] / np.linalg.norm(x[a]), sign * y[b] / np.linalg.norm(y[b])
        return np.cross(x, y)

    derived = covariances.derived(opening, (first, second))
    sigma = _length_sigma(derived.value, derived.covariance)
    cosine = abs(float(u @ v))
    # derived from 45 degrees: beyond, the sine is the flatter one, towards a right angle
    if cosine < 0.7:
        dot = covariances.derived(
            lambda x, y: x[a] @ y[b] / np.linalg.norm(x[a]) / np.linalg.norm(y[b]), (first, second)
        )
        return Quantity(value, float(dot.sigma[0]) / sine)
    return Quantity(value, sigma / cosine)


def _norm(
    covariances: Covariances, first: Variable, second: Variable, kinds: tuple[str, str], function: Callable
) -> Quantity:
    """Length of the vector that a function makes of two variables."""
    _check(covariances, (first, second), kinds)
    derived = covariances.derived(function, (first, second))
    return Quantity(float(np.linalg.norm(derived.value)), _length_sigma(derived.value, derived.covariance))


def _length_sigma(e: FloatArray, covariance: FloatArray) -> float:
    if not np.isfinite(covariance).all():
        return float("nan")
    largest = float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
    size = float(np.linalg.norm(e))
    if size <= largest or size == 0.0:
        return largest
    return float(np.sqrt(max(e @ covariance @ e, 0.0))) / size


def _center(T: FloatArray) -> FloatArray:
    pose = T.reshape(3, 4)
    return -pose[:, :3].T @ pose[:, 3]


def _check(covariances: Covariances, variables: tuple[Variable, ...], kinds: tuple[str, ...]) -> None:
    check_kind(covariances, Covariances, "covariances", "Make them of a problem: Covariances(problem).")
    for variable, kind in zip(variables, kinds, strict=True):
        check_kind(variable, tuple, "A variable", "Pass (group, index).")
        group = variable[0]
        known = covariances.problem.variables
        if group not in known or known[group].manifold.kind != kind:
            found = known[group].manifold.kind if group in known else "no group"
            raise InputError(f"Expected a variable of kind {kind!r}; {group!r} is {found}. Pass (group, index).")
