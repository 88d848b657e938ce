# SPDX-License-Identifier: BSD-3-Clause
r"""Which features belong to a structure: a mixture of those on it and of clutter around it.

A chi-square test asks whether a distance *could* be noise. That is not enough: among many features near a plane some
pass by chance, and one whose noise is large passes always. Each structure is therefore given the share :math:`\pi` of
what lies in a band of half thickness B around it and belongs to it; the rest is spread evenly. With the distance h
and its standard deviation s,

.. math:: P = \frac{\pi\, g(h; s)}{\pi\, g(h; s) + (1 - \pi)/B}, \qquad
          g(h; s) = \sqrt{\tfrac{2}{\pi_0}}\,\frac1s e^{-h^2/2s^2}, \quad \pi_0 = 3.14\ldots

The shares follow by expectation maximisation. A feature with :math:`s \ge B` is uninformative and never reaches a high
probability.
"""

from __future__ import annotations

import math

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._numba import exact_kernel, loop
from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.errors import ShapeError

#: Cost: rounds of expectation maximisation.
ROUNDS = 30
#: Squared distances beyond this count as this, in variances: a density does not become zero (derived from the range of
#: doubles).
MAX_SQUARE = 1400.0


@exact_kernel
def _expected(noise, clutter, begin, end, share, probability):
    """Probabilities of the features from ``begin`` to before ``end``, and their sum, always in this order."""
    total = 0.0
    for n in range(begin, end):
        inner = share * noise[n]
        probability[n] = inner / (inner + (1.0 - share) * clutter[n])
        total += probability[n]
    return total


@loop
def _maximise(noise, clutter, first, pooled, common, rounds, share, probability):
    """Expectation and maximisation, by turns: probabilities (N,) and shares (K,).

    The features of structure k are those from ``first[k]`` to ``first[k + 1]``. Once its share stays the same, to the
    last digit, so does all that would follow.
    """
    for k in range(len(share)):
        count = first[k + 1] - first[k]
        for _ in range(rounds):
            before = share[k]
            total = _expected(noise, clutter, first[k], first[k + 1], before, probability)
            share[k] = (total + pooled * common) / (count + pooled)
            if share[k] == before:
                break


def inlier_probability(
    distance: FloatArray, sigma: FloatArray, owner: IntArray, band: FloatArray, pooled: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Probability that features belong to their structures.

    Parameters
    ----------
    distance : (N,) float64
        Distances from the structures, zero or greater and below the band, scene units or radians.
    sigma : (N,) float64
        Standard deviations of the distances.
    owner : (N,) int
        The structure of each distance.
    band : (K,) float64
        Half thickness of the band of each structure, in the unit of the distances.
    pooled : float
        How many features the share of all structures together counts in the share of each. Above zero for small
        structures, which cannot tell their own share.

    Returns
    -------
    probability : (N,) float64
    share : (K,) float64
        Part of the features in the band that belong to the structure; one half where there are none.

    Raises
    ------
    ShapeError
        If shapes do not fit.
    """
    distance, sigma, owner = np.asarray(distance, float), np.asarray(sigma, float), np.asarray(owner)
    band = np.asarray(band, float)
    if not (distance.shape == sigma.shape == owner.shape) or distance.ndim != 1 or band.ndim != 1:
        raise ShapeError(
            f"distance, sigma and owner must have the same shape (N,); got {distance.shape}, {sigma.shape}, "
            f"{owner.shape}."
        )
    spread = np.maximum(sigma, 1e-12 * band[owner] if len(band) else 0.0)
    noise = np.sqrt(2.0 / np.pi) / spread * np.exp(-0.5 * np.minimum((distance / spread) ** 2, MAX_SQUARE))
    clutter = 1.0 / band[owner] if len(band) else np.zeros(0)
    if pooled > 0.0 and len(distance):
        _, shares = inlier_probability(distance / band[owner], spread / band[owner], np.zeros_like(owner), np.ones(1))
        common = float(shares[0])
    else:
        common, pooled = 0.5, 2.0
    share, order = np.full(len(band), 0.5), np.argsort(owner, kind="stable")
    sorted_probability, probability = np.zeros(len(distance)), np.zeros(len(distance))
    first = pointers_of(np.bincount(owner, minlength=len(band)))
    # Some features in advance keep small structures from extremes.
    _maximise(noise[order], clutter[order], first, pooled, common, ROUNDS, share, sorted_probability)
    probability[order] = sorted_probability
    return probability, share


def maximise_shares(
    density: FloatArray, clutter: FloatArray, owner: IntArray, num: int, pooled: float, rounds: int
) -> FloatArray:
    """Shares (K,) of members by expectation maximisation, from the densities (N,) of members and of clutter.

    The share of all structures together counts ``pooled`` features in that of each.
    """
    order = np.argsort(owner, kind="stable")
    density, clutter, probability = density[order], clutter[order], np.zeros(len(density))
    common = np.full(1, 0.5)
    _maximise(density, clutter, np.array([0, len(owner)]), 1.0, 0.5, rounds, common, probability)
    share, first = np.full(num, float(common[0])), pointers_of(np.bincount(owner, minlength=num))
    _maximise(density, clutter, first, pooled, float(common[0]), rounds, share, probability)
    return share


def log10_binomial_tail(count: int, number: int, chance: float) -> float:
    """Return the logarithm of the probability that more than ``count`` of a number of events with a chance occur."""
    if count < 0 or chance >= 1.0:
        return 0.0
    tail = float(scipy.special.bdtrc(count, number, chance))
    if tail > 0.0:
        return math.log10(tail)
    # Below the smallest number the first term is nearly all of the sum.
    first, others = count + 1, number - count - 1
    ways = math.lgamma(number + 1) - math.lgamma(first + 1) - math.lgamma(others + 1)
    return (ways + first * math.log(chance) + others * math.log1p(-chance)) / math.log(10.0)


def log10_poisson_tail(count: float, mean: float) -> float:
    """Return the logarithm of the probability of more than ``count`` events where ``mean`` are expected."""
    if count < 0:
        return 0.0
    if mean <= 0.0:
        return -math.inf
    tail = float(scipy.special.pdtrc(count, mean))
    # Below the smallest number the first term is nearly all of the sum.
    first = math.floor(count) + 1
    log_tail = math.log(tail) if tail > 0.0 else first * math.log(mean) - mean - math.lgamma(first + 1)
    return log_tail / math.log(10.0)
