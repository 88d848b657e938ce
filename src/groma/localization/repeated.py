# SPDX-License-Identifier: BSD-3-Clause
"""Which points of a map look like no other place: they tell it from where the same things stand again.

Windows of one facade are alike; what tells one from the next is beside them: stains, signs, doors. A point is unique if
no other place in any image that sees it is described as much like it as views of one point are like each other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_work
from groma.gates import gate
from groma.localization.features import Bytes, unit
from groma.localization.matching import alike_elsewhere


@dataclass(frozen=True)
class RepeatedGates:
    """When two places look alike."""

    alike: float = gate(
        0.95, "quantile", "of the distances of descriptors of one point: as near ones look alike", "convention: 95 %"
    )
    sample: int = gate(20_000, "pairs", "of descriptors that this is computed from", "cost: 20 ms")
    cells: int = gate(
        32, "cells", "per longer side: farther than one away is another place", "derived from the reach of a descriptor"
    )


GATES = RepeatedGates()


class Described(NamedTuple):
    """Descriptors of points in the images of a map, one image after the other."""

    #: (F,) the point of each, (F, 2) pixels, (F, 128) descriptors, (F,) which are upright.
    point: IntArray
    pixel: FloatArray
    descriptor: Bytes
    upright: BoolArray

    def part(self, rows: slice) -> Described:
        """Some of them."""
        return Described(self.point[rows], self.pixel[rows], self.descriptor[rows], self.upright[rows])


def unique_points(described: Described, begin: IntArray, sides: FloatArray, count: int) -> BoolArray:
    """Return which of ``count`` points look like no other place.

    Parameters
    ----------
    described, begin
        Points in images, and (I + 1,) where those of each image begin.
    sides : (I,)
        Longer sides of the images, pixels.
    count
        Number of points.
    """
    work = [(described.part(slice(begin[i], begin[i + 1])), float(side) / GATES.cells) for i, side in enumerate(sides)]
    nearest = np.full(count, np.inf)
    np.minimum.at(nearest, described.point, np.concatenate([np.zeros(0), *map_work(_alike_elsewhere, work)]))
    found = np.zeros(count, bool)
    for upright, limit in zip((False, True), alike_limits(described), strict=True):
        points = described.point[described.upright == upright]
        found[points] = nearest[points] > limit
    return found


def alike_limits(described: Described) -> FloatArray:
    """Return (2,) how far descriptors of one point in two images are from each other: of turned ones, of upright ones.

    Parameters are those of :func:`unique_points`.
    """
    limits = np.zeros(2)
    for upright in (False, True):
        rows = np.flatnonzero(described.upright == upright)
        rows = rows[np.argsort(described.point[rows], kind="stable")]
        same = np.flatnonzero(np.diff(described.point[rows]) == 0)
        if len(same):
            same = same[:: max(len(same) // GATES.sample, 1)]
            first, second = (unit(described.descriptor[rows[same + step]]) for step in (0, 1))
            limits[int(upright)] = np.quantile(np.linalg.norm(first - second, axis=1), GATES.alike)
    return limits


def _alike_elsewhere(work: tuple[Described, float]) -> FloatArray:
    """Distance from each point of an image to the most alike in another place of it."""
    (_, pixel, descriptor, upright), beyond = work
    out = np.empty(len(pixel))
    for kind in (False, True):
        rows = upright == kind
        out[rows] = alike_elsewhere(unit(descriptor[rows]), pixel[rows], beyond)
    return out
