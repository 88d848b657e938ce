# SPDX-License-Identifier: BSD-3-Clause
r"""The S-transformation: covariances of one frame turned into those of the frame that a datum names.

With the free motions G, the weights D of the datum and :math:`Q = (G^\top D G)^{-1}` (see
:mod:`groma.solver.covariance.datum`), the projection is :math:`P = I - G\,Q\,G^\top D`, and for a generalised inverse M
of the normal matrix

.. math:: P M P^\top = M + G K G^\top - A G^\top - G A^\top, \qquad A = M D G\,Q, \qquad
          K = Q\,G^\top D\,M\,D\,G\,Q .

So one solve with as many right hand sides as there are free motions serves every block of the inverse.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray
from groma.errors import InputError
from groma.problem.layout import Layout
from groma.problem.problem import Problem
from groma.problem.tied import Divided
from groma.problem.variables import Variables
from groma.solver.covariance.datum import FreeMotions
from groma.solver.covariance.landmarks import Landmarks


@dataclass(frozen=True)
class Transformation:
    """G and A of all unknowns, and K: see the top of this module."""

    #: (kept unknowns, k).
    G: FloatArray
    A: FloatArray
    #: (unknowns, k) of each eliminated group.
    G_landmarks: list[FloatArray]
    A_landmarks: list[FloatArray]
    #: (k, k).
    K: FloatArray
    #: Weights D, and (G^T D G)^-1.
    D: FloatArray
    D_landmarks: list[FloatArray]
    Q: FloatArray

    def correction(self, G: FloatArray, A: FloatArray) -> FloatArray:
        """What P M P^T differs from M, for rows (n, dof, k) of G and A."""
        cross = A @ np.swapaxes(G, 1, 2)
        return G @ self.K @ np.swapaxes(G, 1, 2) - cross - np.swapaxes(cross, 1, 2)


def transformation(
    layout: Layout,
    landmarks: Landmarks,
    solve: Callable[[FloatArray], FloatArray],
    motions: FreeMotions,
    G: FloatArray,
    held: list[BoolArray],
    weights: tuple[FloatArray, list[FloatArray]],
) -> Transformation:
    """Set up the S-transformation to the frame in which weighted coordinates vary least.

    Parameters
    ----------
    layout, landmarks
        The problem and its eliminated variables.
    solve
        Applies the inverse of the constrained reduced system to columns (kept unknowns, k).
    motions
        The free motions; those of the landmarks are read.
    G : (kept unknowns, k) float64
        The free motions of the kept unknowns, zero where these are held or seen by nothing.
    held
        Which unknowns of the eliminated groups are held constant.
    weights
        See :func:`datum_weights`.

    Raises
    ------
    InputError
        If the weights do not hold some motion.
    """
    D_kept, D_landmarks = weights
    G_landmarks = [np.where(mask[:, None], 0.0, part) for part, mask in zip(motions.landmarks, held, strict=True)]
    target = D_kept[:, None] * G
    local = []
    for e, eliminated in enumerate(layout.eliminated):
        weighted = (D_landmarks[e][:, None] * G_landmarks[e]).reshape(eliminated.count, eliminated.dof, -1)
        local.append(-(landmarks.inverses(e) @ weighted))
        if D_landmarks[e].any():
            for c, incidences in eliminated.incidences.items():
                landmark = np.repeat(np.arange(eliminated.count), np.diff(incidences.pointer))
                parts = np.swapaxes(landmarks.incidence(e, c), 1, 2) @ weighted[landmark]
                np.add.at(layout.kept[c].blocks_of(target), incidences.block, parts)
    Y = solve(target)
    Y_landmarks = [part + landmarks.followed(e, Y) for e, part in enumerate(local)]
    weight = G.T @ (D_kept[:, None] * G)
    inner = G.T @ (D_kept[:, None] * Y)
    for e, part in enumerate(G_landmarks):
        weight += part.T @ (D_landmarks[e][:, None] * part)
        inner += part.T @ (D_landmarks[e][:, None] * Y_landmarks[e].reshape(part.shape))
    size = np.sqrt(np.diag(weight))
    if not (size > 0).all() or not np.linalg.eigvalsh(weight / np.outer(size, size))[0] > 1e-14:
        raise InputError(
            "The datum does not fix the frame: some motion of the whole scene moves none of its coordinates. Name "
            "more variables, for example all poses or all points."
        )
    Q = np.linalg.inv(weight).astype(np.float64)
    K = Q @ inner @ Q
    A_landmarks = [y.reshape(g.shape) @ Q for y, g in zip(Y_landmarks, G_landmarks, strict=True)]
    return Transformation(G, Y @ Q, G_landmarks, A_landmarks, K, D_kept, D_landmarks, Q)


def datum_of_parts(problem: Problem, divided: Divided, datum: Mapping[str, npt.ArrayLike]) -> dict[str, npt.ArrayLike]:
    """Return the weights of a datum with those of tied landmarks apart."""
    weights = dict(datum)
    for group in (tied.group for tied in divided.tied if tied.group in datum):
        weights |= divided.divide({group: weights_of(problem.variables[group], group, datum[group])})
    return weights


def datum_weights(
    layout: Layout, datum: Mapping[str, npt.ArrayLike] | None, undetermined: list[BoolArray]
) -> tuple[FloatArray, list[FloatArray]]:
    """Return the weights of all unknowns, flat: of the kept ones, and of the landmarks by eliminated group.

    By default all kept unknowns count alike. Landmarks that are ``undetermined`` (count,) do not count.
    """
    kept = np.zeros(layout.num_kept_unknowns)
    landmarks = [np.zeros(e.count * e.dof) for e in layout.eliminated]
    known = [*layout.unknowns, *(e.group for e in layout.eliminated)]
    for name in datum or {}:
        if name not in known:
            raise InputError(f"The datum names {name!r}; the groups with free variables are {sorted(known)}.")
    for name, at in layout.unknowns.items():
        kept[at] = weights_of(layout.problem.variables[name], name, 1.0 if datum is None else datum.get(name, 0.0))
    for e, eliminated in enumerate(layout.eliminated):
        value = 0.0 if datum is None else datum.get(eliminated.group, 0.0)
        weight = weights_of(layout.problem.variables[eliminated.group], eliminated.group, value)
        landmarks[e] = np.where(undetermined[e][:, None], 0.0, weight[eliminated.order]).reshape(-1)
    return kept, landmarks


def weights_of(variables: Variables, group: str, value: npt.ArrayLike) -> FloatArray:
    """Return the weights (count, dof) that a datum gives to the variables of a group."""
    shape = (len(variables), variables.manifold.dof)
    try:
        weight = np.broadcast_to(np.asarray(value, dtype=np.float64), shape)
    except ValueError:
        raise InputError(f"The datum of {group!r} must broadcast to {shape}; got {np.shape(value)}.") from None
    if not (weight >= 0).all():
        raise InputError(f"The weights of the datum must not be negative; those of {group!r} are.")
    return weight
