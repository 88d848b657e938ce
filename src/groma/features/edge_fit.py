# SPDX-License-Identifier: BSD-3-Clause
r"""Fit segments to the grey levels: direction by gradient sign, position below a pixel, standard deviation.

A detector that grows regions places a line by its region. Here the edge is measured again. At every pixel of length
the gradient across the segment is sampled a pixel apart, and its peak :math:`e_k` located as the centre of a Gaussian
window that is also the centroid of the gradient in it: unlike a parabola through the largest samples this does not lean
towards pixel centres (0.1 pixels on a sharp edge parallel to an axis; this one 0.03), and unlike a centroid without a
window it does not see the neighbouring edge. A robust line :math:`e = a + b\,s` through these peaks, with
:math:`-1/2 \le s \le 1/2` along the segment, moves the end points across it.

The residuals of that line also tell how well it is known. With :math:`n` samples of variance :math:`\sigma_e^2` and
correlation :math:`\rho` from one to the next, the variance of an end point across a fitted line is

.. math:: \sigma^2 = \sigma_0^2 + \frac{4\,\sigma_e^2}{n}\,\frac{1 + \rho}{1 - \rho} + \left(\frac{b}{6}\right)^2
    + \left(\frac{\kappa\,m}{1 - \kappa}\right)^2

:math:`\sigma_0` stands for what no image can tell: lens model, shading. Edges that are not straight are a matter of
their own: the bow b is the coefficient of :math:`s^2 - 1/12` in the residuals, zero unless it stands out from their
noise. The chord of an arc lies elsewhere in every image, by about the b / 6 that the arc's ends are off the fitted
line; with a sigma of that size it takes little part in what is exact.

The samples end R = 3 px beside the segment as it was found. The gradient g of a soft edge reaches farther, so that the
peaks keep a part of the error of that segment: to first order, with the window :math:`W(r) = e^{-r^2/2w^2}`, the share

.. math:: \kappa = \frac{2R\,W(R)\,g(R)}{\int_{-R}^{R} (1 - r^2/w^2)\,W(r)\,g(r)\,dr}

which is 0.01 for a sharp edge, and 0.2, 0.3 and 0.5 for blurs of 1.7, 2.2 and 3 px. The fit has moved the ends by m at
most, so :math:`\kappa\,m / (1 - \kappa)` of the error is left.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from groma._numba import inline_kernel, kernel, loop
from groma._ordering import median
from groma._typing import FloatArray
from groma.features.images import GrayImage, SmoothImage, smoothed
from groma.gates import NORMAL, SIGMA_OF_MEDIAN, STRECHA, gate, numbers

#: Samples across the segment reach this far on either side, pixels: the size of an array.
REACH = 3
SAMPLES = 2 * REACH + 1
#: Square of a bow, over its variance, from which on it counts.
_BOW = NORMAL.far**2


@dataclass(frozen=True)
class EdgeGates:
    """How segments are fitted to the grey levels, and how well that makes them known."""

    window: float = gate(1.5, "px", "standard deviation of the window around a peak", "chosen on rendered edges")
    max_shift: float = gate(1.5, "px", "ends that would move further keep their place", "chosen on rendered edges")
    min_sigma: float = gate(0.03, "px", "what no image can tell: lens model, shading", STRECHA + ": their surveys")
    unfitted_sigma: float = gate(0.5, "px", "segments that could not be fitted", "derived from the detector's pixels")
    prior_sigma: float = gate(0.15, "px", "noise of one sample, before any is seen", "chosen on Strecha's scenes")
    prior_count: float = gate(10.0, "samples", "samples that this weighs", "chosen on Strecha's scenes")
    outlier: float = gate(4.0, "sigma", "samples farther off weigh nothing", "derived from Tukey's 95 % efficiency")
    min_share: float = gate(0.5, "share", "of the samples that show an edge", "derived from the median it starts from")


#: The defaults.
EDGES = EdgeGates()


# -------------------------------------------------------------------------------------------------------- Kernels
@kernel
def _bilinear(image, x, y):
    """Grey level at array coordinates, border repeated."""
    height, width = image.shape
    x = min(max(x, 0.0), width - 1.0)
    y = min(max(y, 0.0), height - 1.0)
    i, j = min(int(y), max(height - 2, 0)), min(int(x), max(width - 2, 0))
    i1, j1 = min(i + 1, height - 1), min(j + 1, width - 1)
    fx, fy = x - j, y - i
    top = image[i, j] * (1.0 - fx) + image[i, j1] * fx
    bottom = image[i1, j] * (1.0 - fx) + image[i1, j1] * fx
    return top * (1.0 - fy) + bottom * fy


@kernel
def _peak(profile, window):
    """Offset of the steepest ascent in a profile of grey levels, pixels; NaN where there is none inside."""
    best, at = 0.0, -1
    for k in range(SAMPLES - 1):
        rise = profile[k + 1] - profile[k]
        if rise > best:
            best, at = rise, k
    if at < 1 or at > SAMPLES - 3:  # derived from the samples beside an ascent
        return math.nan
    center = at - REACH + 0.5
    for _ in range(4):
        total = 0.0
        moment = 0.0
        for k in range(SAMPLES - 1):
            away = k - REACH + 0.5 - center
            weight = max(profile[k + 1] - profile[k], 0.0) * math.exp(-0.5 * away * away / window**2)
            total += weight
            moment += weight * away
        # The window pulls the centroid back by this factor when the edge is blurred by about one pixel.
        center += 1.5 * moment / total
        if abs(center - (at - REACH + 0.5)) > 1.0:
            return math.nan
    return center


@kernel
def _kept_share(mean, center, window):
    """Share of the segment's error that the peaks keep, from the sum of the profiles and the peak in it."""
    total, moment = 0.0, 0.0
    for k in range(SAMPLES - 1):
        away = k - REACH + 0.5 - center
        weight = (mean[k + 1] - mean[k]) * math.exp(-0.5 * away * away / window**2)
        total += weight
        moment += weight * away * away
    # Gradients at the ends, from the two nearest to each.
    last, first = mean[SAMPLES - 1] - mean[SAMPLES - 2], mean[1] - mean[0]
    ends = 1.5 * (first + last) - 0.5 * (mean[2] - mean[1] + mean[SAMPLES - 2] - mean[SAMPLES - 3])
    beyond = REACH * math.exp(-0.5 * REACH**2 / window**2) * ends
    # A ramp has no peak: all of the error is kept, which no deviation states.
    return min(max(beyond / max(total - moment / window**2, 1e-9), 0.0), 0.8)


