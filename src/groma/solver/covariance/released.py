# SPDX-License-Identifier: BSD-3-Clause
r"""Covariances without a factor that holds what other factors should determine.

A factor of one residual with the whitened derivative j holds a combination :math:`\alpha = j x` of the unknowns, since
factors that should not tell of it pull at it: what is left of landmarks that lie on others scales with the world. With
the covariance C of all factors, the unknowns follow :math:`\alpha` by

.. math:: g = C j^\top / \varsigma^2, \qquad \varsigma^2 = j C j^\top,

and all factors but that one and the incidences determine it with the information
:math:`I = \sum_i w_i \lVert J_i\, g \rVert^2`. Put in place of what holds it,

.. math:: C' = C + \left(I^{-1} - \varsigma^2\right) g\, g^\top .
"""

from __future__ import annotations

from copy import copy

import numpy as np

from groma._typing import FloatArray
from groma.factors.contract import Factor
from groma.problem.residuals import jacobians_of, root_matrices, squared_norms
from groma.solver.covariance.marginals import Covariances
from groma.solver.covariance.s_transform import Transformation


def released(covariances: Covariances, held: Factor) -> Covariances:
    """Return covariances as if a factor that holds one combination of variables were absent.

    Parameters
    ----------
    covariances : Covariances
        Of a problem in a held gauge; not modified.
    held : Factor
        One of its factors: one residual, of variables that are not eliminated. Where no other factor tells of what it
        holds, that stays held.
    """
    layout, problem = covariances._layout, covariances.problem
    j = np.zeros((layout.num_kept_unknowns, 1))
    for (_, ref), block in zip(held.references(), jacobians_of(held, problem.variables).values(), strict=True):
        np.add.at(j[:, 0], layout.unknowns[ref.group][ref.index[0]], (root_matrices(held) @ block)[0, 0])
    j[covariances._held] = 0.0
    moved = covariances._solve(j)
    variance = float((j.T @ moved)[0, 0])
    if not variance > 0.0 or covariances._datum is not None:
        return covariances
    g = moved / variance
    g[covariances._held] = 0.0
    landmarks = [covariances._landmarks.followed(e, g) for e in range(len(layout.eliminated))]
    found = {name: g[at, 0] for name, at in layout.unknowns.items()}
    for e, eliminated in enumerate(layout.eliminated):
        found[eliminated.group] = landmarks[e][covariances._position[eliminated.group], :, 0]
    motion = covariances._divided.join(found)
    information = sum(_told(factor, motion, covariances) for factor in problem.factors if factor is not held)
    if not information > 0.0:
        return covariances
    flat = [part.reshape(-1, 1) for part in landmarks]
    nothing, of_landmarks = np.zeros_like(g), [np.zeros_like(part) for part in flat]
    weights = nothing[:, 0], [part[:, 0] for part in of_landmarks]
    spread = np.array([[1.0 / information - variance]])
    changed = copy(covariances)
    changed._datum = Transformation(g, nothing, flat, of_landmarks, spread, *weights, np.zeros((1, 1)))
    return changed


def _told(factor: Factor, motion: dict[str, FloatArray], covariances: Covariances) -> float:
    """Return the information of a group of factors on a motion (count, dof) of all groups."""
    variables = covariances.problem.variables
    if factor.is_incidence or not len(factor):
        return 0.0
    blocks, total = jacobians_of(factor, variables), np.zeros((len(factor), factor.residual_size))
    for slot, ref in factor.references():
        if ref.group in motion:
            total += np.einsum("nij,nj->ni", blocks[slot.name], motion[ref.group][ref.index])
    weight = factor.loss.evaluate(squared_norms(factor, variables))[1]
    return float(weight @ np.sum(np.einsum("nij,nj->ni", root_matrices(factor), total) ** 2, axis=1))
