# SPDX-License-Identifier: BSD-3-Clause
"""Which pairs of photographs are matched: all of few; else neighbours by name, by their places, by their poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from groma._trees import kd_tree
from groma._typing import FloatArray

#: Up to this many images every pair is matched; beyond it each image is matched with its followers by name (cost: time
#: grows with the square).
EXHAUSTIVE_LIMIT = 120
#: Followers, and then every second power of two, so that a walk around a building is closed (cost: time grows with it).
OVERLAP = 12
#: Largest of these powers (cost: time).
_FARTHEST = 2**9
#: Images whose pairs are matched in one call; their features are loaded once for all of them (cost: time only).
_BLOCK = 8
#: Nearest places that are matched, and pairs in a call then (cost: time).
_NEAREST, _PAIRS_IN_A_CALL = 24, 200
#: Metres of a degree of latitude.
_DEGREE = 111_195.0


def pair_blocks(count: int) -> Iterator[list[tuple[int, int]]]:
    """Yield the pairs of images to match, in blocks that need the features of few images."""
    steps = {*range(1, OVERLAP + 1), *(2**k for k in range(_FARTHEST.bit_length()))}
    if count <= EXHAUSTIVE_LIMIT:
        steps = set(range(1, count))
    starts = range(0, count, _BLOCK)
    for row in starts:
        for column in range(row, count, _BLOCK):
            block = [
                (i, j)
                for i in range(row, min(row + _BLOCK, count))
                for j in range(max(i + 1, column), min(column + _BLOCK, count))
                if j - i in steps
            ]
            if block:
                yield block


def blocks_of_pairs(
    count: int, places: FloatArray | None = None, axes: FloatArray | None = None
) -> list[list[tuple[int, int]]]:
    """Return the pairs to match, in blocks: those of :func:`pair_blocks`, of many images their neighbours in space too.

    Parameters
    ----------
    count : int
        Number of images.
    places : (count, 3), optional
        Where they were taken; NaN where unknown.
    axes : (count, 3), optional
        Optical axes: images that face away from each other are left out.
    """
    blocks = list(pair_blocks(count))
    if count <= EXHAUSTIVE_LIMIT or places is None:
        return blocks
    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    wanted = min(len(known), _NEAREST + 1)
    if wanted < 2:
        return blocks
    found = np.asarray(kd_tree(places[known]).query(places[known], wanted)[1])
    first, second = np.repeat(known, wanted), known[found.ravel()]
    kept = first != second
    if axes is not None:
        kept &= np.einsum("ij,ij->i", axes[first], axes[second]) > 0.0
    ends = np.sort(np.stack([first[kept], second[kept]], axis=1), axis=1)
    by_name = {pair for block in blocks for pair in block}
    more = sorted({(int(i), int(j)) for i, j in ends.tolist()} - by_name)
    return blocks + [more[start : start + _PAIRS_IN_A_CALL] for start in range(0, len(more), _PAIRS_IN_A_CALL)]


def places_by_gps(content: Any, names: Sequence[str]) -> FloatArray | None:
    """Return where images were taken (N, 3), metres, by the GPS of their EXIF in a database; None without any."""
    images = {image.image_id: image.name for image in content.read_all_images()}
    row_of = {name: row for row, name in enumerate(names)}
    places = np.full((len(names), 3), np.nan)
    for prior in content.read_all_pose_priors():
        row = row_of.get(images.get(prior.corr_data_id.id, ""))
        if row is not None and prior.coordinate_system.name == "WGS84":
            places[row] = prior.position
    if not np.isfinite(places[:, :2]).any():
        return None
    latitude = np.radians(np.nanmedian(places[:, 0]))
    return np.stack(
        [_DEGREE * places[:, 0], _DEGREE * np.cos(latitude) * places[:, 1], np.nan_to_num(0.0 * places[:, 2])], axis=1
    )
