# SPDX-License-Identifier: BSD-3-Clause
"""Lines that only repeat another one, beside it.

Two edges that are a pixel or two apart in an image, such as those of a thin board, are one segment there, up to a pixel
away from either. A few such segments of neighbouring images agree on a line where there is nothing, or agree with a
segment elsewhere by chance. Another line gives it away: in most images of the first it runs near the segments if it has
many more images, or within their noise if it has more; and no image shows both of them side by side. Without the images
that are so explained, fewer are left than make a line.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, IntArray
from groma.gates import gate
from groma.mapping.lines.growth import near_lines, votes_for_same
from groma.mapping.lines.merge import seen_apart
from groma.mapping.lines.tracks import Tracks


@dataclass(frozen=True)
class DuplicateGates:
    """When a line is explained by another one."""

    reach: float = gate(
        1.0, "px", "edges nearer to each other than this are one segment", "derived from the width of an edge"
    )
    min_share: float = gate(
        0.6, "share", "of the images of a line, in which another one explains its segments", "chosen on ETH3D facades"
    )
    min_ratio: float = gate(
        2.0, "1", "times as many images has a line that only runs near the segments", "chosen on ETH3D facades"
    )


def not_duplicates(
    tracks: Tracks, neighbors: list[IntArray], min_images: int, gates: DuplicateGates = DuplicateGates()
) -> BoolArray:
    """(L,) lines that no other line explains."""
    good, images = np.ones(tracks.num_lines, bool), tracks.num_images()
    for reach, ratio in ((gates.reach, gates.min_ratio), (None, 1.0)):
        hit = near_lines(tracks, neighbors, reach)
        owner = tracks.line_of[hit[:, 1]]
        stronger = (owner >= 0) & (images[hit[:, 0]] > images[owner]) & (images[hit[:, 0]] >= ratio * images[owner])
        pairs, votes = votes_for_same(tracks, hit, stronger)
        weak = images[pairs[:, 1]]
        pairs = pairs[(votes >= gates.min_share * weak) & (weak - votes < min_images)]
        good[pairs[~seen_apart(tracks, pairs), 1]] = False
    return good


__all__ = ["DuplicateGates", "not_duplicates"]
