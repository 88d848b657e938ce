# SPDX-License-Identifier: BSD-3-Clause
r"""Lines of a scene with the intervals that their images support (:mod:`groma.estimators.line_intervals`).

The chord of a bowed edge fits the edge somewhere and leaves it towards its ends, though segments are seen there. With
the distances :math:`r_k` of the segments that show a place from the line there, and their derivatives :math:`g_k` by a
displacement across it, the edge lies beside the line at that place, and nothing supports the line, where

.. math:: b^\top A^{-1} b > n\, w^2 + \chi^2_2\, \sigma^2, \qquad A = \sum_k g_k g_k^\top, \quad b = \sum_k r_k g_k :

where one place in space explains a mean square distance of more than the width w of an edge, beyond usual noise.
Nothing supports it either where as many images show that the edge has bent away (:mod:`groma.mapping.lines.bends`) as
show the line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.line_intervals import supported_intervals
from groma.execution import begin, map_in_threads
from groma.features.segments import SEGMENTS, Segments
from groma.gates import gate
from groma.geometry import segment2
from groma.geometry.algebra import ratio
from groma.mapping.lines.bends import num_bent
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.noise.landmarks import LineEndRows, line_end_rows, line_sigma_px
from groma.scene import LineIntervals, Scene
from groma.scene.line_intervals import observed_shares


@dataclass(frozen=True)
class SupportGates:
    """Beside which parts of a line its edge lies, in addition to when segments agree."""

    parts: int = gate(24, "parts", "of a line, judged each on its own", "cost: memory; most ends are known no better")
    min_leaving: int = gate(2, "segments", "that leave a line beside its edge", "convention: one may be another edge")


GATES = SupportGates()
#: Smallest share of an eigenvalue that counts (convention: rounding): a single image leaves one direction open.
_SINGULAR = 1e-9
#: Segments in a piece of work (cost: memory, and pieces so small that handing them over takes longer than they do).
_AT_ONCE = 4096


def with_supported_intervals(scene: Scene, segments: Sequence[Segments] = ()) -> Scene:
    """Return the scene with the intervals of its lines found anew; segments end where the outermost intervals do.

    Lines that no two images support anywhere stay as they are. ``segments`` are all those of each image, which tell
    where edges bend; nothing is known of that without them.
    """
    seen = scene.line_observations
    shares = begin(partial(observed_shares, scene))
    leaves = _beside_edges(scene, segments)
    share, length = shares(), segment2.length(seen.segment)
    size = np.maximum(share[:, 1] - share[:, 0], 1e-12) / np.maximum(length, 1e-12)
    known, bent = np.isfinite(share.sum(axis=1)), np.asarray(leaves.any(axis=1))[seen.line_idx]
    whole, cut = np.flatnonzero(known & ~bent), np.flatnonzero(known & bent)
    bounds = np.arange(GATES.parts + 1) / GATES.parts
    low, high = np.maximum(share[cut, :1], bounds[:-1]), np.minimum(share[cut, 1:], bounds[1:])
    kept = (low < high) & ~leaves[seen.line_idx[cut]]
    rows = np.concatenate([whole, cut[np.nonzero(kept)[0]]])
    share = np.concatenate([share[whole], np.column_stack([low[kept], high[kept]])])
    line, found = supported_intervals(seen.line_idx[rows], seen.image_idx[rows], share, size[rows], scene.num_lines)
    low, high = leaves.argmin(axis=1) / GATES.parts, 1.0 - leaves[:, ::-1].argmin(axis=1) / GATES.parts
    found = np.clip(found, low[line, None], high[line, None])  # the noise of ends moves none to where edges leave
    some = found[:, 0] < found[:, 1]
    line, found = line[some], found[some]
    count = np.bincount(line, minlength=scene.num_lines)
    first = np.cumsum(count) - count
    hull = np.tile([0.0, 1.0], (scene.num_lines, 1))
    some = count > 0
    hull[some] = np.column_stack([found[first[some], 0], found[(first + count - 1)[some], 1]])
    before, extent = scene.lines.segments, np.diff(scene.lines.segments, axis=1)
    moved = before[:, :1] + hull[..., None] * extent
    several = count[line] > 1
    line, found = line[several], found[several]
    low, high = hull[line].T
    found = np.clip((found - low[:, None]) / (high - low)[:, None], 0.0, 1.0)
    return scene.replace(
        lines=scene.lines.replace(segments=np.where((hull == [0.0, 1.0])[..., None], before, moved)),
        line_intervals=LineIntervals(line, found[:, 0], found[:, 1]),
    )


def _beside_edges(scene: Scene, segments: Sequence[Segments]) -> BoolArray:
    """Tell beside which parts (L, 24) of lines their edges lie."""
    ends, width, size = line_end_rows(scene), SEGMENTS.edge, scene.num_lines * GATES.parts
    lines, starts = scene.line_observations.line_idx, range(0, max(len(ends.share), 1), _AT_ONCE)
    found = map_in_threads(partial(_shown_parts, ends, lines), [slice(start, start + _AT_ONCE) for start in starts])
    place, *values = (np.concatenate(columns) for columns in zip(*found, strict=True))
    count, leaving, xx, xy, yy, xr, yr = (np.bincount(place, value, size) for value in values)
    xx, yy = xx + _SINGULAR * (xx + yy), yy + _SINGULAR * (xx + yy)
    determinant = xx * yy - xy**2
    explained = ratio(yy * xr**2 - 2.0 * xy * xr * yr + xx * yr**2, determinant, determinant > 0.0, 0.0)
    noise = AGREEMENT.max_squared(2) * line_sigma_px(scene, ends) ** 2
    beside = ((explained > width**2 * count + noise) & (leaving >= GATES.min_leaving)).reshape(-1, GATES.parts)
    if not segments or not len(lines):
        return beside
    bent, shown = num_bent(scene, segments, ends, GATES.parts), count.reshape(-1, GATES.parts)
    return beside | ((bent >= shown) & (bent > 0))


def _shown_parts(ends: LineEndRows, line_idx: IntArray, rows: slice) -> tuple[FloatArray | IntArray, ...]:
    """Return the parts of lines that some segments show, and of each what is summed: one for the segment, whether it
    leaves the line, and the products of the formula above.
    """
    share, residual, row = ends.share[rows], ends.residual[rows], ends.row[rows]
    middle = (np.arange(GATES.parts) + 0.5) / GATES.parts
    known = np.asarray(ends.good[rows].all(axis=1), np.bool_)
    low, high = np.sort(share, axis=1).T
    seen, part = np.nonzero((low[:, None] <= middle) & (middle <= high[:, None]) & known[:, None])
    weight = (middle[part] - share[seen, 0]) / (share[seen, 1] - share[seen, 0])
    away = residual[seen, 0] + weight * (residual[seen, 1] - residual[seen, 0])
    x, y = (row[seen, 0] + weight[:, None] * (row[seen, 1] - row[seen, 0])).T
    leaves = np.abs(away) > SEGMENTS.edge
    place = line_idx[rows][seen] * GATES.parts + part
    return place, np.ones(len(x)), leaves, x * x, x * y, y * y, x * away, y * away
