# SPDX-License-Identifier: BSD-3-Clause
"""Duplicates: lines that are explained by another line beside them.

Two edges that are a pixel or two apart in an image, such as those of a thin board, are detected as one segment there,
up to a pixel away from either. A few such segments can agree on a line where there is no edge. It is recognised by
another line that, in most of its images, passes within the noise of its segments and has more images, or passes within
a pixel and has many more; no image shows both side by side. A line is rejected if fewer images than a line needs remain
unexplained.
"""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray, IntArray
from groma.features.segments import SEGMENTS
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.lines.linking.growth import near_lines, votes_for_same
from groma.mapping.lines.linking.merge import seen_apart
from groma.mapping.lines.linking.tracks import Tracks


def not_duplicates(tracks: Tracks, neighbors: list[IntArray], min_images: int) -> BoolArray:
    """(L,) lines that no other line explains."""
    good, images = np.ones(tracks.num_lines, bool), tracks.num_images()
    for reach, ratio in ((SEGMENTS.edge, AGREEMENT.min_ratio), (None, 1.0)):
        hit = near_lines(tracks, neighbors, reach)
        owner = tracks.line_of[hit[:, 1]]
        stronger = (owner >= 0) & (images[hit[:, 0]] > images[owner]) & (images[hit[:, 0]] >= ratio * images[owner])
        pairs, votes = votes_for_same(tracks, hit, stronger)
        weak = images[pairs[:, 1]]
        pairs = pairs[(votes >= AGREEMENT.min_common * weak) & (weak - votes < min_images)]
        good[pairs[~seen_apart(tracks, pairs), 1]] = False
    return good
