# SPDX-License-Identifier: BSD-3-Clause
r"""Repeatability: how often segments of a given length and contrast become part of a line.

Texture such as stains, marble and grass gives segments, as the edge of a box does, and some of them agree in three
images by chance. Their repeatability differs: edges are found in most images that see them, segments of texture rarely.
It is learned from the images at hand. Among all segments that could be part of a line, one with length l and gradient s
is part of a line with the probability

.. math:: p = \frac{1}{1 + \exp(-w_0 - w_1 \log l - w_2 \log s)},

fitted by logistic regression (maximum a posteriori, with a standard normal prior on the slopes, which makes p constant
where data are few). A line is kept if the mean of p over its segments reaches

.. math:: \min(\max(p_\text{least},\ 1 - \bar p),\ 0.6\,p_\text{top}).

:math:`\bar p` is the fraction of all segments that are part of a line. For :math:`p \ge 1 - \bar p` the product of
the odds of the segments and of the scene is at least one: the less of a scene is repeatable, the more is required of a
line. :math:`p_\text{top}` is reached by the best tenth of the segments; it is small, and so is the requirement, where
images are few or far apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.gates import LINE_MAPS, gate


@dataclass(frozen=True)
class KindGates:
    """What is asked of the kind of a line's segments, beside ``MapLinesOptions.min_repeatability``."""

    top_share: float = gate(0.6, "1", "asked at most, over what the best kind reaches", LINE_MAPS)
    top_quantile: float = gate(0.9, "quantile", "of p that stands for the best kind", "chosen on benchmarks/lines.py")


GATES = KindGates()


#: Newton steps of the fit at most (cost: none are made after convergence).
_STEPS = 50


def features_of(eligible: BoolArray, *kinds: FloatArray) -> FloatArray:
    """(S, 1 + n) one, and the logarithms of n arrays (S,), each standardised over the eligible segments."""
    features = np.zeros((len(eligible), 1 + len(kinds)))
    features[:, 0] = 1.0
    for column, values in enumerate(kinds, 1):
        logs = np.log(np.maximum(values, 1e-12))
        spread = float(logs[eligible].std()) if eligible.any() else 0.0
        if spread > 1e-6:  # segments from elsewhere may all have one strength
            features[:, column] = np.clip((logs - logs[eligible].mean()) / spread, -10.0, 10.0)
    return features


def repeatability(length: FloatArray, strength: FloatArray, eligible: BoolArray, mapped: BoolArray) -> FloatArray:
    """(S,) probability that a segment of such length and strength is part of a line; learned from the eligible ones."""
    features = features_of(eligible, length, strength)
    rows, target = features[eligible], mapped[eligible].astype(np.float64)
    weights, prior = np.zeros(3), np.diag([1e-9, 1.0, 1.0])
    for _ in range(_STEPS):
        p = 1.0 / (1.0 + np.exp(-np.clip(rows @ weights, -30.0, 30.0)))
        information = (rows * np.maximum(p * (1.0 - p), 1e-9)[:, None]).T @ rows + prior
        step = np.linalg.solve(information, rows.T @ (target - p) - prior @ weights)
        weights += np.clip(step, -2.0, 2.0)
        if np.abs(step).max() < 1e-8:
            break
    return 1.0 / (1.0 + np.exp(-np.clip(features @ weights, -30.0, 30.0)))


def found_again(
    length: FloatArray, strength: FloatArray, line_of: IntArray, eligible: BoolArray, num_lines: int, least: float
) -> BoolArray:
    """Lines whose segments are of a kind that is found again.

    Parameters
    ----------
    length, strength : (S,) float64
        Length in pixels and mean gradient of each segment.
    line_of : (S,) int
        Line of each segment, -1 for none.
    eligible : (S,) bool
        Segments that could have become part of a line.
    num_lines : int
        Number of lines.
    least : float
        The mean probability asked of a line where most segments are part of one; 0 keeps all lines.

    Returns
    -------
    (L,) bool
    """
    member = line_of >= 0
    eligible = eligible | member
    if least <= 0.0 or not member.any():
        return np.ones(num_lines, bool)
    p = repeatability(length, strength, eligible, member)
    best = GATES.top_share * float(np.quantile(p[eligible], GATES.top_quantile))
    asked = min(max(least, 1.0 - float(member[eligible].mean())), best)
    number = np.bincount(line_of[member], minlength=num_lines)
    mean = np.bincount(line_of[member], p[member], minlength=num_lines) / np.maximum(number, 1)
    return mean >= asked
