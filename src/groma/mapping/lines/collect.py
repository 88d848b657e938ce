# SPDX-License-Identifier: BSD-3-Clause
"""The result of mapping lines, collected from finished tracks and the positions of all segments."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from groma._rows import medians
from groma._typing import FloatArray, IntArray
from groma.mapping.lines.hypotheses.positions import SegmentPositions
from groma.mapping.lines.line_map import LineMap
from groma.mapping.lines.linking.tracks import Tracks
from groma.scene import Lines


def line_map_of(
    tracks: Tracks,
    rows: IntArray,
    pointers: IntArray,
    outcomes: IntArray,
    neighbors: list[IntArray],
    positions: SegmentPositions,
    ratios: FloatArray,
) -> LineMap:
    """Collect the result; lines run like most of their segments.

    Parameters
    ----------
    tracks : Tracks
        The lines, perhaps with a table of fewer than all segments.
    rows : (T,) int
        Row of each segment of that table among all.
    pointers : (C + 1,) int
        Rows of each image among all segments.
    outcomes : (S,) int
        The outcome of each of all segments.
    neighbors, positions, ratios
        Of all images and segments.
    """
    views = tracks.views
    here, line_idx = tracks.members()
    order = np.lexsort([views.image_idx[here], line_idx])
    here, line_idx = here[order], line_idx[order]
    image_idx, ends = views.image_idx[here], tracks.lines.copy()
    turned = tracks.direction() < 0
    ends[turned] = ends[turned][:, ::-1]
    residual = np.sqrt(0.5 * tracks.squared[here]) * tracks.sigma[here]
    return LineMap(
        lines=Lines.through(ends).plucker if len(ends) else np.zeros((0, 6)),
        segments=ends,
        image_idx=image_idx,
        segment_idx=rows[here] - pointers[image_idx],
        line_idx=line_idx,
        residual=residual,
        num_images=tracks.num_images(),
        median_residual=medians(residual, line_idx, tracks.num_lines),
        uncertainty=tracks.uncertainty,
        outcomes=tuple(outcomes[first:last] for first, last in pairwise(pointers)),
        neighbors=tuple(neighbors),
        supporters=positions.supporters.astype(np.int32),
        rejection=positions.rejection,
        depth_ratios=ratios,
    )
