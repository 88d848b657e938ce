# SPDX-License-Identifier: BSD-3-Clause
"""Which points of a map tell a place from others where the same things stand again.

Windows of one facade are alike; what tells one from the next is beside them: stains, signs, doors, and the plaster
around a frame. For each point the map is searched for the most alike other place, in the images that see the point and
in those that look most like these: a window that is alone in an image, or is seen from another direction than the
others there, has its like in the next. A photograph shows the point itself where it is more like it than that place is.
How many views of a point are, follows from how alike views of one point are in this map; points of which most are tell
places apart.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_in_threads
from groma.gates import NORMAL, gate
from groma.localization.features import Bytes, unit
from groma.localization.matching import Vectors, alike_elsewhere
from groma.localization.pose.gates import VERDICT


@dataclass(frozen=True)
class RepeatedGates:
    """When two places look alike."""

    telling: float = gate(
        0.8, "share", "of the views of a point that are more like it than any other place, for it to tell",
        "chosen on rendered facades: between 0.7 and 0.85 right and wrong places part best",
    )  # fmt: skip
    sample: int = gate(20_000, "descriptors", "that quantiles and directions are computed from", "cost: 20 ms")
    images: int = gate(8, "images", "most alike, that each is compared with, and a query", "cost: of matching")


GATES = RepeatedGates()
#: Quantile of distances of one point: nearer ones look alike (derived from the share that is left out).
ALIKE = 1.0 - NORMAL.significance


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


class Telling(NamedTuple):
    """What tells the points of a map from other places."""

    #: (P,) distances of descriptors within which a view is one of the point, and of no other place.
    within: FloatArray
    #: (P,) share of the views of a point that are; zero where they are too few to tell, and that of all that look alike
    #: where nothing else does.
    share: FloatArray


def telling_points(
    described: Described,
    begin: IntArray,
    sides: FloatArray,
    alike: IntArray,
    seen_at: Callable[[int, IntArray], FloatArray],
    count: int,
) -> Telling:
    """Return what tells ``count`` points from other places.

    Parameters
    ----------
    described, begin
        Points in images, and (I + 1,) where those of each image begin.
    sides : (I,)
        Longer sides of the images, pixels.
    alike : (I, n)
        For each image those that look most like it.
    seen_at
        Returns where an image would see some points, (n, 2) pixels; NaN where it would not.
    count
        Number of points.
    """
    same = [_same(described, upright) for upright in (False, True)]
    few, most = (np.array([_quantile(far, share) for far in same]) for share in (GATES.telling, ALIKE))
    kind = described.upright.astype(np.int64)

    def elsewhere(image: int) -> FloatArray:
        own = slice(begin[image], begin[image + 1])
        nearest = np.full(own.stop - own.start, np.inf)
        for other in (image, *alike[image].tolist()):
            there = described.part(slice(begin[other], begin[other + 1]))
            left = own.start + np.flatnonzero(nearest > few[kind[own]])
            point = described.point[left]
            places = described.pixel[left] if other == image else np.nan_to_num(seen_at(other, point), nan=np.inf)
            for upright in (False, True):
                rows, columns = described.upright[left] == upright, there.upright == upright
                vectors = unit(described.descriptor[left[rows]]), unit(there.descriptor[columns])
                far = alike_elsewhere(
                    vectors[0], places[rows], vectors[1], there.pixel[columns], sides[other] / VERDICT.cells
                )
                nearest[left[rows] - own.start] = np.minimum(nearest[left[rows] - own.start], far)
        return nearest

    nearest = np.full(count, np.inf)
    np.minimum.at(
        nearest, described.point, np.concatenate([np.zeros(0), *map_in_threads(elsewhere, range(len(sides)))])
    )
    within, share = np.zeros((2, count))
    within[described.point] = np.minimum(nearest[described.point], most[kind])
    for upright, far in enumerate(same):
        point = np.unique(described.point[kind == upright])
        near = np.searchsorted(far, within[point], "right") / max(len(far), 1)
        share[point] = np.where(within[point] < most[int(upright)], near, ALIKE)
    return Telling(within, np.where(share > GATES.telling, share, 0.0))


def most_alike(images: Vectors) -> IntArray:
    """Return (I, n) for each image those that look most like it, by descriptions (I, m) of length one."""
    similar = images @ images.T
    np.fill_diagonal(similar, -np.inf)
    return np.argsort(-similar, axis=1, kind="stable")[:, : min(GATES.images, len(images) - 1)]


def alike_limits(described: Described) -> FloatArray:
    """Return (2,) how far descriptors of one point in two images are from each other: of turned ones, of upright ones.

    Parameters are those of :func:`telling_points`.
    """
    return np.array([_quantile(_same(described, upright), ALIKE) for upright in (False, True)])


def _same(described: Described, upright: bool) -> FloatArray:
    """Distances of descriptors of one point in two images, the least first; at most so many, evenly chosen."""
    rows = np.flatnonzero(described.upright == upright)
    rows = rows[np.argsort(described.point[rows], kind="stable")]
    same = np.flatnonzero(np.diff(described.point[rows]) == 0)
    same = same[:: max(len(same) // GATES.sample, 1)]
    first, second = (unit(described.descriptor[rows[same + step]]) for step in (0, 1))
    return np.sort(np.linalg.norm(first - second, axis=1))


def _quantile(far: FloatArray, share: float) -> float:
    return float(np.quantile(far, share)) if len(far) else 0.0
