# SPDX-License-Identifier: BSD-3-Clause
r"""Planes that bend: pieces of round bodies and of relief, told from rough walls by the normals of their parts.

What lies on a plane of a column deviates from it as what lies on a rough wall does. But the parts of a wall have its
normal, and those of a column are turned against each other. Members are divided into four quarters, at the medians
along the axes of their spread. In each, heights h are fitted by a slope g at the places q, from the middle of the
quarter, with weights P / (s^2 + t^2 l^2) (:mod:`groma.mapping.structure.relations`). The deviation t was estimated
around the plane, so it contains the bend; the variance of unit weight :math:`\phi` is that of the residuals of all
quarters. With the covariances :math:`\phi V` of the slopes, the plane turns by

.. math:: \theta^2 = \tfrac14 \sum_p \left(|g_p|^2 - \phi\, \mathrm{tr} V_p\right),

and whether that is more than chance is an F test of :math:`\sum_p g_p^\top V_p^{-1} g_p / 8\phi`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.plane_search import PlaneSet
from groma.gates import gate
from groma.geometry.algebra import perpendicular
from groma.mapping.structure.relations import Landmarks, Pairs
from groma.mapping.structure.rough_planes import deviations, members_of

#: Quarters of a plane, what a fit of one takes, and the slopes of all (derived from halves along two axes).
_QUARTERS, _UNKNOWNS, _SLOPES = 4, 3, 8


@dataclass(frozen=True)
class BendingGates:
    """What bends too much for a plane."""

    turned: float = gate(
        0.036,
        "rad",
        "that quarters of a plane are turned against it, root mean square",
        "convention: two degrees; round bodies have none at one, a few at three, flat and rough walls all of theirs",
    )
    members: int = gate(6, "members", "of a quarter at least, points and segment ends", "derived from two an unknown")


GATES = BendingGates()


def bending(
    marks: Landmarks, planes: PlaneSet, points: Pairs, lines: Pairs, level: float, gates: BendingGates = GATES
) -> BoolArray:
    """Return which planes (K,) bend by more than a plane may, surely; those of few members are not told.

    Parameters
    ----------
    marks : Landmarks
        Points and lines with their noise.
    planes, points, lines
        Planes, and what lies on them.
    level : float
        Level of the test that a plane turns at all.
    gates : BendingGates
        By how much it may.
    """
    rough, bent = deviations(points, lines, len(planes)), np.zeros(len(planes), bool)
    for k in range(len(planes)):
        places, noise, away, weight = members_of(marks, points, lines, k, rough[k])
        if len(places) < _QUARTERS * gates.members:
            continue
        normal = planes.planes[k, :3]
        variance = np.einsum("i,nij,j->n", normal, noise, normal) + away**2
        along, height = places @ np.stack(perpendicular(normal), axis=1), places @ normal + planes.planes[k, 3]
        ends = height[points.counts(len(planes))[k] :].reshape(-1, 2)
        ends[:] = ends.mean(axis=1, keepdims=True)  # tilts of lines have heavier tails than the noise of their ends
        turned, tail = _turned(along, height, weight / variance, gates.members)
        bent[k] = turned > gates.turned and tail < 1.0 - level
    return bent


def _turned(along: FloatArray, height: FloatArray, weight: FloatArray, least: int) -> tuple[float, float]:
    """By how much the quarters of a plane are turned, radians, and how likely that is by chance; 0 and 1 if unknown.

    Of members in the plane: places (M, 2), heights and weights (M,).
    """
    quarter = _quarters(along)
    if np.bincount(quarter, minlength=_QUARTERS).min() < least:
        return 0.0, 1.0
    squared = noise = tested = residual = 0.0
    for k in range(_QUARTERS):
        of = quarter == k
        share = weight[of] / weight[of].sum()
        q, h = along[of] - share @ along[of], height[of] - share @ height[of]
        information = (weight[of, None] * q).T @ q + np.eye(2)  # a slope is not known at all where it may be one
        covariance, told = np.linalg.inv(information), q.T @ (weight[of] * h)
        slope = covariance @ told
        squared, noise, tested = squared + slope @ slope, noise + np.trace(covariance), tested + slope @ told
        residual += weight[of] @ (h - q @ slope) ** 2
    freedom = len(height) - _QUARTERS * _UNKNOWNS
    unit = max(residual / freedom, np.finfo(float).tiny)
    tail = scipy.special.fdtrc(_SLOPES, freedom, tested / (_SLOPES * unit))
    return float(np.sqrt(max(squared - unit * noise, 0.0) / _QUARTERS)), float(tail)


def _quarters(along: FloatArray) -> IntArray:
    """(M,) the quarter of each member: halves along the longest axis of all, and halves of these across it."""
    away = along - along.mean(axis=0)
    first, second = (away @ np.linalg.eigh(away.T @ away)[1])[:, ::-1].T
    half = first > np.median(first)
    quarter = 2 * half
    for side in (False, True):
        of = half == side
        quarter[of] += second[of] > np.median(second[of]) if of.any() else False
    return quarter
