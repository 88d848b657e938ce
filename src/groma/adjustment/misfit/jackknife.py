# SPDX-License-Identifier: BSD-3-Clause
r"""How far the cameras move when one landmark after the other is left out.

Covariances :math:`(J^\top J)^{-1}` hold where all errors are independent and of the size that was assumed. The segments
of a bowed edge, of an outline that moves with the view, of a wrong track err together, and a camera may hang on a few
of them. What a landmark contributes then shows in how far the cameras move without it. With the rows J of its
observations, whitened, weighted by the loss and free of what the landmark itself takes up, their residuals r, and the
covariance C of the cameras, they move in one step by

.. math:: d = C\,J^\top (I - J C J^\top)^{-1} r,

and the sum over all landmarks :math:`\sum d\,d^\top` is their covariance, however the errors of a landmark's
observations depend on each other and whatever their size (the jackknife by groups; M. C. Paik, *Biometrika*, 1988, and
for regressions D. V. Hinkley, *Technometrics*, 1977). With a robust loss the curvature of the cost is smaller than C
says by the mean of :math:`\psi'/w` (P. J. Huber, *Robust Statistics*, 1981, section 7.6): d is divided by it.

What is known of the cameras without landmarks, such as where a principal point is expected, adds what its standard
deviation says. Errors that landmarks share with their neighbours, of a lens for example, are not contained.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.misfit.lens import LENS
from groma.execution import map_in_threads
from groma.factors.contract import Factor
from groma.problem.problem import Problem
from groma.problem.residuals import jacobians_of, residuals_of, root_matrices
from groma.solver.covariance.marginals import Covariances
from groma.solver.linear.blas import one_blas_thread

#: Landmarks that are left out in turn, and those of relations only.
_LANDMARKS, _STRUCTURE = ("points", "lines"), ("planes", "directions")
#: Numbers in the largest arrays of one batch of landmarks, and batches that are worked on before they are added
#: (cost: memory).
_BATCH, _AT_ONCE = 300_000, 16


@dataclass(frozen=True, eq=False)
class _Rows:
    """Observations (N) of one kind of landmark: whitened, weighted, of one size."""

    landmark: IntArray
    #: (N, k) numbers of the unknowns of cameras that each depends on; the last one stands for none.
    columns: IntArray
    #: (N, m, k) and (N, m, d) derivatives by them and by the landmark, and residuals (N, m).
    by_camera: FloatArray
    by_landmark: FloatArray
    residual: FloatArray


def observations_alone(problem: Problem) -> Problem:
    """Return the problem without relations: each factor refers to one landmark at most, and to no plane."""
    factors = []
    for factor in problem.factors:
        groups = [ref.group for _, ref in factor.references()]
        if not {*groups} & {*_STRUCTURE} and sum(group in _LANDMARKS for group in groups) <= 1:
            factors.append(factor)
    used = {ref.group for factor in factors for _, ref in factor.references()}
    return Problem({name: group for name, group in problem.variables.items() if name in used}, factors)


@one_blas_thread()
def landmark_jackknife(covariances: Covariances) -> tuple[FloatArray, FloatArray]:
    """Return covariances (F, 6, 6) of the frames as they are stated, and by leaving out landmarks.

    Parameters
    ----------
    covariances : Covariances
        Of :func:`observations_alone`, at its solution, with the loss it was solved with.
    """
    problem = covariances.problem
    sizes = {
        name: group.manifold.dof
        for name, group in problem.variables.items()
        if name not in _LANDMARKS and (name == "frames" or not group.is_constant)
    }
    names, first = list(sizes), {}
    every: list[tuple[str, int]] = []
    for name in names:
        first[name] = sum(sizes[other] for other, _ in every)
        every += [(name, row) for row in range(len(problem.variables[name]))]
    stated = np.pad(covariances.joint(every), (0, 1))
    size, summed, curvature = len(stated), np.zeros_like(stated), np.zeros(2)
    for kind in (kind for kind in _LANDMARKS if kind in problem.variables):
        rows = [_rows_of(factor, kind, problem, first, curvature) for factor in problem.factors]
        together = _joined([one for one in rows if one is not None], size - 1)
        for moved in _pulls(together, stated) if together is not None else ():
            summed += moved.T @ moved  # in their order, whoever made them
    share = max(curvature[0] / max(curvature[1], 1e-300), 0.1)
    found = stated @ summed @ stated / share**2
    if (known := _known_besides(problem, first, size)).any():
        found += stated @ known @ stated
    at = first["frames"] + sizes["frames"] * np.arange(len(problem.variables["frames"]))[:, None] + np.arange(6)
    frames = problem.variables["frames"]
    basis = frames.manifold.basis(frames.state)
    blocks = [matrix[at[:, :, None], at[:, None, :]] for matrix in (stated, found)]
    if basis is not None:
        blocks = [basis @ block @ np.swapaxes(basis, 1, 2) for block in blocks]
    return blocks[0], blocks[1]


def _known_besides(problem: Problem, first: dict[str, int], size: int) -> FloatArray:
    """Return the information (U, U) that factors without a landmark have of the unknowns of cameras."""
    found = np.zeros((size, size))
    for factor in problem.factors:
        references = factor.references()
        if len(factor) and all(ref.group in first for _, ref in references):
            blocks, whiten = jacobians_of(factor, problem.variables), root_matrices(factor)
            J = np.concatenate([whiten @ blocks[slot.name] for slot, _ in references], axis=2)
            sizes = [blocks[slot.name].shape[2] for slot, _ in references]
            parts = zip(references, sizes, strict=True)
            columns = np.hstack(
                [first[ref.group] + dof * ref.index[:, None] + np.arange(dof) for (_, ref), dof in parts]
            )
            np.add.at(found, (columns[:, :, None], columns[:, None, :]), np.swapaxes(J, 1, 2) @ J)
    return found


def _rows_of(factor: Factor, kind: str, problem: Problem, first: dict[str, int], curvature: FloatArray) -> _Rows | None:
    """Return the rows of a group of factors that observe landmarks of a kind; add to sums of psi' and weights."""
    slot = next((slot.name for slot, ref in factor.references() if ref.group == kind), None)
    if slot is None or len(factor) == 0:
        return None
    residual, blocks = residuals_of(factor, problem.variables), jacobians_of(factor, problem.variables)
    whiten = root_matrices(factor)
    residual = np.einsum("nij,nj->ni", whiten, residual)
    square = np.einsum("ni,ni->n", residual, residual)
    _, weight, bend = factor.loss.evaluate(square)
    curvature += (weight + 2.0 * square * bend / factor.residual_size).sum(), weight.sum()
    whiten = np.sqrt(weight)[:, None, None] * whiten
    parts, columns = [], []
    for one, ref in factor.references():
        if one.name == slot or ref.group not in first:
            continue
        parts.append(whiten @ blocks[one.name])
        dof = parts[-1].shape[2]
        columns.append(first[ref.group] + dof * ref.index[:, None] + np.arange(dof))
    by_landmark = whiten @ blocks[slot]
    if problem.variables[kind].is_constant:
        by_landmark = np.zeros_like(by_landmark)
    landmark = next(ref.index for one, ref in factor.references() if one.name == slot)
    return _Rows(
        landmark, np.hstack(columns), np.concatenate(parts, axis=2), by_landmark, np.sqrt(weight)[:, None] * residual
    )