@kernel
def _line_fit(s, e, w, n, out):
    """Weighted line e = a + b s; writes a, b; whether it is defined."""
    sw = 0.0
    ss = 0.0
    se = 0.0
    sss = 0.0
    sse = 0.0
    for k in range(n):
        sw += w[k]
        ss += w[k] * s[k]
        se += w[k] * e[k]
        sss += w[k] * s[k] * s[k]
        sse += w[k] * s[k] * e[k]
    determinant = sw * sss - ss * ss
    if determinant <= 1e-6 * sw * sw:
        return False
    out[0] = (sss * se - ss * sse) / determinant
    out[1] = (sw * sse - ss * se) / determinant
    return True


@inline_kernel
def _mean_gradient(image, u1, v1, u2, v2, dx, dy, count):
    """Sum of the gradients along a segment towards its right hand (-dy, dx); the sign gives the direction."""
    total = 0.0
    for k in range(count):
        t = (k + 0.5) / count
        x, y = u1 + t * (u2 - u1) - 0.5, v1 + t * (v2 - v1) - 0.5
        total += _bilinear(image, x - dy, y + dx) - _bilinear(image, x + dy, y - dx)
    return total


@inline_kernel
def _robust_line(s, e, w, spread, n, outlier, line):
    """Fit offsets e at places s by a line, with weights w that let go of what is far; False where it fails."""
    for step in range(5):
        for k in range(n):
            spread[k] = abs(e[k] - line[0] - line[1] * s[k]) if step else e[k]
        middle = median(spread[:n])
        if step == 0:  # start from the median offset: half of the samples may belong to a neighbouring edge
            line[0], line[1] = middle, 0.0
            continue
        cut = outlier * max(SIGMA_OF_MEDIAN * middle, 0.05)
        for k in range(n):
            ratio = spread[k] / cut
            w[k] = (1.0 - ratio * ratio) ** 2 if ratio < 1.0 else 0.0
        if not _line_fit(s, e, w, n, line):
            return False
    return True


@inline_kernel
def _end_sigma(s, e, w, n, line, numbers):
    """Standard deviation of the ends across the segment, from residuals, their correlation and their bow."""
    min_sigma, prior_sigma, prior_count = numbers
    weight, squares, lagged, before = 0.0, 0.0, 0.0, 0.0
    bow, bows = 0.0, 0.0
    for k in range(n):
        residual = e[k] - line[0] - line[1] * s[k]
        arc = s[k] * s[k] - 1.0 / 12.0
        bow += w[k] * arc * residual
        bows += w[k] * arc * arc
        weight += w[k]
        squares += w[k] * residual * residual
        if k > 0:
            lagged += math.sqrt(w[k] * w[k - 1]) * residual * before
        before = residual
    variance = (squares + prior_count * prior_sigma**2) / (weight + prior_count)
    rho = min(max(lagged / max(squares, 1e-12), 0.0), 0.9)
    effective = max(weight * (1.0 - rho) / (1.0 + rho), 2.0)
    bow /= max(bows, 1e-12)
    if bow * bow * bows < _BOW * variance * (weight / effective):
        bow = 0.0
    # Derived from a line through samples spread evenly: its ends have four times the variance of its middle.
    return math.sqrt(min_sigma**2 + 4.0 * variance / effective + (bow / 6.0) ** 2)


