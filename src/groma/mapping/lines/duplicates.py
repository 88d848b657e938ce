# SPDX-License-Identifier: BSD-3-Clause
"""Lines that only repeat another one, beside it.

Two edges that are a pixel or two apart in an image, such as those of a thin board, are one segment there, up to a pixel
away from either. A few such segments of neighbouring images agree on a line where there is nothing, or agree with a
segment elsewhere by chance. What gives that line away is another one: in most images of the first it runs within
:data:`REACH` of the segments if it has many more images, or within their noise if it has more; and no image shows both
of them side by side. Without the images that are so explained, fewer are left than make a line.
"""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray, IntArray
from groma.mapping.distinct import distinct_pairs
from groma.mapping.lines.merge import seen_apart
from groma.mapping.lines.tracks import Tracks

#: Edges nearer than that to each other are one segment in an image, pixels.
REACH = 1.0
#: Share of a line's images in which another one explains its segments.
MIN_SHARE = 0.6
#: How many times more images the other line must have, where it only runs near the segments.
MIN_RATIO = 2


def not_duplicates(tracks: Tracks, neighbors: list[IntArray], min_images: int) -> BoolArray:
    """(L,) lines that no other line explains."""
    good, images = np.ones(len(tracks.X), bool), tracks.num_images()
    for reach, ratio in ((REACH, MIN_RATIO), (None, 1.0)):
        hit = tracks.near_lines(neighbors, reach)
        owner = tracks.line_of[hit[:, 1]]
        stronger = (owner >= 0) & (images[hit[:, 0]] > images[owner]) & (images[hit[:, 0]] >= ratio * images[owner])
        hit, owner = hit[stronger], owner[stronger]
        seen, _ = distinct_pairs(hit[:, 0] * len(tracks.X) + owner, tracks.views.image_idx[hit[:, 1]])
        key, votes = np.unique(seen[:, 0], return_counts=True)
        pairs = np.column_stack([key // len(tracks.X), key % len(tracks.X)])
        weak = images[pairs[:, 1]]
        explained = (votes >= MIN_SHARE * weak) & (weak - votes < min_images)
        pairs = pairs[explained]
        good[pairs[~seen_apart(tracks, pairs), 1]] = False
    return good


__all__ = ["not_duplicates"]
