# SPDX-License-Identifier: BSD-3-Clause
r"""Edges and texture are distinguished by the fraction of images that show a line among those that should.

An edge is detected in most images that see it, except where it is occluded. A segment of texture is detected in few:
what agrees in three images by chance agrees in few others. Let a line be observed in k of the m images that should show
it (where it is in view, and longer than the shortest segments). It is drawn from one of two populations,

.. math:: P(k \mid m, c) \propto \binom{m-1}{k-1}
          \frac{B(k - 1 + r_c s_c,\; m - k + (1 - r_c)\, s_c)}{B(r_c s_c,\; (1 - r_c)\, s_c)},

with the mean rates :math:`r_c` and concentrations :math:`s_c` of :class:`TextureGates`, given that k is at
least what a line needs. The population of a line depends on its segments, long and strong ones being edges,

.. math:: P(\text{edge}) = \frac{1}{1 + \exp(-w_0 - w_1 \log l - w_2 \log s - w_3 \log \sigma)},

and a fraction :math:`\pi_c` of the segments becomes part of a line, which is small for texture. Weights and fractions
are the maximum a posteriori estimate, with wide priors, from the lines and the remaining segments of these images.
Scenes without texture, such as plain boxes, keep their lines that are seen in few images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_in_threads
from groma.gates import LINE_MAPS, gate
from groma.mapping.lines.filtering.kinds import features_of
from groma.mapping.lines.linking.tracks import Tracks


@dataclass(frozen=True)
class TextureGates:
    """The two populations, and the priors."""

    edge: tuple[float, float] = gate((0.6, 6.0), "1", "mean and concentration of how often an edge shows", LINE_MAPS)
    texture: tuple[float, float] = gate((0.22, 15.0), "1", "the same of a line of texture", LINE_MAPS)
    line_shares: tuple[float, float] = gate(
        (0.06, 0.35), "share", "of texture, and of edges, that becomes a line: middle of the prior", LINE_MAPS
    )
    share_sigma: float = gate(0.5, "log odds", "deviation of the prior of the shares", "chosen on benchmarks/lines.py")
    weight_sigma: tuple[float, float] = gate(
        (10.0, 1.5), "log odds", "of the priors of the first weight and of the others", "convention: wide priors"
    )


GATES = TextureGates()

#: A value, its gradient and its second derivatives.
Cost = tuple[float, FloatArray, FloatArray]
#: Newton's steps (about six are needed; cost: time), what a step has to gain of what it promises (Armijo's rule), and
#: what is too little for the rounding of the cost, as a share of it.
_STEPS, _SUFFICIENT, _RESOLVED = 50, 1e-4, 1e-13


def num_expected(tracks: Tracks, neighbors: list[IntArray], size: IntArray, min_length: float) -> IntArray:
    """(L,) how many images should show each line: its own and their neighbours, where ``min_length`` of it is in view.

    ``size`` (C, 2) is the width and height of the images, pixels; 0 where it is not known.
    """
    reach = tracks.lines_near_images(neighbors)
    bound = np.where(size > 0, size, np.inf)
    count = np.zeros(tracks.num_lines, np.int64)
    work = [(P, tracks.lines[lines], limit) for P, lines, limit in zip(tracks.views.camera, reach, bound, strict=True)]
    for lines, shown in zip(reach, map_in_threads(partial(_shown_in, min_length), work), strict=True):
        count[lines[shown]] += 1
    return np.maximum(count, tracks.num_images())


def _shown_in(min_length: float, image: tuple[FloatArray, FloatArray, FloatArray]) -> IntArray:
    """Which of some lines an image with this camera and size should show."""
    P, ends, limit = image
    x = ends @ P[:, :3].T + P[:, 3]
    ahead = (x[..., 2] > 1e-6).all(1)
    pixel = x[ahead, :, :2] / x[ahead, :, 2:]
    along = pixel[:, 1] - pixel[:, 0]
    safe = np.where(np.abs(along) < 1e-9, 1e-9, along)
    both = np.sort([-pixel[:, 0] / safe, (limit - pixel[:, 0]) / safe], axis=0)
    length = (both[1].min(1).clip(max=1.0) - both[0].max(1).clip(0.0)) * np.linalg.norm(along, axis=1)
    return np.flatnonzero(ahead)[length >= min_length]


def edge_odds(
    kinds: tuple[FloatArray, ...],
    line_of: IntArray,
    eligible: BoolArray,
    seen: IntArray,
    expected: IntArray,
    min_images: int,
) -> FloatArray:
    """Log odds (L,) that a line is an edge, not texture.

    Parameters
    ----------
    kinds : n arrays (S,)
        What tells segments of edges from others: length in pixels, mean gradient, standard deviation of the fit.
    line_of : (S,) int
        Line of each segment, -1 for none.
    eligible : (S,) bool
        Segments that could have become part of a line.
    seen, expected : (L,) int
        Number of images that show each line, and that should.
    min_images : int
        Lines of fewer images were dropped.
    """
    log_expit = scipy.special.log_expit
    member = line_of >= 0
    features = features_of(eligible | member, *kinds)
    leftover = features[eligible & ~member]
    number = np.maximum(np.bincount(line_of[member], minlength=len(seen)), 1)
    sums = [np.bincount(line_of[member], column, minlength=len(seen)) for column in features[member].T]
    lines = np.column_stack(sums) / number[:, None]
    ratio = _log_chance(seen, expected, min_images, GATES.edge)
    ratio -= _log_chance(seen, expected, min_images, GATES.texture)
    spread = np.array([GATES.weight_sigma[0]] + [GATES.weight_sigma[1]] * len(kinds))
    usual = np.log([share / (1.0 - share) for share in GATES.line_shares])
    p = _minimum(partial(_cost, lines, ratio, leftover, spread, usual), np.concatenate([1.0 / spread, usual]))
    return lines @ p[:-2] + ratio + log_expit(p[-1]) - log_expit(p[-2])


def _cost(
    lines: FloatArray, ratio: FloatArray, leftover: FloatArray, spread: FloatArray, usual: FloatArray, p: FloatArray
) -> Cost:
    """Return what is least at the maximum a posteriori estimate of weights and log odds of shares, ``p``.

    Features are those of lines, with the logarithm of how much likelier the images are of edges, and those of leftover
    segments. Priors have zero weights with deviations ``spread``, and the ``usual`` odds.
    """
    expit, log_expit = scipy.special.expit, scipy.special.log_expit
    weights, odds = p[:-2], p[-2:]
    middle = np.concatenate([np.zeros(len(weights)), usual])
    precision = np.concatenate([spread**-2.0, np.full(2, GATES.share_sigma**-2.0)])
    slope, bend = precision * (p - middle), np.diag(precision)
    value = 0.5 * float(slope @ (p - middle))
    for features, gain, sign in ((lines, ratio, 1.0), (leftover, 0.0, -1.0)):
        z = features @ weights
        texture, edge = log_expit(-z) + log_expit(sign * odds[0]), log_expit(z) + log_expit(sign * odds[1]) + gain
        value -= float(np.logaddexp(texture, edge).sum())
        is_edge, before, share = expit(edge - texture), expit(z), sign * expit(-sign * odds)
        unsure, number = is_edge * (1.0 - is_edge), np.array([(1.0 - is_edge).sum(), is_edge.sum()])
        slope[:-2] -= features.T @ (is_edge - before)
        slope[-2:] -= share * number
        turn = share * [-1.0, 1.0]  # how the log odds of an edge change with those of both shares
        bend[:-2, :-2] -= (features * (unsure - before * (1.0 - before))[:, None]).T @ features
        bend[:-2, -2:] -= np.outer(features.T @ unsure, turn)
        bend[-2:, -2:] -= unsure.sum() * np.outer(turn, turn) - np.diag(number * expit(odds) * expit(-odds))
    bend[-2:, :-2] = bend[:-2, -2:].T
    return value, slope, bend


def _minimum(cost: Callable[[FloatArray], Cost], at: FloatArray) -> FloatArray:
    """Return where a cost is least, from a start; Newton's steps, turned downhill where it bends down.

    SciPy's minimisers take a third of a second to import.
    """
    value, slope, bend = cost(at)
    for _ in range(_STEPS):
        curvature, axes = np.linalg.eigh(bend)
        step = -axes @ (axes.T @ slope / np.maximum(np.abs(curvature), 1e-9 * np.abs(curvature).max()))
        promised = -float(slope @ step)
        while promised > _RESOLVED * max(abs(value), 1.0):
            found = cost(at + step)
            if found[0] <= value - _SUFFICIENT * promised:
                break
            step, promised = 0.5 * step, 0.5 * promised
        else:
            break
        at, (value, slope, bend) = at + step, found
    return at


def _log_chance(seen: IntArray, expected: IntArray, min_images: int, kind: tuple[float, float]) -> FloatArray:
    """Log probability that so many images show a line of a kind, given that it is a line."""
    tries = (np.maximum(expected, seen) - 1).astype(np.float64)
    hits = (seen - 1).astype(np.float64)
    missed = sum(
        np.exp(_beta_binomial(np.full(len(tries), k), tries, kind)) * (tries >= k) for k in range(min_images - 1)
    )
    return _beta_binomial(hits, tries, kind) - np.log(np.maximum(1.0 - missed, 1e-12))


def _beta_binomial(hits: FloatArray, tries: FloatArray, kind: tuple[float, float]) -> FloatArray:
    """Log probability of so many hits, of tries whose chance is drawn from a beta law."""
    gammaln, betaln = scipy.special.gammaln, scipy.special.betaln
    a, b = kind[0] * kind[1], (1.0 - kind[0]) * kind[1]
    hits = np.minimum(hits, tries)
    number = gammaln(tries + 1) - gammaln(hits + 1) - gammaln(tries - hits + 1)
    return number + betaln(hits + a, tries - hits + b) - betaln(a, b)
