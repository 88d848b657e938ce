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

from groma._typing import FloatArray, IntArray
from groma.features.contract import SegmentDetector
from groma.features.edge_fit import EDGES
from groma.features.images import IMAGES, GrayImage, to_gray
from groma.features.segments import Segments
from groma.features.steps import beside, fit, profiles, two_steps
from groma.gates import NORMAL, chi_square_gate, gate


@dataclass(frozen=True)
class CloseEdgeGates:
    """When an edge has a neighbour, and what is known of profiles beforehand."""

    blur: float = gate(0.75, "px", "usual blur of an edge, lens and pixel", "derived from a pixel under a sharp lens")
    blur_spread: float = gate(
        0.3,
        "1",
        "standard deviation of its logarithm",
        "chosen on halved photographs of Strecha's scenes; with 0.15 to 0.6 places are up to a quarter worse",
    )
    any_spread: float = gate(1.0, "1", "the same for an edge alone, shadows too", "derived from 0.3 to 2 pixels")
    model: float = gate(
        0.02,
        "1",
        "deviation of a profile from the model, over its contrast",
        "chosen on rendered edges; with 0.005 to 0.04 places in halved photographs are up to a quarter worse",
    )
    close: float = gate(2.0, "px", "from a step to its pixels", "chosen on halved photographs: 1.5 and 2.5 are worse")
    displacement: float = gate(0.35, "px", "by which neighbours displace a step", "derived from edges 1 to 3 px apart")


#: The defaults.
CLOSE_EDGES = CloseEdgeGates()


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
    ends, new_ends, added = (
        np.ascontiguousarray(ends, dtype=np.float64),
        np.array(ends, np.float64),
        np.zeros(len(ends)),
    )
    length = np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1])
    rows = np.flatnonzero((sigma < EDGES.unfitted_sigma) & (length >= 2.0))
    whole, halves = profiles(np.ascontiguousarray(image), ends[rows])
    left, right = beside(whole, -1), beside(whole, 1)
    rises = right > left
    rows = rows[rises]
    edges = _Profiles(whole[rises], halves[rises], left[rises], right[rises], sigma[rows], gates)
    offset, cost = edges.one_step()
    some, own, own_variance = edges.two_steps(cost)
    tilt, share = np.zeros(len(rows)), gates.displacement**2 / (gates.displacement**2 + own_variance)
    offset[some] += share[:, 0] * (own[:, 0] - offset[some])
    tilt[some] = share[:, 1] * own[:, 1]
    added[rows[some]] = (1.0 - share[:, 0]) * gates.displacement**2
    away = offset[:, None] + tilt[:, None] * [-0.5, 0.5]
    near = (np.abs(away) <= EDGES.max_shift).all(axis=1)
    rows, away = rows[near], away[near]
    across = np.stack([ends[rows, 1] - ends[rows, 3], ends[rows, 2] - ends[rows, 0]], axis=1) / length[rows, None]
    new_ends[rows] += (away[:, :, None] * across[:, None]).reshape(-1, 4)
    return new_ends, np.sqrt(sigma**2 + added)


@dataclass(frozen=True)
class _Profiles:
    """Bins of segments, (N, BINS, 4) and (N, 2 BINS, 4), grey levels beside them (N,), rising, and deviations (N,)."""

    whole: FloatArray
    halves: FloatArray
    left: FloatArray
    right: FloatArray
    sigma: FloatArray
    gates: CloseEdgeGates

    def one_step(self) -> tuple[FloatArray, FloatArray]:
        """Offsets (N,) of single steps from their segments, and the costs (N,) of explaining all by one step."""
        gates, weight, log_blur = self.gates, self._weight(self.whole), math.log(self.gates.blur)
        start = np.zeros((len(weight), 5))
        start[:, 0], start[:, 1], start[:, 2] = self.left, log_blur, self.right - self.left
        alone = fit(self.whole, weight, start, log_blur, gates.any_spread)
        offset = np.zeros(len(weight))
        # A softer edge has no place of its own close to it.
        sharp = np.flatnonzero(alone.states[:, 1] < log_blur + gates.blur_spread)
        found, whole = start[sharp], self.whole[sharp]
        for _ in range(2):
            near = np.abs(whole[:, :, 2] - found[:, 3, None]) <= gates.close
            found = fit(whole, weight[sharp] * near, found, log_blur, gates.blur_spread).states
        # Its tilt is that of the fitted segment: places along it vote for that one by one.
        # Less than it is known to is noise, and noise differs from view to view.
        away = np.abs(found[:, 3])
        moved = (found[:, 2] > 0.0) & (away <= EDGES.max_shift) & (away > self.sigma[sharp])
        offset[sharp] = np.where(moved, found[:, 3], 0.0)
        return offset, alone.cost

    def two_steps(self, alone: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
        """Segments that two steps explain, given the costs of one; offset and tilt of the own step, and variances."""
        gates, weight, log_blur = self.gates, self._weight(self.whole), math.log(self.gates.blur)
        # No second step could gain more than all that is left.
        # A step has three unknowns; twelve bins less two steps leave six.
        evidence, misfit = chi_square_gate(NORMAL.never, 3), chi_square_gate(NORMAL.never, 6)
        some = np.flatnonzero(alone > evidence)
        start, found = two_steps(self.whole[some], weight[some], log_blur, EDGES.max_shift)
        some = some[found]
        together = fit(self.whole[some], weight[some], start[found], log_blur, gates.blur_spread)
        used = np.count_nonzero(self.whole[some, :, 0], axis=1)
        scale = np.maximum(together.cost / np.maximum(used - 6, 1), 1.0)
        told = (together.cost <= misfit) & (alone[some] - together.cost > evidence * scale)
        some, scale = some[told], scale[told]
        both = fit(
            self.halves[some], self._weight(self.halves)[some], together.states[told], log_blur, gates.blur_spread
        )
        # What is not determined has a variance of a billion pixels.
        covariance = np.linalg.inv(both.information + 1e-9 * np.eye(8))
        variance = scale[:, None] * np.diagonal(covariance, axis1=1, axis2=2)
        # The step that is the segment's: an ascent, high and near.
        height = both.states[:, [2, 5]] * np.exp(-0.5 * (both.states[:, [3, 6]] / EDGES.max_shift) ** 2)
        at = (np.array([3, 6])[height.argmax(axis=1)])[:, None] + np.arange(2)
        return some, np.take_along_axis(both.states, at, 1), np.take_along_axis(variance, at, 1)

    def _weight(self, bins: FloatArray) -> FloatArray:
        """Inverse variances (N, K) of the mean grey levels of bins: noise, and what the model leaves out."""
        number, misfit = bins[:, :, 0], self.gates.model * (self.right - self.left)[:, None]
        return number / (IMAGES.noise**2 + number * misfit**2)
