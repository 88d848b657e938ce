# SPDX-License-Identifier: BSD-3-Clause
r"""Steps under a common blur, fitted to the grey levels across segments.

.. math:: g(r, s) = c + \sum_k A_k\, \Phi\!\left(\frac{r - e_k - t_k\,s}{\beta}\right),

over the distance r from the segment and the place s along it, :math:`-1/2 \le s \le 1/2`. Pixels are not interpolated,
but averaged in bins. The unknowns are the grey level c and the logarithm of the blur :math:`\beta`, and height, offset
and tilt of each step. Beforehand, the logarithm of the blur is known with a deviation, and edges are parallel up to
about a pixel over the length of a segment.
"""

from __future__ import annotations

import math

import numpy as np
import scipy  # its parts are imported when something of them is first used

from groma._numba import kernel, loop
from groma._typing import BoolArray, FloatArray
from groma.estimators.batch_least_squares import BatchSolution, Observations, problem_kind, solve_batch
from groma.features.images import GrayImage

#: Pixels up to this distance take part, in this many bins of half a pixel, for either half of a segment. Edges farther
#: away than this displace no segment.
REACH = 3
BINS = 4 * REACH
#: Places at which steps are looked for, half a pixel apart.
_PLACES = 0.5 * np.arange(BINS + 1) - REACH
#: A fit ends when twice the negative log likelihood falls by less, absolutely and relatively (cost: steps).
_ENOUGH = 0.01


# -------------------------------------------------------------------------------------------------------- Kernels
@loop
def _profile_all(image, ends, bins):
    """Add up number of pixels and their place along, distance and grey level in the bins (N, 2, BINS, 4)."""
    height, width = image.shape
    for n in range(len(ends)):
        u1, v1, u2, v2 = ends[n, 0], ends[n, 1], ends[n, 2], ends[n, 3]
        length = math.hypot(u2 - u1, v2 - v1)
        dx, dy = (u2 - u1) / length, (v2 - v1) / length
        steep = abs(dy) > abs(dx)
        # Along the axis that the segment follows, and across it.
        begin, end, count, across = (v1, v2, height, width) if steep else (u1, u2, width, height)
        lead, slope = (dy, dx / dy) if steep else (dx, dy / dx)
        start, reach = (u1 if steep else v1), REACH / abs(lead)
        for k in range(max(math.ceil(min(begin, end) - 0.5), 0), min(int(max(begin, end) + 0.5), count)):
            center = start + (k + 0.5 - begin) * slope
            low, high = math.ceil(center - reach - 0.5), math.floor(center + reach - 0.5)
            for m in range(max(low, 0), min(high, across - 1) + 1):
                i, j = (k, m) if steep else (m, k)
                x, y = j + 0.5 - u1, i + 0.5 - v1
                distance, along = dx * y - dy * x, (dx * x + dy * y) / length - 0.5
                half = 1 if along > 0.0 else 0
                row = min(max(int((distance + REACH) * (BINS / (2.0 * REACH))), 0), BINS - 1)
                bins[n, half, row, 0] += 1.0
                bins[n, half, row, 1] += along
                bins[n, half, row, 2] += distance
                bins[n, half, row, 3] += image[i, j]


@kernel
def _blur(x, B):
    B[0] = math.exp(min(max(x[1], -4.0), 4.0))


@kernel
def _residual(known, k, own, m, x, B, r, J):
    """Of a bin: root of the weight, place along, distance, grey level; or of an unknown: root, 0, 0, value."""
    weight, unknowns, blur = own[m, 0], J.shape[1], B[0]
    if k > 0:
        r[0] = -weight * own[m, 3]
        for i in range(unknowns):
            J[0, i] = weight * known[k, i]
            r[0] += J[0, i] * x[i]
        return
    r[0], J[0, 0], J[0, 1] = weight * (x[0] - own[m, 3]), weight, 0.0
    for first in range(2, unknowns, 3):
        z = (own[m, 2] - x[first + 1] - x[first + 2] * own[m, 1]) / blur
        density = weight * x[first] * math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)
        J[0, first] = weight * 0.5 * (1.0 + math.erf(z * math.sqrt(0.5)))
        J[0, first + 1] = -density / blur
        J[0, first + 2] = J[0, first + 1] * own[m, 1]
        J[0, 1] -= density * z
        r[0] += J[0, first] * x[first]


@kernel
def _add(x, B, step, out):
    for k in range(len(x)):
        out[k] = x[k] + step[k]


# --------------------------------------------------------------------------------------------------------- Public
#: Unknowns: grey level, logarithm of the blur; height, offset and tilt of each step.
_ONE = problem_kind(2, 5, 1, (1,), _blur, _residual, _add)
_TWO = problem_kind(3, 8, 1, (1,), _blur, _residual, _add)
#: What observations tell: a grey level; or a sum of unknowns that is known beforehand (derived from their order).
_KNOWN = np.array([[0] * 8, [0, 1] + [0] * 6, [0, 0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 0, -1, 0, 0, 1]], np.float64)


