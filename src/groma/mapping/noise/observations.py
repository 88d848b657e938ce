# SPDX-License-Identifier: BSD-3-Clause
r"""The noise of the observations of a scene, from their residuals.

Some points, such as fine corners, are localised well in every image; others, such as large blobs and the rims of
shadows, in none. Squared residuals therefore differ far more between points than within a point. Each point :math:`i`
has its own variance :math:`v_i`, scattered around a common :math:`s^2`, and residuals follow Student's distribution,
which allows for outliers. With :math:`q_{ij}` the squared norm of a residual of two coordinates,

.. math:: \frac{\nu_b s^2}{v_i} \sim \chi^2_{\nu_b}, \qquad \frac{q_{ij}}{2 v_i} \sim F_{2, \nu_w}.

The logarithms separate the two: :math:`\log q` has the variance :math:`\psi_1(1) + \psi_1(\nu_w / 2)` within a
point, and the point means have :math:`\psi_1(\nu_b / 2)`, where :math:`\psi_1` is the trigamma function. The
variances follow by expectation maximisation. Homogeneous noise gives an infinite :math:`\nu_b`, and all points the
same variance.

The errors of the two ends of a segment are correlated. A line fitted to the pixels of an edge is more certain in its
middle than at its ends, whose errors then have a correlation of -1/2; an edge that appears displaced from view to view,
as on a rounded corner, is displaced as a whole, with a correlation of 1. The residuals show which of the two
prevails.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._typing import FloatArray, IntArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.pixel_residuals import squared_residuals_px
from groma.gates import NORMAL, gate
from groma.mapping.noise.landmarks import GATES as LANDMARK_GATES
from groma.mapping.noise.landmarks import pixels_of
from groma.problem.residuals import residuals_of
from groma.scene import Scene


@dataclass(frozen=True)
class ObservationNoiseGates:
    """From how many residuals noise is estimated, and what is believed of it."""

    unknown_px: float = gate(1.0, "px", "noise where nothing tells it", "convention: a pixel")
    max_fitted: float = gate(0.8, "share", "of the residuals that landmarks take", "derived from five tracks of two")
    min_views: int = gate(4, "observations", "of a landmark that tells its noise", "derived from one freedom in two")
    max_correlation: float = gate(0.8, "1", "of the two ends of segments", "chosen on benchmarks/surveyed.py")


GATES = ObservationNoiseGates()
#: The median of the squared norm of two normal coordinates, in variances.
_MEDIAN = 2.0 * math.log(2.0)
#: Guards: smallest squared residual over the usual one (its logarithm is taken), bounds of half the degrees of freedom.
_MIN_SQUARE, _SHAPES = 1e-4, (0.5, 1e4)
#: Guards: bounds of the degrees of freedom of segments. How many are tried (cost: each a tenth above the one before).
_FREEDOM, _BENDS = (0.5, 100.0), 60
#: Rounds of expectation maximisation (cost: time).
_STEPS = 20


def noise_px(scene: Scene, kind: Literal["points", "lines"], end_correlation: float = 0.0) -> float:
    r"""Return the standard deviation of the usual coordinate of one kind of landmark, robustly, pixels.

    The squared norm of two normal coordinates has the median :math:`2 \log 2` variances. The residuals that are left
    after the fit are scaled by their degrees of freedom. Observations carry standard deviations relative to the
    returned one. For lines the result is that of an end point, given the correlation of the errors of the two ends.
    """
    options = AssemblyOptions(
        points=kind == "points", lines=kind == "lines", planes=False, line_end_correlation=end_correlation
    )
    assembly = assemble(scene, options)
    squares = squared_residuals_px(assembly, weighted=True).get(kind)
    if squares is None or len(squares) == 0:
        return GATES.unknown_px
    unknowns = 3 * scene.num_points if kind == "points" else 4 * scene.num_lines
    share = 1.0 - min(unknowns / (2 * len(squares)), GATES.max_fitted)
    return max(float(np.sqrt(np.median(squares) / _MEDIAN / share)), LANDMARK_GATES.min_sigma_px)


def line_end_correlation(scene: Scene) -> float:
    """Return the correlation of the errors of segments' two ends across them, robustly, from the residuals.

    Segments of lines that few images see follow their line and are left out; where no others are, it is zero.
    """
    first, second = _line_residuals(scene, 0.0).T
    if len(first) < NORMAL.sample:
        return 0.0
    shift, turn = np.median(np.abs(first + second)) ** 2, np.median(np.abs(first - second)) ** 2
    return float(np.clip((shift - turn) / max(shift + turn, 1e-300), -GATES.max_correlation, GATES.max_correlation))


def line_bend(scene: Scene, end_correlation: float = 0.0) -> float:
    r"""Return the scale of a Cauchy loss of segments, in the standard deviations that :func:`noise_px` returns.

    Two coordinates that follow Student's distribution with :math:`\nu` degrees of freedom and the variance parameter v
    have the squared norm q with

    .. math:: -\log p = \frac{\nu + 2}{2} \log\left(1 + \frac{q}{c^2}\right) + \log\frac{c^2}{\nu} + \text{const},
              \qquad c^2 = \nu v,

    a Cauchy loss of the scale c. The median of q is :math:`c^2 (2^{2/\nu} - 1)`, so that with that of normal noise,
    :math:`2 \log 2`, only :math:`\nu` is open; it follows by maximum likelihood. Infinite with too few segments.
    """
    squares = (_line_residuals(scene, end_correlation) ** 2).sum(axis=1)
    usual = float(np.median(squares)) if len(squares) >= NORMAL.sample else 0.0
    if usual <= 0.0:
        return math.inf
    freedom = np.geomspace(*_FREEDOM, _BENDS)
    bend = _MEDIAN / np.expm1(_MEDIAN / freedom)
    surprise = [
        float(((nu + 2.0) / 2.0 * np.log1p(_MEDIAN * squares / usual / c2)).sum() + len(squares) * math.log(c2 / nu))
        for nu, c2 in zip(freedom, bend, strict=True)
    ]
    return math.sqrt(float(bend[int(np.argmin(surprise))]))


def _line_residuals(scene: Scene, end_correlation: float) -> FloatArray:
    """Residuals (N, 2) of segments over their relative deviations, without those of lines that few images see."""
    options = AssemblyOptions(points=False, planes=False, line_end_correlation=end_correlation)
    assembly = assemble(scene, options)
    images = np.bincount(scene.line_observations.line_idx, minlength=scene.num_lines)
    ends = [np.zeros((0, 2))]
    for group, factor in zip(assembly.groups, assembly.problem.factors, strict=True):
        if group.observes != "lines":
            continue  # measurements of other instruments
        told = images[factor.line.index] >= GATES.min_views  # type: ignore[attr-defined]
        residual, unit = residuals_of(factor, assembly.problem.variables), np.asarray(factor.sqrt_information)
        # Where a camera sees behind itself, each end has its own weight.
        weighted = residual * unit[:, None] if unit.ndim == 1 else np.einsum("nij,nj->ni", unit, residual)
        ends.append(weighted[told])
    return np.concatenate(ends)


def moved_px(before: Scene, after: Scene, share: float) -> float:
    """Return the distance in the images, pixels, by which this share of the points' observations moved at least.

    Both scenes have the same observations; what counts is where their points are seen, so the frame does not matter.
    """
    table = before.point_observations
    first, second = (pixels_of(scene, table.image_idx, scene.points.xyz[table.point_idx]) for scene in (before, after))
    away = np.linalg.norm(second - first, axis=1)
    away = away[np.isfinite(away)]
    return float(np.quantile(away, 1.0 - share)) if len(away) else 0.0


def with_point_noise(scene: Scene) -> Scene:
    """Return the scene with the noise of each point in the standard deviations of its observations.

    The standard deviations that the observations have are multiplied by a number per point, whose median over the
    observations is one. Points seen seldom stay near the usual noise; a scene with few points is returned as it is.
    """
    table, count = scene.point_observations, scene.num_points
    pixels = pixels_of(scene, table.image_idx, scene.points.xyz[table.point_idx])
    residual = (pixels - table.pixel) / table.sigma[:, None]
    seen = np.isfinite(residual).all(axis=1)
    squares, owner = (residual[seen] ** 2).sum(axis=1), table.point_idx[seen]
    number = np.bincount(owner, minlength=count)
    if np.count_nonzero(number >= GATES.min_views) < NORMAL.sample:
        return scene
    # Fitting a point takes three of the two coordinates per observation; what is left is as if they all were smaller.
    freedom = np.maximum(2 * number - 3, 1)
    share = (freedom / np.maximum(2 * number, 1))[owner]
    usual = float(np.median(squares / share)) / _MEDIAN
    if usual < LANDMARK_GATES.min_sigma_px**2:
        return scene
    squares = np.maximum(squares, _MIN_SQUARE * usual * share)
    between, within = _degrees_of_freedom(np.log(squares / share), owner, number)
    variance = np.full(count, usual)
    for _ in range(_STEPS):
        weight = (within + 2.0) / (within + squares / share / variance[owner])
        variance = (between * usual + np.bincount(owner, weight * squares, count)) / (between + freedom)
        usual = 1.0 / float(np.mean(1.0 / variance[number > 0]))
    own = np.sqrt(variance)[table.point_idx]
    return scene.replace(point_observations=table.replace(sigma=table.sigma * own / np.median(own)))


def _degrees_of_freedom(levels: FloatArray, owner: IntArray, number: IntArray) -> tuple[float, float]:
    """Degrees of freedom between points and within, from logarithms of squares and the number there are of each point.

    Few make them rather infinite than small: each is what is left of a variance that chance explains.
    """
    chosen = number[owner] >= GATES.min_views
    levels, owner = levels[chosen], owner[chosen]
    points = np.flatnonzero(number >= GATES.min_views)
    mean = np.bincount(owner, levels, len(number)) / np.maximum(number, 1)
    within = float(((levels - mean[owner]) ** 2).sum() / (number[points] - 1).sum())
    between = float(np.var(mean[points]) - within * np.mean(1.0 / number[points]))
    return 2.0 * _inverse_trigamma(between), 2.0 * _inverse_trigamma(within - float(scipy.special.polygamma(1, 1.0)))


def _inverse_trigamma(value: float) -> float:
    """Where the trigamma function, which falls, has a value; the nearer end where that is out of bounds."""
    shapes = np.geomspace(*_SHAPES, 1000)[::-1]
    return float(np.interp(value, scipy.special.polygamma(1, shapes), shapes))
