# SPDX-License-Identifier: BSD-3-Clause
"""Residuals and Jacobians of a group of factors at the states of a problem, outside of a solve."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from groma._rows import pointers_of
from groma._typing import FloatArray
from groma.errors import check_kind
from groma.factors.contract import Factor
from groma.problem.problem import Problem
from groma.problem.variables import Variables


def residuals_of(factor: Factor, variables: Mapping[str, Variables]) -> FloatArray:
    """Return the residuals (N, m) of a group of factors as they are: not whitened, without the loss.

    Degenerate factors have a residual of zero.
    """
    check_kind(factor, Factor, "factor", "Pass a group of factors, such as one of Problem.factors.")
    residuals = np.zeros((len(factor), factor.residual_size))
    if len(factor):
        ambients = tuple(variables[ref.group].ambient() for _, ref in factor.references())
        factor.residuals(factor.prepare(ambients), 0, len(factor), residuals)
    return residuals


class Residuals:
    """Residuals of the factors of a problem at its states; each group of factors is evaluated once."""

    def __init__(self, problem: Problem) -> None:
        self._problem = problem
        self._found: dict[int, FloatArray] = {}

    def of(self, factor: Factor) -> FloatArray:
        """Return :func:`residuals_of` one of the problem's own groups of factors."""
        if id(factor) not in self._found:
            self._found[id(factor)] = residuals_of(factor, self._problem.variables)
        return self._found[id(factor)]


def jacobians_of(factor: Factor, variables: Mapping[str, Variables]) -> dict[str, FloatArray]:
    r"""Return the derivatives of :func:`residuals_of` by the minimal increments of the variables.

    .. math:: J = \left.\frac{\partial\, r(x \boxplus \delta)}{\partial \delta}\right|_{\delta = 0},

    where :math:`\boxplus` is ``retract`` of the chart of each group.

    Parameters
    ----------
    factor : Factor
        N factors of one type with m residuals each.
    variables : mapping
        The groups of variables that it refers to, such as ``Problem.variables``.

    Returns
    -------
    dict
        For every slot of the factor that is present ("pose", "point", ...), in their order, the blocks (N, m, dof):
        the derivative of each residual by the variable that it refers to. Like the residuals, they are not whitened
        and without the loss; variables held constant have theirs too; degenerate factors have zeros. Where two slots
        refer to the same variable, its derivative is the sum of both blocks.
    """
    check_kind(factor, Factor, "factor", "Pass a group of factors, such as one of Problem.factors.")
    references = factor.references()
    groups = [variables[ref.group] for _, ref in references]
    begin = pointers_of([group.manifold.factor_columns for group in groups])
    record = np.zeros((len(factor), factor.residual_size, begin[-1] + 1))
    if len(factor):
        inputs = factor.prepare(tuple(group.ambient() for group in groups))
        factor.linearize(inputs, 0, len(factor), tuple(begin[:-1].tolist()), record)
    blocks: dict[str, FloatArray] = {}
    for (slot, ref), group, first, end in zip(references, groups, begin[:-1], begin[1:], strict=True):
        basis = group.manifold.basis(group.state)  # from factor coordinates to the chart; None is the identity
        block = record[:, :, first:end]
        blocks[slot.name] = block.copy() if basis is None else block @ basis[ref.index]
    return blocks


def root_matrices(factor: Factor) -> FloatArray:
    """Return the square root of the information of each factor as matrices (N, m, m), not to be written to."""
    root = np.asarray(factor.sqrt_information, dtype=np.float64)
    root = root if root.ndim == 3 else root.reshape(-1, 1, 1) * np.eye(factor.residual_size)
    return np.broadcast_to(root, (len(factor), *root.shape[1:]))


def squared_norms(factor: Factor, variables: Mapping[str, Variables]) -> FloatArray:
    r"""Return :math:`\lVert \Sigma^{-1/2} r \rVert^2` (N,) of a group of factors, without the loss."""
    residuals = residuals_of(factor, variables)
    information = np.asarray(factor.sqrt_information, dtype=np.float64)
    if information.ndim == 3:
        residuals = np.einsum("nij,nj->ni", information, residuals)
        return np.einsum("ni,ni->n", residuals, residuals)
    return np.einsum("ni,ni->n", residuals, residuals) * information**2


__all__ = ["Residuals", "jacobians_of", "residuals_of", "squared_norms"]
