# SPDX-License-Identifier: BSD-3-Clause
r"""A direction is known: gravity in a camera, by its accelerometer; a line or plane that is vertical.

The turn that takes the known unit vector g to the direction u, in two axes B across g:

.. math:: r = \frac{\theta}{\sin\theta}\, B^\top u, \qquad \cos\theta = g\cdot u, \qquad
          \lVert r\rVert = \theta, \qquad
          \frac{\partial r}{\partial u} = f\,B^\top + f'\,(B^\top u)\,g^\top, \quad
          f = \frac{\theta}{\sin\theta},\; f' = \frac{f\cos\theta - 1}{\sin^2\theta} .

Of a camera :math:`u = R v` is a direction v of the world seen from it, with
:math:`\partial u/\partial\omega = -[u]_\times` for left increments. Of a line u is its direction, of a plane its
normal, either way round: :math:`u = \pm d/\lVert d\rVert`, so that :math:`g\cdot u \ge 0`. Where u is opposite to g the
axis of the turn is not defined, and the factor is degenerate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example, random_poses
from groma.factors._rig import EXTRINSICS, POSE, CameraFactor
from groma.factors.contract import Example, Factor, Invariance, Measurement, Ref, Slot, register
from groma.geometry.manifold import FACTOR_COLUMNS

#: Of factors that compare directions with those of the world.
_TURNED = Invariance(rotation=False, scale=True)


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _turn(basis, u, r, J):
    """Write the turn r (2,) from g to u and its derivative J (2, 3) by u; ``basis`` (3, 3) has rows B and g."""
    x = basis[0, 0] * u[0] + basis[0, 1] * u[1] + basis[0, 2] * u[2]
    y = basis[1, 0] * u[0] + basis[1, 1] * u[1] + basis[1, 2] * u[2]
    c = basis[2, 0] * u[0] + basis[2, 1] * u[1] + basis[2, 2] * u[2]
    s = math.sqrt(x * x + y * y)
    if s > 1e-4:
        f = math.atan2(s, c) / s
        slope = (f * c - 1.0) / (s * s)
    elif c > 0.0:  # series at no turn: theta / sin(theta) = 1 + theta^2 / 6
        f, slope = 1.0 + s * s / 6.0, -1.0 / 3.0
    else:
        return False
    r[0], r[1] = f * x, f * y
    for j in range(3):
        J[0, j] = f * basis[0, j] + slope * x * basis[2, j]
        J[1, j] = f * basis[1, j] + slope * y * basis[2, j]
    return True


@loop
def _of_cameras(poses, index, vectors, bases, begin, end, column, record):
    u, r, J = np.empty(3), np.empty(2), np.empty((2, 3))
    degenerate, last = 0, record.shape[2] - 1
    for i in range(begin, end):
        T, v, out = poses[index[i]], vectors[i], record[i - begin]
        for j in range(3):
            u[j] = T[4 * j] * v[0] + T[4 * j + 1] * v[1] + T[4 * j + 2] * v[2]
        if not _turn(bases[i], u, r, J):
            r[:], J[:] = 0.0, 0.0
            degenerate += 1
        for k in range(2):
            out[k, last] = r[k]
            if column >= 0:
                out[k, column : column + 3] = 0.0
                out[k, column + 3] = u[1] * J[k, 2] - u[2] * J[k, 1]
                out[k, column + 4] = u[2] * J[k, 0] - u[0] * J[k, 2]
                out[k, column + 5] = u[0] * J[k, 1] - u[1] * J[k, 0]
    return degenerate


@loop
def _of_landmarks(states, index, offset, width, bases, begin, end, column, record):
    u, r, J = np.empty(3), np.empty(2), np.empty((2, 3))
    degenerate, last = 0, record.shape[2] - 1
    for i in range(begin, end):
        out, d, g = record[i - begin], states[index[i], offset : offset + 3], bases[i, 2]
        size = math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
        side = -1.0 if d[0] * g[0] + d[1] * g[1] + d[2] * g[2] < 0.0 else 1.0
        for j in range(3):
            u[j] = side * d[j] / size if size > 1e-100 else 0.0
        usable = size > 1e-100 and _turn(bases[i], u, r, J)
        degenerate += 0 if usable else 1
        for k in range(2):
            out[k, last] = r[k] if usable else 0.0
            if column >= 0:
                out[k, column : column + width] = 0.0
                if usable:  # of the unit vector: across it, by the length
                    along = J[k, 0] * u[0] + J[k, 1] * u[1] + J[k, 2] * u[2]
                    for j in range(3):
                        out[k, column + offset + j] = side * (J[k, j] - along * u[j]) / size
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
def bases_of(directions: FloatArray) -> FloatArray:
    """Return axes (N, 3, 3) of unit vectors (N, 3): two across each, and itself."""
    least = np.argmin(np.abs(directions), axis=1)
    first = np.cross(directions, np.eye(3)[least])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(directions, first), directions], axis=1).astype(np.float64)


@register("camera_direction")
@dataclass(frozen=True, kw_only=True)
class CameraDirection(CameraFactor):
    """Directions of the world measured in cameras: gravity, the sun; residual in radians."""

    #: (N, 3) directions in the world and in the camera, of any length.
    in_world: FloatArray
    in_camera: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, EXTRINSICS)
    measurements: ClassVar[tuple[Measurement, ...]] = (
        Measurement("in_world", (3,), num_normalized=3),
        Measurement("in_camera", (3,), num_normalized=3),
    )
    invariance: ClassVar[Invariance] = _TURNED
    rows: ClassVar[int] = 2

    @cached_property
    def _bases(self) -> FloatArray:
        return bases_of(self.in_camera)

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return _of_cameras(*inputs, self.in_world, self._bases, begin, end, *columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 4)),
            in_world=rng.normal(size=(6, 3)) * [0.2, 0.2, 1.0] + [0.0, 0.0, 3.0],
            in_camera=rng.normal(size=(6, 3)) * [0.2, 0.2, 1.0] + [0.0, 0.0, 3.0],
        )
        return make_example(factor, rng, states={"poses": random_poses(rng, 4, rotation=0.7)})


@register("known_direction")
@dataclass(frozen=True, kw_only=True)
class KnownDirection(Factor):
    """Lines, planes or directions along known ones; residual in radians. Exactly one reference is given."""

    line: Ref | None = None
    plane: Ref | None = None
    direction: Ref | None = None
    #: (N, 3) known directions of lines and vanishing directions, normals of planes; of any length and either way round.
    known: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = tuple(
        Slot(kind, kind, optional=True) for kind in ("line", "plane", "direction")
    )
    invariance: ClassVar[Invariance] = _TURNED
    rows: ClassVar[int] = 2

    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("known", (3,), num_normalized=3),)

    @cached_property
    def _bases(self) -> FloatArray:
        return bases_of(self.known)

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        return (np.ascontiguousarray(ambients[0]),)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        ((slot, ref),) = self.references()
        layout = 3 if slot.kind == "line" else 0, FACTOR_COLUMNS[slot.kind]
        return _of_landmarks(inputs[0], ref.index, *layout, self._bases, begin, end, columns[0], record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        return cls.of(rng, "line")

    @classmethod
    def of(cls, rng: np.random.Generator, kind: str) -> Example:
        """Return an example of one kind: ``line``, ``plane`` or ``direction``."""
        factor = cls(**{kind: Ref("objects", indices(rng, 4))}, known=rng.normal(size=(6, 3)))  # type: ignore[arg-type]
        return make_example(factor, rng)
