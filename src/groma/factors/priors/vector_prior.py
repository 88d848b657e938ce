# SPDX-License-Identifier: BSD-3-Clause
r"""Numbers are known: a surveyed point, the intrinsics of a calibration.

.. math:: r = x - \tilde x, \qquad \frac{\partial r}{\partial x} = I

for any variable that moves by addition (a point, intrinsics, a vector), or for some of its coordinates. For poses there
are :mod:`groma.factors.priors.pose_prior` and :mod:`groma.factors.priors.position_prior`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._typing import Columns, FloatArray, Inputs
from groma.errors import ShapeError
from groma.factors._examples import indices, make_example
from groma.factors.contract import WORLD_FIXED, Example, Factor, Invariance, Ref, Slot, register
from groma.geometry.manifold import Euclidean


@register("vector_prior")
@dataclass(frozen=True, kw_only=True)
class VectorPrior(Factor):
    """Known values of points, intrinsics or other plain numbers; residual in their units."""

    #: The variables.
    variable: Ref
    #: (N, k) measured values, k being the size of the variables, or the number of ``coordinates``.
    measured: FloatArray
    #: Which of their numbers are known; None: all.
    coordinates: tuple[int, ...] | None = None

    slots: ClassVar[tuple[Slot, ...]] = (Slot("variable", "vector"),)
    invariance: ClassVar[Invariance] = WORLD_FIXED

    def __post_init__(self) -> None:
        measured = np.ascontiguousarray(self.measured, dtype=np.float64)
        if measured.ndim != 2 or len(measured) != len(self):
            raise ShapeError(
                f"VectorPrior.measured must have shape ({len(self)}, k), one row for each index; got {measured.shape}."
            )
        object.__setattr__(self, "measured", measured)

    @property
    def residual_size(self) -> int:  # noqa: D102
        return self.measured.shape[1]

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        size = ambients[0].shape[1]
        known = np.arange(size)[slice(None) if self.coordinates is None else list(self.coordinates)]
        if len(known) != self.residual_size:
            raise ShapeError(
                f"VectorPrior.measured has {self.residual_size} columns, but the variables of group "
                f"{self.variable.group!r} have {len(known)} numbers{'' if self.coordinates is None else ' to know'}. "
                "Pass one value for each number."
            )
        return ambients[0], np.eye(size)[known]

    def residuals(self, inputs: tuple[Any, ...], begin: int, end: int, out: FloatArray) -> int:  # noqa: D102
        values = inputs[0][self.variable.index[begin:end]]
        if self.coordinates is not None:
            values = values[:, list(self.coordinates)]
        np.subtract(values, self.measured[begin:end], out=out)
        return 0

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        self.residuals(inputs, begin, end, record[:, :, -1])
        if columns[0] >= 0:
            record[:, :, columns[0] : columns[0] + inputs[1].shape[1]] = inputs[1]
        return 0

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(variable=Ref("vectors", indices(rng, 4)), measured=rng.normal(size=(6, 5)))
        return make_example(factor, rng, manifolds={"vectors": Euclidean(5)})
