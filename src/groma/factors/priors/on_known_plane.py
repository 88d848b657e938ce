# SPDX-License-Identifier: BSD-3-Clause
r"""A place is on a plane whose coordinates are known: a height, a levelled floor, a wall in the frame of a building.

.. math:: r = \hat n \cdot q + \tilde w, \qquad \frac{\partial r}{\partial q} = \hat n^\top

with the known unit normal and offset, and the place q on a camera, point, line or plane of
:mod:`groma.factors.priors._places`. A line takes two places, a plane three.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example, random_poses
from groma.factors.contract import WORLD_FIXED, Example, Factor, Invariance, Measurement, Ref, Slot, register
from groma.factors.priors._places import KINDS, place_on, put_place


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _linearize_all(rows, index, kind, arm, planes, begin, end, column, record):
    q, g = np.empty(3), np.empty(3)
    degenerate, last = 0, record.shape[2] - 1
    for i in range(begin, end):
        out, row = record[i - begin, 0], rows[index[i]]
        usable = place_on(kind, row, arm[i], q)
        degenerate += 0 if usable else 1
        out[last] = planes[i, 3] if usable else 0.0
        for j in range(3):
            g[j] = planes[i, j] if usable else 0.0
            out[last] += g[j] * q[j] if usable else 0.0
        if column >= 0 and usable:
            put_place(kind, row, arm[i], q, g, out, column)
        elif column >= 0:
            for j in range((6, 3, 6, 4)[kind]):
                out[column + j] = 0.0
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("on_known_plane")
@dataclass(frozen=True, kw_only=True)
class OnKnownPlane(Factor):
    """Places on known planes; residual in scene units. Exactly one of the four references is given."""

    camera: Ref | None = None
    point: Ref | None = None
    line: Ref | None = None
    plane: Ref | None = None
    #: (N, 4) known planes (n, w), of any scale.
    known: FloatArray
    #: (N, 3) as in :class:`~groma.factors.priors.distance.Distance`.
    arm: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = tuple(
        Slot(name, kind, optional=True) for name, kind in zip(("camera", "point", "line", "plane"), KINDS, strict=True)
    )
    rows: ClassVar[int] = 1
    invariance: ClassVar[Invariance] = WORLD_FIXED

    measurements: ClassVar[tuple[Measurement, ...]] = (
        Measurement("known", (4,), num_normalized=3),
        Measurement("arm", (3,)),
    )

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        return (np.ascontiguousarray(ambients[0]),)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        ((slot, ref),) = self.references()
        kind = KINDS.index(slot.kind)
        return _linearize_all(inputs[0], ref.index, kind, self.arm, self.known, begin, end, columns[0], record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        return cls.of(rng, "camera")

    @classmethod
    def of(cls, rng: np.random.Generator, kind: str) -> Example:
        """Return an example of one kind: ``camera``, ``point``, ``line`` or ``plane``."""
        known, arm = rng.normal(size=(6, 4)), rng.normal(size=(6, 3))
        factor = cls(**{kind: Ref("objects", indices(rng, 4))}, known=known, arm=arm)  # type: ignore[arg-type]
        poses = {"objects": random_poses(rng, 4, rotation=0.7)} if kind == "camera" else {}
        return make_example(factor, rng, states=poses)
