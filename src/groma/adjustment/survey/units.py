# SPDX-License-Identifier: BSD-3-Clause
"""Whether measurements are in one unit of length: feet among metres, millimetres among metres, heights in feet.

Photographs have no scale, so one unit alone cannot be wrong. Two kinds of measurement can contradict each other, by a
ratio of common units: then it is not noise.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.survey.similarity import GATES as SIMILARITY
from groma.adjustment.survey.similarity import RobustSimilarity, robust_similarity
from groma.errors import InputError

#: Lengths in metres.
_UNITS = {"feet": 0.3048, "millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254, "kilometres": 1e3}


def unit_words(ratio: float) -> tuple[str, str] | None:
    """Return two units of length with this ratio; None if there are none."""
    for name, metres in _UNITS.items():
        if abs(ratio * metres - 1.0) < SIMILARITY.near_unit:
            return name, "metres"
        if abs(ratio / metres - 1.0) < SIMILARITY.near_unit:
            return "metres", name
    return None


def check_lengths(ratio: float, lengths: str, others: str) -> None:
    """Refuse lengths whose ratio to other measurements is that of two units.

    Raises
    ------
    InputError
        With both units.
    """
    if (units := unit_words(ratio)) is not None:
        raise InputError(
            f"{lengths} are {ratio:.4g} times as long as {others} say: the former look like {units[0]}, the latter "
            f"like {units[1]}. Bring them to one unit."
        )


def check_places(source: FloatArray, target: FloatArray, fit: RobustSimilarity, positions: int, control: int) -> None:
    """Refuse places of which some, or the heights, are in another unit.

    Parameters
    ----------
    source, target : (N, 3) float
        In the scene, and as measured: positions first, control points last.
    fit : RobustSimilarity
        Between all of them.
    positions, control : int
        How many there are of each.

    Raises
    ------
    InputError
        If two units explain what one does not.
    """
    if len(source) < 5:
        return
    if min(positions, control) >= 3:  # derived from three points that fix a similarity
        first, last = slice(0, positions), slice(len(source) - control, None)
        try:
            scales = [robust_similarity(source[rows], target[rows]).similarity.scale for rows in (first, last)]
        except InputError:
            scales = [1.0, 1.0]
        brought = target.copy()
        brought[last] *= scales[0] / scales[1]
        if _fitting(source, brought) > fit.inliers.sum():
            check_lengths(scales[0] / scales[1], "Distances between the positions", "the control points")
    own = _rms(fit, np.ones(3))
    for ratio in (_UNITS["feet"], 1.0 / _UNITS["feet"]):
        stretch = np.array([1.0, 1.0, ratio])
        try:
            other = robust_similarity(source, target * stretch)
        except InputError:
            continue
        off = _rms(other, stretch)  # as measured, or heights of pure noise would always fit better if they were less
        if other.inliers.sum() >= fit.inliers.sum() and off * SIMILARITY.better < own:
            high, wide = ("feet", "metres") if ratio < 1.0 else ("metres", "feet")
            raise InputError(
                f"The measured places fit the scene much better ({off:.3g} instead of {own:.3g}) if their heights are "
                f"in {high} and the rest is in {wide}. Bring them to one unit."
            )


def _fitting(source: FloatArray, target: FloatArray) -> int:
    """Return how many places a similarity fits."""
    try:
        return int(robust_similarity(source, target).inliers.sum())
    except InputError:
        return 0


def _rms(fit: RobustSimilarity, stretch: FloatArray) -> float:
    """Return the root mean square of the residuals that fit, in the units before their axes were stretched."""
    return float(np.sqrt(np.mean((fit.residuals[fit.inliers] / stretch) ** 2)))
