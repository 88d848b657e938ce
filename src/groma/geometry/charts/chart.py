# SPDX-License-Identifier: BSD-3-Clause
r"""What the charts of lines and planes share: checks at the door, a rule for perpendicular vectors, a quaternion step.

The rule for two vectors perpendicular to a unit vector d has to be the same every time a chart reads it, or the
coordinates of an increment would change their meaning. It is, with s = 1 for :math:`d_z \ge 0` and -1 otherwise and
:math:`a = -1/(s + d_z)`,

.. math:: b_1 = (1 + s a d_x^2,\; s a d_x d_y,\; -s d_x), \qquad b_2 = (a d_x d_y,\; s + a d_y^2,\; -d_y),

so that (b1, b2, d) is orthonormal and right-handed. It is free of square roots and of loss of digits, and it jumps
only where :math:`d_z` changes its sign.

References
----------
Duff et al., *Building an Orthonormal Basis, Revisited*, Journal of Computer Graphics Techniques, 2017, listing 3.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import BoolArray, FloatArray
from groma.errors import InputError, ShapeError
from groma.geometry import quaternion
from groma.geometry.algebra import as_rows
from groma.geometry.manifold import Manifold
from groma.geometry.quaternion import exp_kernel, multiply_kernel


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def perpendicular_kernel(x, y, z, b):
    """Write two unit vectors to the rows of b (2, 3) so that (b1, b2, (x, y, z)) is orthonormal and right-handed."""
    s = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (s + z)
    c = x * y * a
    b[0, 0] = 1.0 + s * x * x * a
    b[0, 1] = s * c
    b[0, 2] = -s * x
    b[1, 0] = c
    b[1, 1] = s + y * y * a
    b[1, 2] = -y


@kernel
def turn_kernel(q, omega, left, step, out):
    """Write exp(omega) q (left) or q exp(omega) to out (4,), of unit length; ``step`` (4,) is scratch."""
    exp_kernel(omega, step)
    if left:
        multiply_kernel(step, q, out)
    else:
        multiply_kernel(q, step, out)
    k = 1.0 / math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
    for j in range(4):
        out[j] *= k


@kernel
def minus_skew_kernel(x, y, z, row, B):
    """Write -[v]x, the derivative of a turned vector, to three rows of B from ``row`` on."""
    B[row, 0], B[row, 1], B[row, 2] = 0.0, z, -y
    B[row + 1, 0], B[row + 1, 1], B[row + 1, 2] = -z, 0.0, x
    B[row + 2, 0], B[row + 2, 1], B[row + 2, 2] = y, -x, 0.0


@loop
def turn_and_add_all(state, delta, left, out):
    """Turn the quaternions ``state[:, :4]`` by ``delta[:, :3]``, from the left or the right; add the last numbers."""
    step = np.empty(4)
    for i in range(state.shape[0]):
        turn_kernel(state[i, :4], delta[i, :3], left, step, out[i, :4])
        out[i, 4] = state[i, 4] + delta[i, 3]


# ------------------------------------------------------------------------------------------------------------- Public
def perpendicular(direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors (N, 3) perpendicular to unit vectors (N, 3), by the rule at the top of this module."""
    x, y, z = direction.T
    s = np.where(z >= 0.0, 1.0, -1.0)
    a = -1.0 / (s + z)
    first = np.stack([1.0 + s * x * x * a, s * a * x * y, -s * x], axis=1)
    second = np.stack([a * x * y, s + a * y * y, -y], axis=1)
    return first, second


def as_steps(state: FloatArray, delta: FloatArray, size: int, dof: int) -> tuple[FloatArray, FloatArray]:
    """Return states (N, size) and increments (N, dof), or raise a ShapeError."""
    state, delta = as_rows(state, (size,), "state"), as_rows(delta, (dof,), "delta")
    if len(state) != len(delta):
        raise ShapeError(f"state and delta must have as many rows; got {len(state)} and {len(delta)}.")
    return state, delta


def reject(bad: BoolArray, rows: FloatArray, expected: str, remedy: str) -> None:
    """Raise an InputError that names the first of the ``bad`` rows, if there is one."""
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise InputError(f"{expected}; row {first} is {rows[first].tolist()}. {remedy}")


def unit(vectors: FloatArray) -> FloatArray:
    """Vectors (N, k) divided by their lengths, none of which may be zero; tiny and huge ones keep their digits."""
    largest = np.abs(vectors).max(axis=1, keepdims=True)
    scaled = vectors / largest
    return scaled / np.linalg.norm(scaled, axis=1, keepdims=True)


