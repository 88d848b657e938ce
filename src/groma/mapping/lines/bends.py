# SPDX-License-Identifier: BSD-3-Clause
"""Where edges bend away from lines: images that show it are evidence against what lies beyond.

A detector of straight segments breaks a curve into a chain. Where a segment of a line ends, the next one begins, dark
on the same side, and leaves the line. What hides an edge does not look so: its outline passes by, or turns sharply.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from groma._rows import numbered
from groma._trees import kd_tree
from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.line_ends import LINE_ENDS
from groma.execution import map_in_threads
from groma.features.segments import SEGMENTS, Segments
from groma.gates import gate
from groma.geometry import segment2
from groma.mapping.noise.landmarks import LineEndRows, line_end_rows
from groma.scene import LineDepths, LineObservations, Scene


@dataclass(frozen=True)
class BendGates:
    """When one segment continues a curve, in addition to when ends are the same."""

    angle: float = gate(np.pi / 4, "rad", "between segments of a curve at most", "derived from twice LSD's tolerance")


GATES = BendGates()


def num_bent(scene: Scene, segments: Sequence[Segments], ends: LineEndRows, parts: int) -> IntArray:
    """Count the images whose edge has left a line before the middle of each of its parts, (L, parts).

    ``segments`` are all those of each image, and ``ends`` what :func:`line_end_rows` returns.
    """
    seen, bends = scene.line_observations, _bending_ends(scene, segments)
    total, rows = np.zeros((scene.num_lines, parts), np.int64), np.arange(len(seen))
    middle, track = (np.arange(parts) + 0.5) / parts, seen.line_idx * scene.num_images + seen.image_idx
    for sign in (1, -1):  # towards the second end of a line, and towards the first
        places = np.where(ends.good, sign * ends.share, -np.inf)
        end = places.argmax(axis=1)
        place, outermost = places[rows, end], np.full(scene.num_lines * scene.num_images, -np.inf)
        np.maximum.at(outermost, track, place)
        bent = bends[rows, end] & (place == outermost[track]) & ends.good[rows, end]
        count = np.zeros((scene.num_lines, parts + 1), np.int64)
        np.add.at(count, (seen.line_idx[bent], np.searchsorted((sign * middle)[::sign], place[bent])), 1)
        total += np.cumsum(count[:, :-1], axis=1)[:, ::sign]
    return total


def _bending_ends(scene: Scene, segments: Sequence[Segments]) -> BoolArray:
    """Return whether the edge that a segment shows of its line leaves it beyond its first and second end, (N, 2)."""
    every, image = Segments.joined(segments).ends, numbered(np.array([len(one) for one in segments]))[0]
    return np.column_stack(map_in_threads(partial(_bends, scene, every, image), (0, 1)))


def _bends(scene: Scene, every: FloatArray, image: IntArray, end: int) -> BoolArray:
    """Return which segments (N,) of lines have one of all (M, 4) behind this end that leaves the line."""
    seen = scene.line_observations
    here = _apart(seen.segment[:, 2 * end : 2 * end + 2], seen.image_idx)
    there = _apart(every[:, 2 - 2 * end : 4 - 2 * end], image)
    near = kd_tree(here).sparse_distance_matrix(kd_tree(there), LINE_ENDS.same_end, output_type="coo_matrix")
    row, following = near.row.astype(np.intp), near.col.astype(np.intp)
    chain = LineObservations(image[following], seen.line_idx[row], every[following])
    away = np.abs(line_end_rows(scene.replace(line_observations=chain, line_depths=LineDepths())).residual)
    begin, goes = away[:, 1 - end], away[:, end]
    leaves = (begin < SEGMENTS.on) & (goes > begin + SEGMENTS.edge)
    leaves &= goes < np.sin(GATES.angle) * segment2.length(chain.segment)
    return np.bincount(row[leaves], minlength=len(seen)) > 0


def _apart(pixel: FloatArray, image: IntArray) -> FloatArray:
    """Places (N, 3) that are near to each other in one image only."""
    return np.column_stack([pixel, 2.0 * LINE_ENDS.same_end * image.astype(np.float64)])
