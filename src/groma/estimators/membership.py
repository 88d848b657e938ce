# SPDX-License-Identifier: BSD-3-Clause
r"""Which features belong to a structure that is not exact: a mixture whose members deviate from it, as do real walls.

A plane of a building is no plane, and its joints are not quite parallel. How far its members are off, beyond their own
noise, is not known in advance; it is estimated from the features, together with the share of them that are members.
With the offset :math:`x` of a feature in the axes of its noise, variances :math:`s_a^2` there, and the unit of
deviation :math:`\ell` at the feature, members of a structure with the deviation t have the density

.. math:: g(x; t) = \prod_a N(x_a;\; 0,\; s_a^2 + t^2 \ell^2),

clutter a constant one, c. For every t that is tried the share :math:`\pi` follows by expectation maximisation; the t of
most likelihood is kept, or none where that is not significantly more likely. Then

.. math:: P = \frac{\pi\, g(x; t)}{\pi\, g(x; t) + (1 - \pi)\, c} .

All axes count: a feature that is uncertain along one, as a short line is in depth, can be certain along the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.association import MAX_SQUARE, maximise_shares
from groma.execution import map_in_threads
from groma.gates import NORMAL, chi_square_gate, gate


@dataclass(frozen=True)
class MembershipGates:
    """How deviations and shares are estimated."""

    rounds: int = gate(30, "rounds", "of expectation and maximisation", "cost: converges in fewer")
    pooled: float = gate(4.0, "features", "that the overall share counts in each", "chosen on walls full of points")
    tried: int = gate(12, "deviations", "that are tried", "cost: each two fifths larger than the one before")
    least: float = gate(0.02, "share", "of the largest deviation, the least that is tried", "cost: tells from none")


#: The numbers in use.
MEMBERSHIPS = MembershipGates()


@dataclass(frozen=True)
class Candidates:
    """N pairs of a feature and a structure that it may belong to."""

    #: (N,) the structure of each.
    owner: IntArray
    #: (N, D) offset along the axes of its noise, and the variances there.
    offset: FloatArray
    variance: FloatArray
    #: (N,) what a deviation of one is at the feature, or (N, D) along each axis.
    unit: FloatArray
    #: (N,) density of clutter there.
    clutter: FloatArray
    #: (N,) pairs that take part in the estimates; others are known to belong elsewhere.
    counted: BoolArray
    #: (N,) pairs with the same number have the same share; kinds of features may differ in it.
    group: IntArray


@dataclass(frozen=True)
class Membership:
    """Who belongs to what."""

    #: (N,) probability that each pair is one.
    probability: FloatArray
    #: (K,) deviation of the members of each structure, 0 where their noise explains it.
    deviation: FloatArray


def memberships(found: Candidates, most: FloatArray) -> Membership:
    """Estimate how far members of structures deviate, and with which probability features are members.

    Parameters
    ----------
    found : Candidates
        Pairs of features and structures.
    most : (K,) float64
        Largest deviation that members of each structure may have; deviations down to a fiftieth are tried.
    """
    num = len(most)
    if len(found.owner) == 0:
        return Membership(np.zeros(0), np.zeros(num))
    tried, likelihood, shares = _tried(found, most)
    best = likelihood.argmax(axis=0)
    gain = likelihood.max(axis=0) - likelihood[0]
    # Where the widest fits best nothing stands out from clutter, whatever it is.
    best[(gain < 0.5 * chi_square_gate(NORMAL.significance, 1)) | (best == len(tried) - 1)] = 0
    deviation = tried[best, np.arange(num)]
    share = shares[best[found.owner], found.group]
    return Membership(_probability(found, deviation, share), deviation)


def averaged_memberships(found: Candidates, most: FloatArray, worth: FloatArray) -> Membership:
    """The same, averaged over all deviations that are tried, each as likely as it is by the features.

    Which deviation is the most likely one can hang on a single feature; an average does not. None is preferred: the
    logarithm of the deviation has the same prior everywhere up to the largest one.

    Parameters
    ----------
    found, most
        As :func:`memberships` has them.
    worth : (K,) float64
        Information of a feature of each structure about the deviation, as a share of that of an independent one.

    Returns
    -------
    Membership
        With the root mean square deviation of the members of each structure.
    """
    if len(found.owner) == 0:
        return Membership(np.zeros(0), np.zeros(len(most)))
    tried, likelihood, shares = _tried(found, most)
    weight = np.exp(worth * (likelihood - likelihood.max(axis=0)))
    weight /= weight.sum(axis=0)
    probability, square, members = np.zeros(len(found.owner)), np.zeros(len(most)), np.zeros(len(most))
    for deviation, share, part in zip(tried, shares, weight, strict=True):
        member = part[found.owner] * _probability(found, deviation, share[found.group])
        probability += member
        number = np.bincount(found.owner[found.counted], member[found.counted], len(most))
        square, members = square + number * deviation**2, members + number
    return Membership(probability, np.sqrt(square / np.maximum(members, np.finfo(float).tiny)))


def _tried(found: Candidates, most: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Deviations (T, K), the logarithms of their likelihoods (T, K), and the shares of members (T, G) with them."""
    tried = np.concatenate([[0.0], np.geomspace(MEMBERSHIPS.least, 1.0, MEMBERSHIPS.tried)])[:, None] * most
    fits = map_in_threads(partial(_fit, found, np.flatnonzero(found.counted)), list(tried))
    likelihood, shares = (np.array(part) for part in zip(*fits, strict=True))
    return tried, likelihood, shares


def _fit(found: Candidates, rows: IntArray, deviation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Log likelihoods (K,) and shares of members (G,) with deviations (K,), by the pairs in ``rows``."""
    density, group = _density(found, deviation[found.owner])[rows], found.group[rows]
    share = maximise_shares(
        density, found.clutter[rows], group, int(found.group.max()) + 1, MEMBERSHIPS.pooled, MEMBERSHIPS.rounds
    )
    mixed = share[group] * density + (1.0 - share[group]) * found.clutter[rows]
    return np.bincount(found.owner[rows], np.log(mixed), len(deviation)).astype(np.float64, copy=False), share


def _probability(found: Candidates, deviation: FloatArray, share: FloatArray) -> FloatArray:
    """Probability (N,) that pairs are one, by the deviations (K,) of the structures and the share (N,) of members."""
    member = share * _density(found, deviation[found.owner])
    return member / (member + (1.0 - share) * found.clutter)


def _density(found: Candidates, deviation: FloatArray) -> FloatArray:
    """Density of members; far away it is small, not zero."""
    variance = found.variance + (deviation[:, None] * found.unit.reshape(len(deviation), -1)) ** 2
    squared = np.minimum((found.offset**2 / variance).sum(axis=1), MAX_SQUARE)
    return np.exp(-0.5 * squared) / np.sqrt((2.0 * np.pi * variance).prod(axis=1))