def turn_between(first: FloatArray, second: FloatArray, left: bool) -> FloatArray:
    """Rotation vectors (N, 3) from unit quaternions (N, 4) to others, applied from the left or from the right."""
    inverse = quaternion.conjugate(first)
    return quaternion.log(quaternion.multiply(second, inverse) if left else quaternion.multiply(inverse, second))


def random_lines(rng: np.random.Generator, count: int) -> FloatArray:
    """Plücker lines (count, 6) in general position: unit direction, 0.5 to 2 units from the origin."""
    direction = unit(rng.normal(size=(count, 3)))
    moment = unit(np.cross(rng.normal(size=(count, 3)), direction)) * rng.uniform(0.5, 2.0, (count, 1))
    return np.hstack([moment, direction])


def random_planes(rng: np.random.Generator, count: int) -> FloatArray:
    """Planes (count, 4) in general position: unit normal, 0.5 to 2 units from the origin on either side."""
    offset = rng.uniform(0.5, 2.0, (count, 1)) * rng.choice([-1.0, 1.0], (count, 1))
    return np.hstack([unit(rng.normal(size=(count, 3))), offset])


class Chart(Manifold):
    """A chart of points, lines or planes: the sizes of its kind, and checks of shapes."""

    _SIZES: ClassVar[dict[str, tuple[int, int]]] = {"point": (3, 3), "line": (6, 4), "plane": (4, 3)}

    def __init__(self) -> None:
        self.ambient_size, self.dof = self._SIZES[self.kind]
        self.factor_columns = self.ambient_size

    def ambient(self, state: FloatArray) -> FloatArray:
        """Return the state itself, which is what factors read."""
        return self._checked_state(state)

    def random(self, rng: np.random.Generator, count: int) -> FloatArray:
        """Lines or planes 0.5 to 2 units from the origin."""
        return self.from_ambient((random_lines if self.kind == "line" else random_planes)(rng, count))

    def _checked_state(self, state: FloatArray, name: str = "state") -> FloatArray:
        return as_rows(state, (self.state_size,), name)

    def _checked_step(self, state: FloatArray, delta: FloatArray) -> tuple[FloatArray, FloatArray]:
        return as_steps(state, delta, self.state_size, self.dof)

    def _checked_pair(self, state: FloatArray, other: FloatArray) -> tuple[FloatArray, FloatArray]:
        state, other = self._checked_state(state), self._checked_state(other, "other")
        if len(state) != len(other):
            raise ShapeError(f"state and other must have as many rows; got {len(state)} and {len(other)}.")
        return state, other

    def _checked_ambient(self, ambient: FloatArray) -> FloatArray:
        """Rows of finite numbers that are not all zero, scaled so that the largest number of each row is 1."""
        ambient = as_rows(ambient, (self.ambient_size,), "ambient")
        # Scaled first, so that no square underflows or overflows.
        names = "(m, d)" if self.kind == "line" else "(n, w)"
        remedy = f"Drop it, or build the {self.kind} again from other data."
        infinite = np.asarray(~np.isfinite(ambient).all(axis=1))
        reject(infinite, ambient, f"A {self.kind} {names} must consist of finite numbers", remedy)
        largest = np.abs(ambient).max(axis=1, keepdims=True, initial=0.0)
        reject(largest[:, 0] == 0.0, ambient, f"A {self.kind} {names} must not be all zeros", remedy)
        return ambient / largest

    # The loops of a chart take states, then what else they need, then the output.

    def _retracted(self, loop: Callable, state: FloatArray, delta: FloatArray, *form: Any) -> FloatArray:
        """Check states and increments, and let a loop write the states they lead to."""
        state, delta = self._checked_step(state, delta)
        out = np.empty_like(state)
        loop(state, delta, *form, out)
        return out

    def _ambient_by(self, loop: Callable, state: FloatArray) -> FloatArray:
        """Check states, and let a loop write what factors read of them, (N, ambient_size)."""
        state = self._checked_state(state)
        out = np.empty((len(state), self.ambient_size))
        loop(state, out)
        return out

    def _basis_by(self, loop: Callable, state: FloatArray, *form: Any) -> FloatArray:
        """Check states, and let a loop write their bases, (N, factor_columns, dof)."""
        state = self._checked_state(state)
        out = np.empty((len(state), self.factor_columns, self.dof))
        loop(state, *form, out)
        return out