def _joined(parts: list[_Rows], none: int) -> _Rows | None:
    """Rows of several groups of factors, filled up to one size, in the order of their landmarks."""
    if not parts:
        return None
    rows = max(part.residual.shape[1] for part in parts)
    width = max(part.columns.shape[1] for part in parts)

    def filled(array: FloatArray, *to: int) -> FloatArray:
        return np.pad(array, [(0, 0), *((0, size - have) for size, have in zip(to, array.shape[1:], strict=True))])

    columns = [np.pad(p.columns, ((0, 0), (0, width - p.columns.shape[1])), constant_values=none) for p in parts]
    landmark = np.concatenate([part.landmark for part in parts])
    order = np.argsort(landmark, kind="stable")
    return _Rows(
        landmark[order],
        np.concatenate(columns)[order],
        np.concatenate([filled(part.by_camera, rows, width) for part in parts])[order],
        np.concatenate([filled(part.by_landmark, rows, part.by_landmark.shape[2]) for part in parts])[order],
        np.concatenate([filled(part.residual, rows) for part in parts])[order],
    )


def _pulls(rows: _Rows, stated: FloatArray) -> Iterator[FloatArray]:
    """Yield for batches of landmarks what each pulls at the unknowns of cameras with (B, U)."""
    begin = np.flatnonzero(np.r_[True, np.diff(rows.landmark) > 0])
    count = np.diff(np.r_[begin, len(rows.landmark)])
    batches = []
    for number in np.unique(count):
        starts, wide = begin[count == number], int(number) * rows.columns.shape[1]
        step = max(1, _BATCH // max(wide**2, len(stated)))
        batches += [starts[some : some + step, None] + np.arange(number) for some in range(0, len(starts), step)]
    for some in range(0, len(batches), _AT_ONCE):
        yield from map_in_threads(partial(_pull, rows, stated), batches[some : some + _AT_ONCE])


def _pull(rows: _Rows, stated: FloatArray, taken: IntArray) -> FloatArray:
    """Pulls (B, U) of landmarks that have the same number of observations, ``taken`` (B, n)."""
    batch, number = taken.shape
    columns, J = rows.columns[taken], rows.by_camera[taken]
    own = rows.by_landmark[taken].reshape(batch, -1, rows.by_landmark.shape[2])
    V = np.swapaxes(own, 1, 2) @ own
    V += 1e-12 * (np.trace(V, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(V.shape[1])
    free = np.eye(own.shape[1]) - own @ np.linalg.solve(V, np.swapaxes(own, 1, 2))
    between = stated[columns[:, :, :, None], columns.reshape(batch, 1, 1, -1)]
    half = np.swapaxes((J @ between).reshape(batch, -1, number, J.shape[3]), 1, 2)
    shared = half @ np.swapaxes(J, 2, 3)  # (B, second observation, rows of all first ones, its rows)
    leverage = free @ np.swapaxes(shared, 1, 2).reshape(free.shape) @ free
    error = _without_own(leverage, free @ rows.residual[taken].reshape(batch, -1, 1))
    pull = np.swapaxes(J, 2, 3) @ error.reshape(batch, number, -1, 1)
    flat = columns.reshape(batch, -1) + len(stated) * np.arange(batch)[:, None]
    sums = np.bincount(flat.ravel(), pull.ravel(), batch * len(stated)).astype(np.float64, copy=False)
    return sums.reshape(batch, len(stated))


def _without_own(leverage: FloatArray, residual: FloatArray) -> FloatArray:
    """Residuals (B, R, 1) as they would be without what the cameras follow them; leverage (B, R, R)."""
    bold = np.trace(leverage, axis1=1, axis2=2) > LENS.max_leverage  # no share of the others exceeds it
    error = np.linalg.solve(np.eye(leverage.shape[1]) - np.where(bold[:, None, None], 0.0, leverage), residual)
    if bold.any():
        shares, axes = np.linalg.eigh(leverage[bold])
        along = np.swapaxes(axes, 1, 2) @ residual[bold]
        error[bold] = axes @ (along / (1.0 - np.minimum(shares, LENS.max_leverage))[:, :, None])
    return np.asarray(error, np.float64)
