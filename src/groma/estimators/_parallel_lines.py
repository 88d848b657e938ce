# SPDX-License-Identifier: BSD-3-Clause
r"""Directions that 3D lines share, as components of a mixture that explains the directions of all lines.

With :math:`B_i` two unit vectors across the line and :math:`S_i = B_i^\top(\Sigma_i + \sigma_0^2 I + t^2\ell_i^2 I)B_i`
its noise, how parallel things are, and how far both ends of edges deviate from them, t pixels, each of which turns the
line by :math:`\ell_i`, the square of a line along v is
:math:`z^2 = (B_i v)^\top S_i^{-1} B_i v`, and its density that of Student's distribution,

.. math:: g_i(v) = \frac{1}{2\pi\sqrt{|S_i|}} \left(1 + \frac{z^2}{\nu}\right)^{-(\nu + 2)/2}.

Errors that all images of an edge share are in no covariance, so true members have heavy tails. :math:`\sigma_0` and t
are those that make all lines likeliest: walls are parallel to a fifth of a degree at worst. All other directions lie
anywhere on the half sphere, density :math:`1/2\pi`.

A direction more makes the lines more likely by a factor that is integrated over where it may be and how many lines
it may have, by Laplace's approximation. This Bayes factor has the expectation one where there is no such direction, so
that it exceeds :math:`1/N_\text{false}` with a probability below :math:`N_\text{false}`: directions are added, the one
that explains most first, as long as it does. They compete for lines, so a cluster is not explained twice.

What belongs to which is decided at the end among more: lines perpendicular to a found direction are more frequent than
others, as the edges of boxes that stand on one floor are, and so are lines that are nearly along it, as those of an
box beside another one. So each direction has its circle of the ones and its cap of the others, too, each with its own
share. A direction of four lines does not tell whether one in ten is only nearly along it, so Jeffreys' prior is part of
these shares: an uncertain line is along a direction of twenty more surely than along one of four.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._typing import FloatArray, IntArray
from groma.estimators._direction_features import Parallel
from groma.execution import map_in_threads
from groma.gates import SEARCH, STRUCTURE, gate
from groma.geometry.algebra import perpendicular, unit

#: Guesses processed by one task (cost: memory).
_AT_ONCE = 16


@dataclass(frozen=True)
class ParallelGates:
    """How directions of lines are searched, beside the options."""

    freedom: float = gate(4.0, "1", "degrees of Student's distribution of what is parallel", STRUCTURE)
    start_px: float = gate(0.05, "px", "deviation of ends, before it is estimated", STRUCTURE + ", by likelihood")
    most_px: float = gate(3.0, "px", "deviation of ends at most", "chosen on benchmarks/structure.py")
    tried: int = gate(16, "deviations", "that are tried", "cost: each two fifths larger than the one before")
    looser: float = gate(4.0, "1", "less parallel than what is exactly so", "convention: walls to a fifth of a degree")
    angles: int = gate(3, "deviations", "of directions that are tried", "cost: each twice as large as the one before")
    nearly: float = gate(8.7e-3, "rad", "that nearly parallel lines deviate", "convention: half a degree")
    prior: float = gate(0.5, "lines", "along a direction or nearly, before any is seen", "derived from Jeffreys' prior")
    max_candidates: int = gate(256, "directions", "candidates of one round", SEARCH)
    max_refined: int = gate(3, "directions", "best candidates that are refined", SEARCH)
    rounds: int = gate(15, "rounds", "of expectation and maximisation", "cost: converges in fewer")

    @property
    def deviations(self) -> FloatArray:
        """Deviations of ends to try, pixels."""
        return np.geomspace(0.01 * self.most_px, self.most_px, self.tried)

    def quantile(self, share: float) -> float:
        """Square of the whitened residual that a share of parallel features does not exceed."""
        return self.freedom * ((1.0 - share) ** (-2.0 / self.freedom) - 1.0)


#: The numbers in use.
PARALLEL = ParallelGates()


@dataclass(frozen=True)
class Acceptance:
    """When a direction is one."""

    #: Least number of lines.
    least: int
    #: Most directions, and their largest standard deviation, radians.
    most: int
    max_sigma: float
    #: Nearer ones are the same, radians.
    apart: float
    max_false_alarms: float


@dataclass(frozen=True)
class ParallelLines:
    """Directions, and what of the lines is theirs."""

    #: (D, 3) unit vectors, the likeliest first; (D, 3, 3) covariances.
    vectors: FloatArray
    covariance: FloatArray
    #: (D,) natural logarithm of the Bayes factor of each when it was found.
    evidence: FloatArray
    #: (N,) the likeliest direction of each line, its probability, and the square of the line's whitened residual.
    label: IntArray
    probability: FloatArray
    squared: FloatArray
    #: (N,) how far the ends of each line deviate from its direction beyond their noise, pixels.
    deviation: FloatArray


@dataclass(frozen=True)
class _Found:
    """Directions (D, 3) with the evidence of each, and (D, N) probabilities and squared residuals of lines."""

    vectors: FloatArray
    evidence: FloatArray
    probability: FloatArray
    squared: FloatArray


def parallel_lines(
    directions: FloatArray, covariance: FloatArray, sigma: float, turned: FloatArray | None, wanted: Acceptance
) -> ParallelLines:
    """Find the directions that lines share; ``turned`` None: ends do not deviate. See the module."""
    px = np.zeros(1) if turned is None else np.concatenate([[PARALLEL.start_px, 0.0], PARALLEL.deviations])
    turned = np.zeros(len(directions)) if turned is None else turned
    noise = [(angle, one) for angle in np.geomspace(PARALLEL.looser * sigma, sigma, PARALLEL.angles) for one in px]
    pools = map_in_threads(lambda one: Parallel.of(directions, covariance, np.hypot(one[0], one[1] * turned)), noise)
    guesses = directions[np.argsort(pools[0].area, kind="stable")[: PARALLEL.max_candidates]]
    found = _search(pools[0], guesses, wanted)
    best = _most_likely(pools, found) if len(found.vectors) else len(pools) - len(px)
    if best:
        found = _search(pools[best], guesses, wanted)
    weight = found.probability * (PARALLEL.freedom + 2.0) / (PARALLEL.freedom + found.squared)
    spread = [_covariance(pools[best], one, vector) for one, vector in zip(weight, found.vectors, strict=True)]
    nothing = np.zeros((1, len(directions)))
    label = np.concatenate([found.probability, nothing]).argmax(axis=0)
    mine = label, np.arange(len(label))
    squared = np.concatenate([found.squared, nothing])[mine]
    # Student's distribution is normal with a variance for each line: its factor, given the residual.
    factor = np.maximum((PARALLEL.freedom + squared) / (PARALLEL.freedom + 2.0), 1.0)
    angle, deviation = noise[best]
    beyond = (factor - 1.0) * pools[best].area + angle**2 - sigma**2
    beyond = np.divide(beyond, turned**2, out=np.zeros(len(label)), where=turned > 0.0)
    return ParallelLines(
        found.vectors,
        np.array(spread).reshape(-1, 3, 3),
        found.evidence,
        label,
        np.concatenate([found.probability, nothing])[mine],
        squared,
        np.sqrt(np.maximum(beyond, 0.0) + deviation**2),
    )


def _search(pool: Parallel, guesses: FloatArray, wanted: Acceptance) -> _Found:
    """Find the directions of lines among guesses (H, 3)."""
    found, share, evidence = np.zeros((0, 3)), np.zeros(0), []
    members = _members(pool, guesses)
    while len(found) < wanted.most and len(pool) >= max(wanted.least, 2):
        far = (np.abs(guesses @ found.T) < math.cos(wanted.apart)).all(axis=1)
        best = _best(pool, (guesses[far], members[far]), (found, share), wanted)
        if best is None:
            break
        direction, part, factor = best
        found, share, _, _ = _fitted(pool, np.vstack([found, direction]), np.append(share * (1.0 - part), part), False)
        evidence.append(factor)
    found, _, probability, squared = _fitted(pool, found, share, True)
    return _Found(found, np.array(evidence), probability, squared)


def _most_likely(pools: list[Parallel], found: _Found) -> int:
    """Which of several pools of the same lines, with other noise, is the likeliest with these directions."""
    none = 1.0 - found.probability.sum(axis=0, keepdims=True)
    share = np.maximum(np.concatenate([found.probability, none]).mean(axis=1, keepdims=True), 1e-12)

    def likelihood(pool: Parallel) -> float:
        parts = np.vstack([_members(pool, found.vectors), _anywhere(pool)])
        return float(_log_sum(np.log(share) + parts).sum())

    return int(np.argmax(map_in_threads(likelihood, pools)))


def _log_sum(logarithms: FloatArray) -> FloatArray:
    """Logarithm (N,) of the sum of what (D, N) are the logarithms of."""
    largest = logarithms.max(axis=0)
    return largest + np.log(np.exp(logarithms - largest).sum(axis=0))


def _anywhere(pool: Parallel) -> FloatArray:
    """Logarithm (1, N) of the density of lines that are along nothing."""
    return np.full((1, len(pool)), -math.log(2.0 * math.pi))


def _members(pool: Parallel, vectors: FloatArray) -> FloatArray:
    """Logarithm (D, N) of the densities of lines along directions."""
    bent = np.log1p(pool.squared(vectors) / PARALLEL.freedom)
    return -0.5 * (PARALLEL.freedom + 2.0) * bent - np.log(2.0 * math.pi * pool.area)


def _nearly(pool: Parallel, vectors: FloatArray) -> FloatArray:
    """Logarithm (D, N) of the densities of lines that are nearly along directions."""
    variance = PARALLEL.nearly**2 + pool.area
    return -0.5 * (1.0 - (vectors @ pool.directions.T) ** 2) / variance - np.log(2.0 * math.pi * variance)


def _across(pool: Parallel, vectors: FloatArray) -> FloatArray:
    """Logarithm (D, N) of the densities of lines anywhere on the circles perpendicular to directions."""
    variance = ((vectors @ np.swapaxes(pool.whitened, 1, 2)) ** 2 / (pool.whitened**2).sum(axis=2)[:, None] ** 2).sum(
        axis=2
    )
    bent = np.log1p((vectors @ pool.directions.T) ** 2 / variance.T / PARALLEL.freedom)
    scale = (
        scipy.special.gammaln(0.5 * (PARALLEL.freedom + 1.0))
        - scipy.special.gammaln(0.5 * PARALLEL.freedom)
        - math.log(math.pi)
    )
    return scale - 0.5 * (PARALLEL.freedom + 1.0) * bent - 0.5 * np.log(PARALLEL.freedom * math.pi * variance.T)


def _best(
    pool: Parallel, guessed: tuple[FloatArray, FloatArray], found: tuple[FloatArray, FloatArray], wanted: Acceptance
) -> tuple[FloatArray, float, float] | None:
    """Direction, share of the lines and evidence of the best new direction; None if none is one.

    Guesses (H, 3) come with the densities (H, N) of lines along them.
    """
    (vectors, share), (guesses, members) = found, guessed
    log_share = np.log(np.append(share, max(1.0 - share.sum(), 1e-12)))[:, None]
    before = _log_sum(log_share + np.vstack([_members(pool, vectors), _anywhere(pool)]))

    def gains(rows: slice) -> tuple[FloatArray, FloatArray]:
        ratio = np.exp(np.minimum(members[rows] - before, 600.0))
        part = np.full((len(ratio), 1), min(3.0 / len(pool), 0.5))
        for _ in range(4):
            told = part * ratio
            part = (told / (1.0 - part + told)).mean(axis=1, keepdims=True)
        return part, np.log1p(part * (ratio - 1.0)).sum(axis=1)

    rows = [slice(first, first + _AT_ONCE) for first in range(0, len(guesses), _AT_ONCE)]
    parts, sums = zip(*map_in_threads(gains, rows), strict=True) if rows else ((np.zeros((0, 1)),), (np.zeros(0),))
    part, gain = np.concatenate(parts), np.concatenate(sums)
    best, tried = None, np.zeros((0, 3))
    for k in np.argsort(-gain, kind="stable"):
        if len(tried) == PARALLEL.max_refined:
            break
        if (np.abs(tried @ guesses[k]) > math.cos(wanted.apart)).any():
            continue
        tried = np.vstack([tried, guesses[k]])
        refined = _refined(pool, before, guesses[k], _share(part[k, 0]), wanted)
        new = refined is not None and (np.abs(vectors @ refined[0]) < math.cos(wanted.apart)).all()
        if refined is not None and new and (best is None or refined[2] > best[2]):
            best = refined
    return best


def _share(part: float) -> float:
    """A share of the lines that leaves some to this and some to other directions."""
    return float(np.clip(part, 1e-12, 1.0 - 1e-12))


def _refined(
    pool: Parallel, before: FloatArray, direction: FloatArray, part: float, wanted: Acceptance
) -> tuple[FloatArray, float, float] | None:
    """The direction where it explains most, beside what was before; None if it is none."""
    mine, weight = np.zeros(len(pool)), np.zeros(len(pool))
    density = before
    for _ in range(PARALLEL.rounds):
        member = _members(pool, direction[None])[0] + math.log(part)
        density = np.logaddexp(math.log1p(-part) + before, member)
        mine = np.exp(member - density)
        weight = mine * (PARALLEL.freedom + 2.0) / (PARALLEL.freedom + pool.squared(direction[None])[0])
        direction = _mean(pool, weight[None], direction[None])[0]
        part = _share(mine.mean())
    variance = np.linalg.eigvalsh(_covariance(pool, weight, direction))[1:]
    evidence = float((density - before).sum() + 0.5 * np.log(variance).sum())
    evidence += 0.5 * math.log(2.0 * math.pi * part * (1.0 - part) / len(pool))
    enough = (mine > 0.5).sum() >= wanted.least and variance[-1] < wanted.max_sigma**2
    return (direction, part, evidence) if enough and evidence > -math.log(wanted.max_false_alarms) else None


def _fitted(
    pool: Parallel, vectors: FloatArray, share: FloatArray, with_more: bool
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Directions together: vectors, shares, and (D, N) probabilities and squared residuals of lines along them."""
    num = len(vectors)
    kinds = 1 + 2 * num * with_more
    others = np.full(kinds, max(1.0 - share.sum(), 1e-12) / kinds)
    shares, mine, squared = np.concatenate([share, others]), np.zeros((num, len(pool))), np.zeros((num, len(pool)))
    prior = np.zeros(len(shares))
    if with_more:
        prior[:num] = prior[num + 1 : 2 * num + 1] = PARALLEL.prior  # of directions and their caps
    for _ in range(PARALLEL.rounds if num else 0):
        parts = [_members(pool, vectors), _anywhere(pool)]
        if with_more:
            parts += [_nearly(pool, vectors), _across(pool, vectors)]
        mixed = np.log(np.maximum(shares, 1e-300))[:, None] + np.vstack(parts)
        probability = np.exp(mixed - mixed.max(axis=0))
        probability /= probability.sum(axis=0)
        shares = (probability.sum(axis=1) + prior) / (len(pool) + prior.sum())
        mine, squared = probability[:num], pool.squared(vectors)
        weight = mine * (PARALLEL.freedom + 2.0) / (PARALLEL.freedom + squared)
        vectors = _mean(pool, weight, vectors)
    return vectors, shares[:num], mine, squared


def _mean(pool: Parallel, weight: FloatArray, start: FloatArray) -> FloatArray:
    """The directions (D, 3) of least squares with some weights (D, N), on the side of the starts."""
    information = (weight @ pool.products).reshape(-1, 3, 3)
    direction = np.linalg.eigh(information)[1][:, :, 0]
    return unit(np.where(np.einsum("di,di->d", direction, start)[:, None] > 0.0, direction, -direction))


def _covariance(pool: Parallel, weight: FloatArray, direction: FloatArray) -> FloatArray:
    """Covariance (3, 3) of a direction of least squares, of rank 2."""
    basis = np.stack(perpendicular(direction))
    slope = pool.whitened @ basis.T
    information = np.einsum("n,nka,nkb->ab", weight, slope, slope)
    information += 1e-6 * max(np.trace(information), 1e-300) * np.eye(2)
    return basis.T @ np.linalg.inv(information) @ basis
