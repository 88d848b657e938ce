# SPDX-License-Identifier: BSD-3-Clause
r"""Directions that many features share: perpendicular to plane normals, or parallel to measured directions.

A segment in an image fixes a plane through the camera centre; the direction of its 3D line is perpendicular to the
plane's normal, whatever the camera model. Lines that are parallel in space therefore share a direction v with

.. math:: z_i = \frac{n_i^\top v}{\sqrt{v^\top \Sigma_i v + \sigma_0^2}} \sim N(0, 1).

:math:`\sigma_0` says how parallel things are that are built to be parallel. Directions are found one after the other:
the candidate that explains most, refined by robust least squares, then taken out. A feature agrees with a random
direction by chance, with probability :math:`p_i`; it counts by its information :math:`-\log p_i`, so that long
segments count more, and a direction is kept when fewer than ``max_false_alarms`` such coincidences are to be expected
among all that could be tried:

.. math:: N_\text{tried}\; P(\text{Poisson}(\textstyle\sum p_i) \ge k) < N_\text{false}.

Directions of 3D lines are components of a mixture (:mod:`groma.estimators._parallel_lines`); the same bound holds there
for the evidence of each.

The sign of a direction has no meaning.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError, given_or_default
from groma.estimators._direction_features import Perpendicular, crossings
from groma.estimators._parallel_lines import PARALLEL, Acceptance, parallel_lines
from groma.estimators.association import log10_poisson_tail
from groma.gates import NORMAL, SEARCH, chi_square_gate, gate
from groma.geometry.algebra import dot, unit, vectors


@dataclass(frozen=True)
class DirectionGates:
    """How common directions are searched, beside the options."""

    refine_steps: int = gate(12, "steps", "steps of the robust refinement", "cost: converges in fewer")
    max_candidates: int = gate(512, "directions", "candidates of one round", SEARCH)
    max_scored: int = gate(4096, "features", "features that score them", SEARCH)
    min_sine: float = gate(0.02, "rad", "of two normals that make a candidate", "derived from noise of 0.05 degrees")
    wider: float = gate(4.0, "1", "factor of the squared gate in the refinement", "chosen on synthetic rooms")
    max_move: float = gate(0.05, "rad", "longest step of the refinement", "derived from linearity")
    parallel: float = gate(8.7e-4, "rad", "that exact directions deviate", "convention: 0.05 degrees")
    max_orthogonal_sigma: float = gate(0.01, "rad", "of right angles that tell something", "chosen on synthetic rooms")


#: The numbers in use.
DIRECTIONS = DirectionGates()


@dataclass(frozen=True)
class DirectionOptions:
    """What counts as a common direction."""

    #: How parallel things are that are meant to be, radians; added to the measured noise.
    parallel_sigma: float = DIRECTIONS.parallel
    #: A feature agrees when the chi-square test of its residual passes at this level (convention: level of a test).
    level: float = 0.95
    #: Least number of features that agree beyond those that determine a direction, one line or two segments: four
    #: parallel lines are enough, if they are long enough not to be parallel by chance.
    min_coincidences: int = 3
    #: Expected number of directions found where there are none (convention: of tests by meaningfulness).
    max_false_alarms: float = 1e-4
    #: Most directions (cost: time).
    max_directions: int = 24
    #: Directions whose standard deviation is larger are dropped, radians (convention: two degrees).
    max_sigma: float = 0.035
    #: Random seed of the candidates.
    seed: int = 0


@dataclass(frozen=True)
class DirectionSet:
    """Directions found, the strongest first."""

    #: (D, 3) unit vectors.
    vectors: FloatArray
    #: (D, 3, 3) covariances, square radians, of rank 2: the vector itself is in the null space.
    covariance: FloatArray
    #: (D,) number of features that agree.
    support: IntArray
    #: (D,) base-10 logarithm of the expected number of false alarms.
    log10_false_alarms: FloatArray
    #: (N,) the direction of each feature, -1 for none.
    label: IntArray
    #: (M, 2) pairs of directions that are orthogonal within their uncertainty.
    orthogonal: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    #: Of 3D lines: (N,) probability that they are along their direction, and how far their ends deviate from it beyond
    #: their noise, pixels.
    probability: FloatArray = field(default_factory=lambda: np.zeros(0))
    deviation: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.vectors)


# -------------------------------------------------------------------------------------------------------------- Public
def directions_from_normals(
    normals: FloatArray, factors: FloatArray, options: DirectionOptions | None = None
) -> DirectionSet:
    r"""Find directions perpendicular to many unit normals: vanishing directions of segments.

    Parameters
    ----------
    normals : (N, 3) float64
        Unit normals of the planes through camera centre and segment, in one common frame: a camera's, or the world's
        for segments of several images (their translations play no part).
    factors : (N, 3, 2) float64
        Square roots of the normals' covariances, :math:`F F^\top`, radians.
    options : DirectionOptions, optional
        What counts as a direction.

    Returns
    -------
    DirectionSet
        The strongest direction first.

    Raises
    ------
    ShapeError, InputError
        If shapes do not fit, or a number is not finite.
    """
    options = given_or_default(options, DirectionOptions)
    normals = vectors(normals, 3, "normals")
    factors = np.asarray(factors, dtype=np.float64)
    if normals.ndim != 2 or factors.shape != (len(normals), 3, 2):
        raise ShapeError(
            f"normals and factors must have shapes (N, 3) and (N, 3, 2); got {normals.shape} and {factors.shape}."
        )
    _check_finite(normals, factors)
    return _search(Perpendicular(normals, factors, options.parallel_sigma), options)


def directions_from_lines(
    directions: FloatArray,
    covariance: FloatArray,
    options: DirectionOptions | None = None,
    turned: FloatArray | None = None,
) -> DirectionSet:
    """Find directions shared by 3D lines; either sign of a line's direction is the same.

    Parameters
    ----------
    directions : (N, 3) float64
        Unit directions.
    covariance : (N, 3, 3) float64
        Their covariances, square radians; only the part across the direction counts.
    options : DirectionOptions, optional
        What counts as a direction.
    turned : (N,) float64, optional
        Angle by which a pixel at both ends turns each line, radians: how far edges deviate from what they are parallel
        to is estimated. By default they do not.

    Returns
    -------
    DirectionSet
        The strongest direction first.

    Raises
    ------
    ShapeError, InputError
        If shapes do not fit, or a number is not finite.
    """
    options = given_or_default(options, DirectionOptions)
    directions = vectors(directions, 3, "directions")
    covariance = np.asarray(covariance, dtype=np.float64)
    if directions.ndim != 2 or covariance.shape != (len(directions), 3, 3):
        raise ShapeError(
            f"directions and covariance must have shapes (N, 3) and (N, 3, 3); got {directions.shape} and "
            f"{covariance.shape}."
        )
    _check_finite(directions, covariance)
    sigma, bound = options.parallel_sigma, options.max_false_alarms
    apart = NORMAL.far * sigma
    wanted = Acceptance(options.min_coincidences + 1, options.max_directions, options.max_sigma, apart, bound)
    found = parallel_lines(unit(directions), covariance, sigma, turned, wanted)
    agrees = (found.probability > 0.5) & (found.squared < PARALLEL.quantile(options.level))
    return DirectionSet(
        found.vectors,
        found.covariance,
        np.bincount(found.label[agrees], minlength=len(found.vectors)),
        -found.evidence / np.log(10.0),
        np.where(agrees, found.label, -1),
        orthogonal_pairs(found.vectors, found.covariance, NORMAL.far * sigma),
        found.probability,
        found.deviation,
    )


def orthogonal_pairs(
    directions: FloatArray, covariance: FloatArray, sigma: float = NORMAL.far * DIRECTIONS.parallel
) -> IntArray:
    r"""Pairs of directions that are orthogonal within their uncertainty.

    .. math:: \frac{(v_1^\top v_2)^2}{v_1^\top\Sigma_2 v_1 + v_2^\top\Sigma_1 v_2 + \sigma^2} < \chi^2_1

    Parameters
    ----------
    directions : (D, 3) float64
        Unit vectors.
    covariance : (D, 3, 3) float64
        Their covariances.
    sigma : float
        How orthogonal things are that are meant to be, radians. Default 0.15 degrees.

    Returns
    -------
    (M, 2) int
        Pairs of indices, smaller first. Three directions that are pairwise in the list are a Manhattan frame.
    """
    directions = vectors(directions, 3, "directions").reshape(-1, 3)
    first, second = np.triu_indices(len(directions), 1)
    cosine = dot(directions[first], directions[second])
    variance = np.einsum("mi,mij,mj->m", directions[first], covariance[second], directions[first])
    variance += np.einsum("mi,mij,mj->m", directions[second], covariance[first], directions[second])
    passed = cosine**2 < chi_square_gate(NORMAL.significance, 1) * (variance + sigma**2)
    passed &= variance < DIRECTIONS.max_orthogonal_sigma**2
    return np.column_stack([first, second])[passed]


# -------------------------------------------------------------------------------------------------------------- Search
def _check_finite(*arrays: FloatArray) -> None:
    if not all(np.isfinite(array).all() for array in arrays):
        raise InputError("Directions, normals and covariances must be finite. Remove the rows that are not.")


def _search(features: Perpendicular, options: DirectionOptions) -> DirectionSet:
    """Find directions one by one; see the module."""
    rng = np.random.default_rng(options.seed)
    gate = chi_square_gate(1.0 - options.level, 1)
    # Features up to the 10^-4 quantile are taken out, too, so that the rest does not repeat the direction.
    wide = chi_square_gate(NORMAL.never, 1)
    tried = max(len(features), 2) ** 2
    remaining = np.arange(len(features))
    found: list[FloatArray] = []
    covariances: list[FloatArray] = []
    alarms: list[float] = []
    least = options.min_coincidences + 2
    how = DIRECTIONS.wider, DIRECTIONS.max_move, DIRECTIONS.refine_steps
    while len(found) < options.max_directions and len(remaining) >= max(least, 2):
        pool = features.take(remaining)
        guesses = crossings(pool, DIRECTIONS.max_candidates, DIRECTIONS.min_sine, rng)
        if len(guesses) == 0:
            break
        scored = pool
        if len(remaining) > DIRECTIONS.max_scored:
            scored = pool.take(rng.choice(len(remaining), DIRECTIONS.max_scored, replace=False))
        accepted = None
        order = np.argsort(-_score(scored, guesses, gate), kind="stable")
        for start in guesses[order[: PARALLEL.max_refined]]:
            direction, covariance = pool.refined(start, gate, *how)
            inside = pool.squared(direction[None])[0] < gate
            count = int(inside.sum())
            expected = float(np.broadcast_to(pool.chance(direction[None], gate), (1, len(pool))).sum())
            tail = log10_poisson_tail(count - 1, expected) + np.log10(tried)
            certain = float(np.linalg.eigvalsh(covariance)[-1]) < options.max_sigma**2
            strong = tail < np.log10(options.max_false_alarms) and count >= least
            new = all(abs(float(direction @ other)) < np.cos(NORMAL.far * options.parallel_sigma) for other in found)
            if strong and certain and new:
                accepted = direction, covariance, tail
                break
        if accepted is None:
            break
        direction, covariance, tail = accepted
        found.append(direction)
        covariances.append(covariance)
        alarms.append(tail)
        remaining = remaining[pool.squared(direction[None])[0] >= wide]
    return _collect(features, found, covariances, alarms, gate, options)


def _collect(
    features: Perpendicular,
    found: list[FloatArray],
    covariances: list[FloatArray],
    alarms: list[float],
    gate: float,
    options: DirectionOptions,
) -> DirectionSet:
    """Give each feature to the direction that it fits best, and look for right angles."""
    label = np.full(len(features), -1)
    if not found:
        return DirectionSet(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, np.int64), np.zeros(0), label)
    directions, covariance = np.array(found), np.array(covariances)
    squared = features.squared(directions)
    nearest = squared.argmin(axis=0)
    agrees = squared.min(axis=0) < gate
    label[agrees] = nearest[agrees]
    support = np.bincount(label[agrees], minlength=len(found))
    pairs = orthogonal_pairs(directions, covariance, NORMAL.far * options.parallel_sigma)
    return DirectionSet(directions, covariance, support, np.array(alarms), label, pairs)


def _score(pool: Perpendicular, candidates: FloatArray, gate: float) -> FloatArray:
    """Information (H,) that candidates explain: certain features count more, those near the gate less."""
    agreement = np.maximum(1.0 - pool.squared(candidates) / gate, 0.0)
    return -(agreement * np.log(np.maximum(pool.chance(candidates, gate), 1e-12))).sum(axis=1)


__all__ = ["DirectionOptions", "DirectionSet", "directions_from_lines", "directions_from_normals", "orthogonal_pairs"]
