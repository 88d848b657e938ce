# SPDX-License-Identifier: BSD-3-Clause
r"""Covariance of one variable when the errors of some landmarks' measurements go together.

What a landmark errs is often much the same in all images, and lens models err alike for neighbours. Such measurements
are no independent samples, and the stated noise says nothing of it. But the gradients of independent clusters sum to
zero at the solution, and how large they are tells the covariance of a variable x:

.. math:: \Sigma_x = \frac{n}{n - d} \sum_c z_c z_c^\top, \qquad z_c = \sum_{i \in c} \Sigma_{x k}\, J_k^\top w_i r_i,

summed over the measurements i of the landmarks in each of n clusters c and over the kept blocks k, with the weights w
of the losses. A landmark's own gradient is zero; so all its measurements belong to one cluster.

Reference: K.-Y. Liang, S. L. Zeger, *Longitudinal data analysis using generalized linear models*, 1986.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.factors.contract import Factor
from groma.problem.problem import Problem
from groma.problem.residuals import jacobians_of, residuals_of, root_matrices
from groma.solver.covariance.marginals import Covariances, Variable


def clustered(covariances: Covariances, variable: Variable, landmarks: str, cluster: IntArray) -> FloatArray:
    """Return the covariance (d, d) of a variable from independent clusters of landmarks.

    Parameters
    ----------
    covariances
        Of a solved problem, with variables held to fix the frame.
    variable
        One that was not eliminated: the name of its group, and its index.
    landmarks, cluster : str, (L,)
        An eliminated group, and the cluster of each of its variables, counted from 0.
    """
    problem = covariances.problem
    effect = with_kept(covariances, *variable)
    size = problem.variables[variable[0]].manifold.dof
    sums = np.zeros((int(cluster.max(initial=-1)) + 1, size))
    for factor in problem.factors:
        own = [ref.index for _, ref in factor.references() if ref.group == landmarks]
        if own:
            np.add.at(sums, cluster[own[0]], _pushes(problem, factor, effect, size))
    count = len(np.unique(cluster))
    return sums.T @ sums * (count / max(count - size, 1))


def with_kept(covariances: Covariances, group: str, index: int) -> dict[str, FloatArray]:
    """Return the covariances (count, dof, own dof) of the kept variables of all groups with one of them."""
    layout = covariances._layout
    groups = layout.problem.variables
    own = groups[group].manifold.dof
    R = np.zeros((layout.num_kept_unknowns, own))
    R[layout.unknowns[group][index], np.arange(own)] = 1.0
    free = ~covariances._held[:, None]
    solved = covariances._solve(R * free) * free
    found = {name: solved[at] for name, at in layout.unknowns.items()}
    for tied in covariances._divided.tied:  # the eliminated part of their group is not included
        found.setdefault(tied.group, np.zeros((int((~tied.is_tied).sum()), groups[tied.group].manifold.dof, own)))
    return covariances._divided.join(found)


def _pushes(problem: Problem, factor: Factor, effect: dict[str, FloatArray], size: int) -> FloatArray:
    """By how much each measurement (N, size) of a factor group moves the variable."""
    residuals = residuals_of(factor, problem.variables)
    matrix = root_matrices(factor)
    whitened = (matrix @ residuals[:, :, None])[:, :, 0]
    weighted = whitened * factor.loss.evaluate(np.einsum("nm,nm->n", whitened, whitened))[1][:, None]
    pull = (np.swapaxes(matrix, 1, 2) @ weighted[:, :, None])[:, :, 0]
    out, references = np.zeros((len(factor), size)), {slot.name: ref for slot, ref in factor.references()}
    for slot, J in jacobians_of(factor, problem.variables).items():
        ref = references[slot]
        if ref.group in effect:
            out += np.einsum("nm,nmk,nkj->nj", pull, J, effect[ref.group][ref.index])
    return out
