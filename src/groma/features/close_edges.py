# SPDX-License-Identifier: BSD-3-Clause
r"""Places of edges in the grey levels as they are, and of edges that have another edge a few pixels beside them.

Blurred together, two edges displace each other: treads, poles, frames, joints between stones. Where the image is
smoothed first, as it must be to find gradients, their steepest places lie up to a pixel away from the edges where these
are one pixel apart, and a tenth of a pixel where they are four. The displacement changes smoothly with the view, so
that no residual tells it. Here the grey levels around a fitted segment are explained by steps under a common blur, that
of usual photographs unless the profile says otherwise (:mod:`groma.features.steps`).

One step is fitted to the pixels close to it. The edge stays where it is if it is softer than photographs are, or if the
step lies within a standard deviation of it: the segment's own place then varies less from view to view.
Where two steps explain all of the profile, and a likelihood ratio asks for the second, the place is that of the
segment's own step of the two, weighed against the displacements that the first fit may still have; what is then unknown
is added to the variance of the segment.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._numba import kernel, loop
from groma._typing import FloatArray
from groma.features.contract import SegmentDetector
from groma.features.edge_fit import EDGES
from groma.features.images import GrayImage, to_gray
from groma.features.segments import Segments
from groma.features.steps import BINS, ONE, REACH, TWO, beside, fit, merge, profile, two_steps, variance
from groma.gates import gate, numbers


@dataclass(frozen=True)
class CloseEdgeGates:
    """When an edge has a neighbour, and what is known of profiles beforehand."""

    blur: float = gate(0.75, "px", "usual blur of an edge, lens and pixel", "derived from a pixel under a sharp lens")
    blur_spread: float = gate(0.3, "1", "standard deviation of its logarithm", "chosen on Strecha's scenes")
    any_spread: float = gate(
        1.0, "1", "the same for an edge that is alone, shadows too", "derived from 0.3 to 2 pixels"
    )
    noise: float = gate(2.0, "grey levels", "noise of a pixel", "convention: a photograph of 8 bits in good light")
    model: float = gate(
        0.02, "1", "deviation of a profile from the model, over its contrast", "chosen on rendered edges"
    )
    close: float = gate(
        2.0, "px", "from a step to the pixels that one step is fitted to", "chosen on halved photographs"
    )
    displacement: float = gate(
        0.35, "px", "by which neighbours still displace one step", "derived from edges one to three pixels apart"
    )
    max_shift: float = gate(1.5, "px", "of an edge from its segment", "derived from the window of the segment's fit")
    evidence: float = gate(
        21.1,
        "sigma squared",
        "twice the logarithm of the likelihood that a second step must gain",
        "derived from three unknowns of chance: 1 in 10 000",
    )
    misfit: float = gate(
        27.9,
        "sigma squared",
        "sum of squares of a profile that two steps explain",
        "derived from its noise: twelve bins, six unknowns, 1 in 10 000",
    )


#: The defaults.
CLOSE_EDGES = CloseEdgeGates()


# -------------------------------------------------------------------------------------------------------- Kernels
@kernel
def _own_step(p, window):
    """Index of the step that is the segment's: an ascent, high and near."""
    own = p[2] * math.exp(-0.5 * (p[3] / window) ** 2)
    other = p[5] * math.exp(-0.5 * (p[6] / window) ** 2)
    return 5 if other > own else 2


@loop
def _one_step(whole, left, right, given, close, p, H):
    """Fit one step to what is close to it, wherever it then is."""
    log_blur, spread, noise2, misfit2, _, _ = given
    p[0], p[1], p[2], p[3], p[4] = left, log_blur, right - left, 0.0, 0.0
    for _ in range(2):
        fit(whole, p, ONE, (log_blur, spread, noise2, misfit2, p[3], close), H)


@loop
def _second_step(bins, whole, given, alone, limits, p, H):
    """Fit two steps; return the factor by which noise is larger, 0 where they do not explain more than one."""
    max_shift, evidence, misfit = limits
    if not two_steps(whole, given, max_shift, p):
        return 0.0
    together = fit(whole, p, TWO, given, H)
    used = 0
    for k in range(BINS):
        used += 1 if whole[k, 0] > 0.0 else 0
    scale = max(together / max(used - TWO + 2, 1), 1.0)
    if together > misfit or not alone - together > evidence * scale:
        return 0.0
    fit(bins, p, TWO, given, H)
    return scale