def profiles(image: GrayImage, ends: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the bins of segments (N, 4): number of pixels, and means of place along, distance and grey level.

    Returns
    -------
    whole : (N, BINS, 4) float64
        Of segments as a whole, as if all pixels were at their middle.
    halves : (N, 2 BINS, 4) float64
        Of their halves.
    """
    total = np.zeros((len(ends), 2, BINS, 4))
    _profile_all(image, ends, total)
    whole = total.sum(axis=1)
    whole[:, :, 1] = 0.0
    for bins in (whole, total):
        bins[..., 1:] /= np.maximum(bins[..., :1], 1.0)
    return whole, total.reshape(-1, 2 * BINS, 4)


def beside(whole: FloatArray, side: int) -> FloatArray:
    """(N,) mean grey level one to three pixels from segments, on their left (-1) or right (1); NaN if there is none."""
    seen = (whole[:, :, 0] > 0.0) & (side * whole[:, :, 2] >= 1.0)
    with np.errstate(invalid="ignore"):
        return np.sum(seen * whole[:, :, 3], axis=1) / seen.sum(axis=1)


def fit(bins: FloatArray, weight: FloatArray, start: FloatArray, log_blur: float, spread: float) -> BatchSolution:
    """Fit steps to profiles.

    Parameters
    ----------
    bins : (N, K, 4) float64
        Profiles.
    weight : (N, K) float64
        Inverse variances of their grey levels; bins of weight zero take no part.
    start : (N, 5) or (N, 8) float64
        Initial unknowns of one step, or two.
    log_blur, spread
        What is known of the logarithm of the blur: mean and standard deviation.
    """
    kind, priors = (_ONE, 2) if start.shape[1] == _ONE.num_parameters else (_TWO, 3)
    count, size = weight.shape
    own = np.zeros((count, size + priors, 4))
    own[:, :size], own[:, :size, 0] = bins, np.sqrt(weight)
    own[:, size:, 0], own[:, size, 0], own[:, size, 3] = 1.0, 1.0 / spread, log_blur
    told = np.tile(np.append(np.zeros(size, np.int64), 1 + np.arange(priors)), count)
    pointers = (size + priors) * np.arange(count + 1)
    seen = Observations(_KNOWN, told, own.reshape(-1, 4), pointers, own[:, :, 0].ravel() > 0.0)
    return solve_batch(kind, seen, start, tolerance=_ENOUGH, floor=_ENOUGH)


def two_steps(whole: FloatArray, weight: FloatArray, log_blur: float, max_shift: float) -> tuple[FloatArray, BoolArray]:
    """Return the best pairs of steps on a grid (N, 8), the first of them an ascent near the segment; and if any are."""
    shown = scipy.special.ndtr((whole[:, :, 2, None] - _PLACES) / math.exp(log_blur))
    share = (weight / weight.sum(axis=1, keepdims=True))[:, None]
    grey = whole[:, :, 3, None]
    mean, level = share @ shown, share @ grey
    white = np.sqrt(weight)[:, :, None] * (shown - mean)
    G, told = (
        np.swapaxes(white, 1, 2) @ white,
        np.swapaxes(white, 1, 2) @ (np.sqrt(weight)[:, :, None] * (grey - level)),
    )
    # Nearer than a pixel two steps are one.
    i, j = np.nonzero((np.abs(_PLACES)[:, None] <= max_shift) & (np.abs(_PLACES[:, None] - _PLACES) >= 1.0))
    alone, other, cross = G[:, i, i], G[:, j, j], G[:, i, j]
    determinant = alone * other - cross * cross
    good = determinant > 1e-9 * alone * other
    determinant = np.where(good, determinant, 1.0)
    first = (other * told[:, i, 0] - cross * told[:, j, 0]) / determinant
    second = (alone * told[:, j, 0] - cross * told[:, i, 0]) / determinant
    gain = np.where(good & (first > 0.0), first * told[:, i, 0] + second * told[:, j, 0], 0.0)
    best, every = gain.argmax(axis=1), np.arange(len(gain))
    i, j, first, second = i[best], j[best], first[every, best], second[every, best]
    p = np.zeros((len(gain), 8))
    p[:, 0] = level[:, 0, 0] - first * mean[every, 0, i] - second * mean[every, 0, j]
    p[:, 1], p[:, 2], p[:, 3], p[:, 5], p[:, 6] = log_blur, first, _PLACES[i], second, _PLACES[j]
    return p, gain[every, best] > 0.0
