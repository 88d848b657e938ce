# SPDX-License-Identifier: BSD-3-Clause
r"""Does a factor keep its contract? One function, for our factors and for those of others.

The analytic Jacobian is compared with differences of the residual *through the charts*: with the residual r, the block
J in factor coordinates, and a chart with retraction :math:`\boxplus` and basis B, column k of J B must equal

.. math:: \left.\frac{\mathrm{d}}{\mathrm{d}h}\, r(x \boxplus h e_k)\right|_{h=0} \approx
          \frac{8\,(r_{+1} - r_{-1}) - (r_{+2} - r_{-2})}{12\,h}, \qquad r_{j} = r(x \boxplus j h e_k),

with an error of order :math:`h^4`. So factor and chart are tested together, as the solver uses them. Each reference of
a factor is moved by itself, even where two of them point into the same group of variables.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.errors import ProblemError, require
from groma.factors._examples import charts
from groma.factors.checks.world import check_invariance
from groma.factors.contract import Example, Factor
from groma.geometry.manifold import Manifold

#: Step of the differences. Their truncation error is of order 1e-13, their rounding error of order 1e-12.
STEP = 3e-4
#: Allowed deviation, relative to the largest entry of a block.
TOLERANCE = 1e-6
_UNTOUCHED = 12345.678


@dataclass(frozen=True)
class BlockCheck:
    """How well one Jacobian block agrees with differences, in one chart."""

    #: Name of the slot.
    block: str
    #: Name of the chart.
    chart: str
    #: Largest deviation, relative to the largest entry of the block.
    deviation: float
    #: Allowed deviation.
    tolerance: float
    #: Factors compared.
    cases: int
    #: Analytic and numeric block of the worst factor, each (m, dof).
    analytic: FloatArray
    numeric: FloatArray

    @property
    def passed(self) -> bool:
        """Whether the deviation is allowed; NaN is not."""
        return bool(self.deviation <= self.tolerance)


@dataclass(frozen=True)
class FactorCheck:
    """What :func:`check_factor` found."""

    #: Registered name of the factor.
    factor: str
    #: One entry for each slot and chart.
    blocks: tuple[BlockCheck, ...]

    @property
    def worst(self) -> dict[str, float]:
        """Largest relative deviation of each block over all charts."""
        worst: dict[str, float] = {}
        for block in self.blocks:
            worst[block.block] = max(worst.get(block.block, 0.0), block.deviation)
        return worst


# --------------------------------------------------------------------------------------------------------- Evaluation
def residuals_of(
    factor: Factor, ambients: tuple[FloatArray, ...], begin: int = 0, end: int | None = None
) -> FloatArray:
    """Return the residuals (N, m) of a range of factors."""
    end = len(factor) if end is None else end
    out = np.full((end - begin, factor.residual_size), np.nan)
    factor.residuals(factor.prepare(ambients), begin, end, out)
    return out


def block_sizes_of(example: Example) -> list[int]:
    """Return the columns of each block of a record."""
    return [example.variables[ref.group][0].factor_columns for _, ref in example.factor.references()]


def linearized(
    factor: Factor, ambients: tuple[FloatArray, ...], sizes: list[int], begin: int = 0, end: int | None = None
) -> tuple[FloatArray, int]:
    """Return records with all blocks side by side, and the number of degenerate factors."""
    end = len(factor) if end is None else end
    columns = tuple(int(c) for c in np.cumsum([0, *sizes[:-1]]))
    record = np.full((end - begin, factor.residual_size, sum(sizes) + 1), np.nan)
    degenerate = factor.linearize(factor.prepare(ambients), begin, end, columns, record)
    return record, degenerate


def ambients_of(example: Example) -> tuple[FloatArray, ...]:
    """Return the coordinates that each slot of the factor refers to."""
    groups = {
        name: np.ascontiguousarray(manifold.ambient(state)) for name, (manifold, state) in example.variables.items()
    }
    return tuple(groups[ref.group] for _, ref in example.factor.references())


def _charts_to_try(manifold: Manifold, state: FloatArray) -> Iterator[tuple[Manifold, FloatArray]]:
    yield manifold, state
    ambient = manifold.ambient(state)
    for chart in charts(manifold.kind):
        if chart.name != manifold.name:
            yield chart, chart.from_ambient(ambient)


def compare_jacobians(example: Example, tolerance: float = TOLERANCE) -> tuple[BlockCheck, ...]:
    """Compare every Jacobian block of an example with differences, in every chart of its kind."""
    factor, sizes = example.factor, block_sizes_of(example)
    starts = np.cumsum([0, *sizes])
    checks = []
    for b, (slot, ref) in enumerate(factor.references()):
        for chart, state in _charts_to_try(*example.variables[ref.group]):
            ambients = list(ambients_of(example))

            def moved(k: int, h: float, b=b, chart=chart, state=state, ambients=ambients) -> FloatArray:
                delta = np.zeros((len(state), chart.dof))
                delta[:, k] = h
                ambients[b] = np.ascontiguousarray(chart.ambient(chart.retract(state, delta)))
                return residuals_of(factor, tuple(ambients))

            numeric = np.empty((len(factor), factor.residual_size, chart.dof))
            for k in range(chart.dof):
                near = moved(k, STEP) - moved(k, -STEP)
                far = moved(k, 2 * STEP) - moved(k, -2 * STEP)
                numeric[:, :, k] = (8 * near - far) / (12 * STEP)
            ambients[b] = np.ascontiguousarray(chart.ambient(state))
            record, degenerate = linearized(factor, tuple(ambients), sizes)
            if degenerate:
                raise ProblemError(
                    f"{degenerate} of the {len(factor)} factors in the example of {type(factor).__name__} are "
                    "degenerate, so there is nothing to compare. Let example() draw variables in general position."
                )
            analytic = record[:, :, starts[b] : starts[b + 1]]
            basis = chart.basis(state)
            if basis is not None:
                analytic = analytic @ basis[ref.index]
            # 1e-3: an entry of a block that vanishes is compared with the rounding of the differences.
            scale = np.maximum(np.abs(numeric).max(axis=(1, 2)), 1e-3)
            deviation = np.abs(analytic - numeric).max(axis=(1, 2)) / scale
            worst = int(np.argmax(np.where(np.isnan(deviation), np.inf, deviation)))
            checks.append(
                BlockCheck(
                    block=slot.name,
                    chart=chart.name,
                    deviation=float(deviation[worst]),
                    tolerance=tolerance,
                    cases=len(factor),
                    analytic=analytic[worst],
                    numeric=numeric[worst],
                )
            )
    return tuple(checks)


# ----------------------------------------------------------------------------------------------------------- Contract
def _check_ranges(what: str, example: Example) -> None:
    """Part of the factors, none of them, another order, and columns that are not wanted."""
    factor, sizes, ambients = example.factor, block_sizes_of(example), ambients_of(example)
    count = len(factor)
    record, _ = linearized(factor, ambients, sizes)
    require(bool(np.isfinite(record).all()), what, "linearize() left a NaN or wrote less than its columns")
    residual = residuals_of(factor, ambients)
    require(
        np.allclose(residual, record[:, :, -1], rtol=1e-12, atol=1e-12),
        what,
        f"residuals() and the last column of linearize() differ:\n{residual}\n{record[:, :, -1]}",
    )
    begin, end = count // 3, count - 1
    same = np.array_equal(linearized(factor, ambients, sizes, begin, end)[0], record[begin:end])
    require(same, what, f"linearize({begin}, {end}) differs from those rows of linearize(0, {count})")
    same = np.array_equal(residuals_of(factor, ambients, begin, end), residual[begin:end])
    require(same, what, f"residuals({begin}, {end}) differs from those rows of residuals(0, {count})")
    empty, degenerate = linearized(factor, ambients, sizes, 1, 1)
    require(len(empty) == 0 and degenerate == 0, what, "an empty range counts degenerate factors")
    order = np.arange(count)[::-1]
    same = np.array_equal(linearized(factor.take(order), ambients, sizes)[0], record[order])
    require(same, what, "take() in reverse order does not give the records in reverse order")
    nothing = factor.take(np.zeros(0, np.int64))
    require(len(nothing) == 0, what, "take() of no factor is not empty")
    require(len(linearized(nothing, ambients, sizes)[0]) == 0, what, "no factors give records")
    starts = np.cumsum([0, *sizes])
    for unwanted in range(len(sizes)):
        columns = tuple(-1 if b == unwanted else int(starts[b]) for b in range(len(sizes)))
        partial = np.full_like(record, _UNTOUCHED)
        factor.linearize(factor.prepare(ambients), 0, count, columns, partial)
        expected = record.copy()
        expected[:, :, starts[unwanted] : starts[unwanted + 1]] = _UNTOUCHED
        same = bool(np.allclose(partial, expected, rtol=1e-12, atol=1e-12))
        require(same, what, f"columns {columns}: the unwanted block is written, or another one changes")


def _check_world(name: str, example: Example, rng: np.random.Generator) -> None:
    factor = example.factor
    if factor.invariance is not None:
        slots = [slot for slot, _ in factor.references()]
        ambients = ambients_of(example)
        check_invariance(name, factor.invariance, slots, ambients, lambda moved: residuals_of(factor, moved), rng)


def _check_degenerate(what: str, example: Example) -> None:
    """Variables that are no object at all (all zeros) must give zeros, never NaN."""
    factor, sizes = example.factor, block_sizes_of(example)
    for b, (slot, _) in enumerate(factor.references()):
        ambients = list(ambients_of(example))
        ambients[b] = np.zeros_like(ambients[b])
        record, degenerate = linearized(factor, tuple(ambients), sizes)
        residual = residuals_of(factor, tuple(ambients))
        finite = bool(np.isfinite(record).all() and np.isfinite(residual).all())
        require(finite, what, f"NaN or infinity where slot {slot.name!r} is zero")
        zero = ~record.any(axis=(1, 2))
        require(
            degenerate <= int(zero.sum()),
            what,
            f"{degenerate} factors are counted as degenerate where slot {slot.name!r} is zero, but only "
            f"{int(zero.sum())} records are zero",
        )
        if slot.kind in ("line", "plane", "direction"):
            require(degenerate == len(factor), what, f"a {slot.kind} of zeros in slot {slot.name!r} counts as valid")


def check_factor(
    factor: type[Factor] | Factor | Example, rng: np.random.Generator | None = None, *, tolerance: float = TOLERANCE
) -> FactorCheck:
    """Check that a factor keeps its contract.

    Checked are: each Jacobian block against differences through the charts (see the top of this module), in every chart
    of its kind; which motions of the world it notices (:attr:`Factor.invariance`); ranges, empty batches and
    :meth:`Factor.take`; that unwanted columns are left alone; that variables of zeros give zeros and no NaN.

    Parameters
    ----------
    factor : type of factor, factor or Example
        What to check. Of a type or an instance, :meth:`Factor.example` is drawn; an :class:`Example` is taken as is.
    rng : numpy.random.Generator, optional
        Random generator of the example; seeded with 0 if not given.
    tolerance : float
        Largest deviation of a block, relative to its largest entry.

    Returns
    -------
    FactorCheck
        The worst deviation of each block in each chart.

    Raises
    ------
    AssertionError
        If the contract is broken; where a derivative is wrong, with both matrices.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    example = factor if isinstance(factor, Example) else factor.example(rng)
    name = example.factor.type_name or type(example.factor).__name__
    before = {group: state.copy() for group, (_, state) in example.variables.items()}
    blocks = compare_jacobians(example, tolerance)
    for check in blocks:
        if not check.passed:
            with np.printoptions(precision=6, linewidth=160, suppress=True):
                raise AssertionError(
                    f"Factor {name!r}, block {check.block!r}, chart {check.chart!r}: the analytic Jacobian deviates "
                    f"from differences by {check.deviation:.2e} of its largest entry (allowed {check.tolerance:.0e}).\n"
                    f"analytic\n{check.analytic}\nnumeric\n{check.numeric}"
                )
    what = f"Factor {name!r}"
    _check_ranges(what, example)
    _check_world(name, example, rng)
    _check_degenerate(what, example)
    for group, (_, state) in example.variables.items():
        require(np.array_equal(state, before[group]), what, f"the states of group {group!r} were changed")
    return FactorCheck(name, blocks)