@loop
def _place_all(image, ends, sigma, unfitted_sigma, gates, new_ends, added):
    """Move the ends of segments to their step, and write the variance that a second one adds."""
    blur, spread, any_spread, noise, model, close, displacement, max_shift, evidence, misfit = gates
    bins, whole, H = np.zeros((2 * BINS, 4)), np.zeros((BINS, 4)), np.zeros((TWO, TWO))
    p, x, unit = np.zeros(TWO), np.zeros(TWO), np.zeros(TWO)
    for row in range(ends.shape[0]):
        u1, v1, u2, v2 = ends[row, 0], ends[row, 1], ends[row, 2], ends[row, 3]
        length = math.hypot(u2 - u1, v2 - v1)
        if not sigma[row] < unfitted_sigma or length < 2.0:
            continue
        profile(image, u1, v1, u2, v2, bins)
        merge(bins, whole)
        left, right = beside(whole, -1.0), beside(whole, 1.0)
        if not right > left:
            continue
        given = math.log(blur), spread, noise**2, (model * (right - left)) ** 2, 0.0, REACH + 1.0
        p[0], p[1], p[2], p[3], p[4] = left, given[0], right - left, 0.0, 0.0
        alone = fit(whole, p, ONE, (given[0], any_spread, *given[2:]), H)
        offset, tilt, scale = 0.0, 0.0, 0.0
        if p[1] < given[0] + spread:  # a softer edge has no place of its own close to it
            _one_step(whole, left, right, given, close, p, H)
            # Its tilt is that of the fitted segment: places along it vote for that one by one.
            # Less than it is known to is noise, and noise differs from view to view.
            offset = p[3] if p[2] > 0.0 and sigma[row] < abs(p[3]) <= max_shift else 0.0
        # No second step could gain more than all that is left.
        if alone > evidence:
            scale = _second_step(bins, whole, given, alone, (max_shift, evidence, misfit), p, H)
        if scale > 0.0:
            own = _own_step(p, max_shift)
            share = displacement**2 / (displacement**2 + scale * variance(H, own + 1, unit, x))
            offset += share * (p[own + 1] - offset)
            tilt = p[own + 2] * displacement**2 / (displacement**2 + scale * variance(H, own + 2, unit, x))
            added[row] = (1.0 - share) * displacement**2
        first, second = offset - 0.5 * tilt, offset + 0.5 * tilt
        if max(abs(first), abs(second)) <= max_shift:
            dx, dy = (u2 - u1) / length, (v2 - v1) / length
            new_ends[row, 0], new_ends[row, 1] = u1 - dy * first, v1 + dx * first
            new_ends[row, 2], new_ends[row, 3] = u2 - dy * second, v2 + dx * second


# --------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True)
class CloseEdges:
    """A detector whose segments are then placed in the image as it is, also those that other edges lie close to.

    Their places are nearer to the edges, and vary a little more from view to view.
    """

    #: What finds and fits the segments.
    detector: SegmentDetector

    def detect(self, image: npt.NDArray[np.generic]) -> Segments:
        """Segments of an image, longest first."""
        gray = to_gray(image)
        found = self.detector.detect(gray)
        ends, sigma = placed(gray, found.ends, found.sigma)
        return Segments.ranked(ends, sigma, found.strength, gray.shape, 0.0, 0.0)


def placed(
    image: GrayImage, ends: FloatArray, sigma: FloatArray, gates: CloseEdgeGates = CLOSE_EDGES
) -> tuple[FloatArray, FloatArray]:
    """Place segments, fitted in the smoothed image, in the image as it is; those without a fit stay as they are.

    Parameters
    ----------
    image : (H, W) uint8
        Grey image, not smoothed.
    ends : (N, 4) float64
        Segments fitted in the smoothed image, the darker side left.
    sigma : (N,) float64
        Standard deviation of an end point across the segment, pixels.
    gates : CloseEdgeGates
        What is known of profiles, and what counts as a neighbour.

    Returns
    -------
    ends : (N, 4) float64
        End points.
    sigma : (N,) float64
        Standard deviations; larger where an edge and its neighbour cannot be told apart.
    """
    ends, added = np.ascontiguousarray(ends, dtype=np.float64), np.zeros(len(ends))
    new_ends = ends.copy()
    if len(ends):
        image, sigma = np.ascontiguousarray(image), np.ascontiguousarray(sigma, dtype=np.float64)
        _place_all(image, ends, sigma, EDGES.unfitted_sigma, numbers(gates), new_ends, added)
    return new_ends, np.sqrt(sigma**2 + added)