@loop
def _measure_all(image, ends, fit, gates, new_ends, sigma, strength):
    """Direct, fit and rate all segments; `image` is float32, smoothed, `gates` the numbers of :class:`EdgeGates`."""
    window, max_shift, min_sigma, unfitted_sigma, prior_sigma, prior_count, outlier, min_share = gates
    profile, mean = np.zeros(SAMPLES), np.zeros(SAMPLES)
    line = np.zeros(2)
    for row in range(ends.shape[0]):
        u1, v1, u2, v2 = ends[row, 0], ends[row, 1], ends[row, 2], ends[row, 3]
        length = math.hypot(u2 - u1, v2 - v1)
        count = max(int(length), 2)
        dx, dy = (u2 - u1) / max(length, 1e-9), (v2 - v1) / max(length, 1e-9)
        total = _mean_gradient(image, u1, v1, u2, v2, dx, dy, count)
        if total < 0.0:
            u1, v1, u2, v2 = u2, v2, u1, v1
            dx, dy = -dx, -dy
        strength[row] = 0.5 * abs(total) / count
        new_ends[row, 0], new_ends[row, 1], new_ends[row, 2], new_ends[row, 3] = u1, v1, u2, v2
        sigma[row] = unfitted_sigma
        if not fit:
            continue
        s, e, w, spread = np.zeros(count), np.zeros(count), np.ones(count), np.zeros(count)
        n = 0
        mean[:] = 0.0
        for k in range(count):
            t = (k + 0.5) / count
            x, y = u1 + t * (u2 - u1) - 0.5, v1 + t * (v2 - v1) - 0.5
            for j in range(SAMPLES):
                profile[j] = _bilinear(image, x - (j - REACH) * dy, y + (j - REACH) * dx)
                mean[j] += profile[j]
            peak = _peak(profile, window)
            if peak == peak:
                s[n], e[n] = t - 0.5, peak
                n += 1
        if n < 5 or n < min_share * count:
            continue
        good = _robust_line(s, e, w, spread, n, outlier, line)
        first, second = line[0] - 0.5 * line[1], line[0] + 0.5 * line[1]
        if not good or abs(first) > max_shift or abs(second) > max_shift:
            continue
        new_ends[row, 0], new_ends[row, 1] = u1 - dy * first, v1 + dx * first
        new_ends[row, 2], new_ends[row, 3] = u2 - dy * second, v2 + dx * second
        share = _kept_share(mean, line[0], window)
        noise = _end_sigma(s, e, w, n, line, (min_sigma, prior_sigma, prior_count))
        sigma[row] = math.hypot(noise, share / (1.0 - share) * max(abs(first), abs(second)))


# --------------------------------------------------------------------------------------------------------- Public
def measure_edges(image: GrayImage, ends: FloatArray, fit: bool = True) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Direct segments by the gradient (darker side left), fit them to the grey levels, and rate them.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image.
    ends : (N, 4) float64
        Segments within about a pixel of the edges, pixels.
    fit : bool
        Whether the end points may move across the segment; otherwise only their order changes.

    Returns
    -------
    ends : (N, 4) float64
        End points.
    sigma : (N,) float64
        Standard deviation of an end point across the segment, pixels; 0.5 for segments that could not be fitted.
    strength : (N,) float64
        Mean gradient across the segment, grey levels per pixel.
    """
    return measure_smoothed(smoothed(image) if len(ends) else np.zeros((0, 0), np.float32), ends, fit)


def measure_smoothed(
    smooth: SmoothImage, ends: FloatArray, fit: bool = True
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Do what :func:`measure_edges` does, in an image of :func:`smoothed` that is used several times."""
    ends = np.ascontiguousarray(ends, dtype=np.float64)
    new_ends, sigma, strength = np.zeros_like(ends), np.zeros(len(ends)), np.zeros(len(ends))
    if len(ends):
        _measure_all(smooth, ends, fit, numbers(EDGES), new_ends, sigma, strength)
    return new_ends, sigma, strength
