# SPDX-License-Identifier: BSD-3-Clause
"""Residuals of a group of factors at the states of a problem, outside of a solve."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from groma._typing import FloatArray
from groma.factors._factor import Factor
from groma.problem.variables import Variables


def residuals_of(factor: Factor, variables: Mapping[str, Variables]) -> FloatArray:
    """Return the residuals (N, m) of a group of factors as they are: not whitened, without the loss.

    Degenerate factors have a residual of zero.
    """
    residuals = np.zeros((len(factor), factor.residual_size))
    if len(factor):
        ambients = tuple(variables[ref.group].ambient() for _, ref in factor.references())
        factor.residuals(factor.prepare(ambients), 0, len(factor), residuals)
    return residuals


def squared_norms(factor: Factor, variables: Mapping[str, Variables]) -> FloatArray:
    r"""Return :math:`\lVert \Sigma^{-1/2} r \rVert^2` (N,) of a group of factors, without the loss."""
    residuals = residuals_of(factor, variables)
    information = np.asarray(factor.sqrt_information, dtype=np.float64)
    if information.ndim == 3:
        residuals = np.einsum("nij,nj->ni", information, residuals)
        return np.einsum("ni,ni->n", residuals, residuals)
    return np.einsum("ni,ni->n", residuals, residuals) * information**2


__all__ = ["residuals_of", "squared_norms"]
