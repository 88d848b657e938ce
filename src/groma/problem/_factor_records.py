# SPDX-License-Identifier: BSD-3-Clause
"""The records of one factor group, a few factors at a time in a scratch that stays in cache."""

from __future__ import annotations

import threading

import numpy as np

from groma._simd import width_for
from groma._typing import BoolArray, FloatArray
from groma.problem._records import chain_rule, cost_scaled, cost_whitened, weigh, whiten
from groma.problem.layout import FactorLayout, Layout


class Noise:
    """The noise and the loss of a factor group in the form the loops take."""

    def __init__(self, layout: FactorLayout) -> None:
        factor = layout.factor
        information = np.asarray(factor.sqrt_information, dtype=np.float64)
        self.matrices: FloatArray | None = None
        self.scale = np.ones(1)
        self.step = 0
        if information.ndim == 3:
            self.matrices = np.ascontiguousarray(information)
        elif information.ndim == 1:
            self.scale, self.step = np.ascontiguousarray(information), 1
        else:
            self.scale = information.reshape(1)
        self.loss = factor.loss.tag, factor.loss.parameters


class FactorRecords:
    """Evaluates the factors of one group: their cost, or whitened, weighted records in the coordinates of the charts.

    Parameters
    ----------
    layout : FactorLayout
        The factors.
    most : int
        How many there are at once, at most.
    largest : int
        How many there are in the largest group.
    held : dict
        By group of variables, which of their coordinates (count, dof) are held.
    """

    def __init__(self, layout: FactorLayout, most: int, largest: int, held: dict[str, BoolArray]) -> None:
        self.layout = layout
        self.references = tuple(ref for _, ref in layout.factor.references())
        self.sized = width_for(len(layout.factor), largest)
        self._noise, self._held = Noise(layout), held
        self._room = most * (layout.factor.residual_size * layout.width + 1)  # records, and their norms
        self._scratch = threading.local()  # one per thread

    @property
    def most_costs(self) -> int:
        """Of how many factors the residuals fit where records do: costs need less room."""
        return self._room // (self.layout.factor.residual_size + 1)

    def _record(self) -> FloatArray:
        if not hasattr(self._scratch, "record"):
            self._scratch.record = np.zeros(self._room)
        return self._scratch.record

    def cost(self, inputs: tuple, begin: int, end: int, costs: FloatArray) -> tuple[float, int]:
        """Return the cost of factors, and how many are degenerate; add to the costs of their landmarks."""
        layout, noise = self.layout, self._noise
        n, m = end - begin, layout.factor.residual_size
        out = self._record()[: n * m].reshape(n, m)
        degenerate = layout.factor.residuals(inputs, begin, end, out)
        if noise.matrices is not None:
            value = cost_whitened(out, begin, noise.matrices, *noise.loss, layout.landmark, costs)
        else:
            value = cost_scaled(out, begin, noise.scale, noise.step, *noise.loss, layout.landmark, costs)
        return value, degenerate

    def linearize(
        self, inputs: tuple, begin: int, end: int, bases: dict[str, FloatArray]
    ) -> tuple[FloatArray, float, int]:
        """Return the records of factors, their cost, and how many are degenerate."""
        layout, noise, sized = self.layout, self._noise, self.sized
        n, m = end - begin, layout.factor.residual_size
        flat = self._record()
        record = flat[: n * m * layout.width].reshape(n, m, layout.width)
        norms = flat[len(flat) - n :]
        if layout.has_gaps:
            record[:] = 0.0
        degenerate = layout.factor.linearize(inputs, begin, end, layout.columns, record)
        if noise.matrices is not None:
            whiten(record, begin, noise.matrices)
        cost = weigh(record, begin, noise.scale, noise.step, *noise.loss, norms)
        for chain in layout.chains:
            ref = self.references[chain.reference]
            chain_rule(
                record, begin, chain.raw_column, chain.column, ref.index, bases[ref.group],
                sized(chain.raw_size), sized(chain.dof), sized(1),
            )  # fmt: skip
        for reference, column, _ in layout.masked:
            ref = self.references[reference]
            held = self._held[ref.group][ref.index[begin:end], None]
            np.copyto(record[:, :, column : column + held.shape[2]], 0.0, where=held)
        return record, cost, degenerate


def records_of(layout: Layout, most: list[int]) -> list[FactorRecords]:
    """Return the records of each factor group, of which so many are evaluated at once."""
    held: dict[str, BoolArray] = {}
    for factor in layout.factors:
        references = [ref for _, ref in factor.factor.references()]
        for name in {references[reference].group for reference, _, _ in factor.masked} - held.keys():
            free = layout.problem.variables[name].free_coordinates()
            assert free is not None
            order = next((e.order for e in layout.eliminated if e.group == name), None)
            held[name] = ~(free if order is None else free[order])
    largest = max((len(factor.factor) for factor in layout.factors), default=0)
    return [FactorRecords(factor, n, largest, held) for factor, n in zip(layout.factors, most, strict=True)]
