# SPDX-License-Identifier: BSD-3-Clause
"""Lines of a scene with the intervals that their images support (:mod:`groma.estimators.line_intervals`)."""

from __future__ import annotations

import numpy as np

from groma.estimators.line_intervals import supported_intervals
from groma.geometry import segment2
from groma.scene import LineIntervals, Scene
from groma.scene.line_intervals import observed_shares


def with_supported_intervals(scene: Scene) -> Scene:
    """Return the scene with the intervals of its lines found anew; segments end where the outermost intervals do.

    Lines that no two images support anywhere stay as they are.
    """
    seen = scene.line_observations
    share, length = observed_shares(scene), segment2.length(seen.segment)
    size = np.maximum(share[:, 1] - share[:, 0], 1e-12) / np.maximum(length, 1e-12)
    known = np.isfinite(share).all(axis=1)
    line, found = supported_intervals(
        seen.line_idx[known], seen.image_idx[known], share[known], size[known], scene.num_lines
    )
    count = np.bincount(line, minlength=scene.num_lines)
    first = np.cumsum(count) - count
    hull = np.tile([0.0, 1.0], (scene.num_lines, 1))
    some = count > 0
    hull[some] = np.column_stack([found[first[some], 0], found[(first + count - 1)[some], 1]])
    segments, extent = scene.lines.segments, np.diff(scene.lines.segments, axis=1)
    moved = segments[:, :1] + hull[..., None] * extent
    several = count[line] > 1
    line, found = line[several], found[several]
    low, high = hull[line].T
    found = np.clip((found - low[:, None]) / (high - low)[:, None], 0.0, 1.0)
    return scene.replace(
        lines=scene.lines.replace(segments=np.where((hull == [0.0, 1.0])[..., None], segments, moved)),
        line_intervals=LineIntervals(line, found[:, 0], found[:, 1]),
    )
