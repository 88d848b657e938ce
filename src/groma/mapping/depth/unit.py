# SPDX-License-Identifier: BSD-3-Clause
r"""The unit of depth maps, from the points of a model: one of all maps, or one of each.

With the depth z of a point in the model and the measured one d, :math:`\log (d / z)` is the same for all points but for
noise, and its median is not moved by points that a map shows behind or before what they are on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma._counted import counted, first_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.gates import NORMAL, SIGMA_OF_MEDIAN, gate


@dataclass(frozen=True)
class UnitGates:
    """When points tell the unit of depth maps."""

    min_points: int = gate(10, "points", "with a depth, that tell a unit", "convention: ten")
    max_scatter: float = gate(0.25, "log", "scatter of ratios of depths in a map with a unit", "convention: a quarter")
    different: float = gate(0.1, "log", "scatter of the units of maps without a common one", "convention: a tenth")
    known: float = gate(0.2, "log", "by which a unit may differ from that of other measurements", "convention: a fifth")


UNITS = UnitGates()


def common_unit(ratio: FloatArray, image_idx: IntArray, known: bool) -> tuple[float, list[str]]:
    """Return the length in units of the maps of one unit of the model, and warnings.

    Parameters
    ----------
    ratio : (N,) float64
        Measured depths over those of the model; NaN where there is none.
    image_idx : (N,) int64
        The image of each.
    known : bool
        Whether other measurements determine the unit of the model; it is then 1.

    Raises
    ------
    InputError
        If there are too few points, or other measurements contradict them.
    """
    told = np.isfinite(ratio)
    if told.sum() < UNITS.min_points:
        raise InputError(
            f"The depth maps tell the depths of {int(told.sum())} points; {UNITS.min_points} are needed for the unit "
            "of length. Are the maps registered to the photographs, and not empty?"
        )
    level = np.log(ratio[told])
    unit, warnings = float(np.exp(np.median(level))), []
    own = np.array([np.median(level[image_idx[told] == i]) for i in np.unique(image_idx[told])])
    scatter = _spread(own)
    if scatter > UNITS.different:
        warnings.append(
            f"The depth maps do not agree on a unit: their scales differ by {100 * np.expm1(scatter):.0f} % from map "
            "to map. If each was guessed from its photograph alone, pass --relative-depth."
        )
    if known and abs(np.log(unit)) > UNITS.known:
        raise InputError(
            f"Lengths in the depth maps are {unit:.4g} times those that positions, control points or distances tell. "
            f"Is the unit of the maps another? --depth-scale says how many of their numbers are one unit."
        )
    return (1.0 if known else unit), warnings


def own_units(
    ratio: FloatArray, depth: FloatArray, image_idx: IntArray, names: Sequence[str]
) -> tuple[FloatArray, list[str]]:
    """Return for each image (C,) the divisor of its depths, NaN where unknown, and warnings.

    A map is left out if it has too few points, if ratios scatter, or if depths fall as those of points grow.

    Raises
    ------
    InputError
        If that leaves none.
    """
    units, reasons = np.full(len(names), np.nan), {"too few points": 0, "scatter": 0, "falling depths": 0}
    for i in np.unique(image_idx[np.isfinite(ratio)]):
        rows = np.flatnonzero((image_idx == i) & np.isfinite(ratio))
        level = np.log(ratio[rows])
        growth = _growth(np.log(depth[rows] / ratio[rows]), np.log(depth[rows]))
        if len(rows) < UNITS.min_points:
            reasons["too few points"] += 1
        elif growth < -NORMAL.sure:
            reasons["falling depths"] += 1
        elif _spread(level) > UNITS.max_scatter:
            reasons["scatter"] += 1
        else:
            units[i] = np.exp(np.median(level))
    left = ", ".join(f"{count} for {reason}" for reason, count in reasons.items() if count)
    if not np.isfinite(units).any():
        hint = " They fall where depths grow: they are inverse depths. Pass 1 / x." if reasons["falling depths"] else ""
        raise InputError(f"No depth map fits the points by a scale of its own ({left or 'no points'}).{hint}")
    return units, ([f"Depth maps that fit the points by no scale are left out: {left}."] if left else [])


def _spread(values: FloatArray) -> float:
    return SIGMA_OF_MEDIAN * float(np.median(np.abs(values - np.median(values))))


def _growth(first: FloatArray, second: FloatArray) -> float:
    """Return how many standard deviations two rank correlations are above none (Spearman)."""
    ranks = [np.argsort(np.argsort(values)) - 0.5 * (len(values) - 1) for values in (first, second)]
    size = float(np.sqrt((ranks[0] ** 2).sum() * (ranks[1] ** 2).sum()))
    return float((ranks[0] * ranks[1]).sum()) / max(size, 1e-12) * np.sqrt(max(len(first) - 1, 0))


def say_left_out(used: BoolArray, names: Sequence[str]) -> list[str]:
    """Say which photographs have no depth map, in at most one sentence."""
    left = [name for name, one in zip(names, used, strict=True) if not one]
    if not left:
        return []
    listed = first_of(left, 3)
    return [f"{len(left)} of {counted(len(names), 'photographs')} without a depth map, or with an empty one: {listed}."]
