# SPDX-License-Identifier: BSD-3-Clause
"""Mapped lines, who sees them, and what became of every segment, in numbers and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma._counted import counted, whole_percent
from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.features.segments import Segments
from groma.mapping.lines.intervals import with_supported_intervals
from groma.mapping.lines.outcomes import REMEDIES, WORDS, Outcome
from groma.scene import LineObservations, Lines, Relations, Scene

#: Groups of segments that :func:`explain` names; the others are counted together (convention: what a sentence can
#: hold).
_NAMED = 4


@dataclass(frozen=True, eq=False)
class LineMap:
    """Lines, the segments that observe them, and what became of all others."""

    #: (L, 6) Plücker lines (m, d), unit direction, world frame.
    lines: FloatArray
    #: (L, 2, 3) end points; directed like the segments.
    segments: FloatArray
    #: (N,) image of each observation; observations are sorted by line.
    image_idx: IntArray
    #: (N,) number of the segment within its image.
    segment_idx: IntArray
    #: (N,) line of each observation.
    line_idx: IntArray
    #: (N,) root mean square distance of the segment's end points to the projected line, pixels.
    residual: FloatArray
    #: (L,) number of images that see the line.
    num_images: IntArray
    #: (L,) median over its observations of ``residual``, pixels.
    median_residual: FloatArray
    #: (L,) largest standard deviation of the end points across the line, scene units.
    uncertainty: FloatArray
    #: One array per image: the :class:`Outcome` of each segment.
    outcomes: tuple[IntArray, ...]
    #: One array per image: its neighbours, best first.
    neighbors: tuple[IntArray, ...]
    #: (S, n) of all segments, image by image: the rows of those that supported its place in space, by neighbour; -1.
    supporters: IntArray
    #: (S,) the :class:`Outcome` of each of them by its own place: why it had none, or NOT_LINKED.
    rejection: IntArray
    #: (S, 2) how the depth changes along each of them by vanishing points, and its standard deviation; zero for none.
    depth_ratios: FloatArray

    @property
    def num_lines(self) -> int:
        """Number of lines."""
        return len(self.lines)

    def outcome_counts(self) -> dict[Outcome, int]:
        """Number of segments with each outcome."""
        counts = np.bincount(np.concatenate([*self.outcomes, np.empty(0, np.int64)]), minlength=len(Outcome))
        return {outcome: int(counts[outcome]) for outcome in Outcome}

    def add_to(self, scene: Scene, segments: Sequence[Segments]) -> Scene:
        """Return the scene with these lines and their observations in place of its own lines."""
        first = pointers_of([len(one) for one in segments])[self.image_idx] + self.segment_idx
        seen = Segments.joined(segments).select(first)
        usual = float(np.median(seen.sigma)) if len(seen) else 1.0
        lines = scene.keep(lines=[]).replace(
            lines=Lines.through(self.segments),
            line_observations=LineObservations(
                self.image_idx, self.line_idx, seen.ends, seen.sigma / usual, seen.contrast
            ),
            relations=Relations(point_on_plane=scene.relations.point_on_plane),
        )
        return with_supported_intervals(lines, segments)


def explain(line_map: LineMap, num_left_out: int = 0, min_confidence: float = 0.0) -> str:
    """Say in words how many segments were mapped, where the others were lost, and what would help.

    ``num_left_out`` lines did not reach the probability ``min_confidence`` and are no part of the map.
    """
    counts = line_map.outcome_counts()
    total = sum(counts.values())
    if not line_map.outcomes:
        return "There are no images. Pass a scene with images and poses."
    if total == 0:
        return (
            "No segments were found in any image. The photographs may be blank, blurred or very dark; a smaller least "
            "length (--min-length) finds shorter ones."
        )
    mapped = counts[Outcome.MAPPED] + counts[Outcome.RECOVERED]
    source = f"from {mapped:,} of {total:,} segments in {counted(len(line_map.outcomes), 'images')}"
    head = f"{counted(line_map.num_lines, 'lines')} {source}."
    if num_left_out:
        head = (
            f"{counted(line_map.num_lines - num_left_out, 'lines')}, of {line_map.num_lines:,} {source}: "
            f"{num_left_out:,}, right with a probability below {min_confidence:g} (--min-confidence), "
            f"{'is' if num_left_out == 1 else 'are'} left out."
        )
    lost = sorted(((n, outcome) for outcome, n in counts.items() if outcome > Outcome.RECOVERED and n), reverse=True)
    if not lost:
        return head
    parts = [f"{n:,} ({whole_percent(n / total)}) {WORDS[outcome]}" for n, outcome in lost[:_NAMED]]
    others = sum(n for n, _ in lost[_NAMED:])
    if others:
        parts.append(f"{others:,} ({whole_percent(others / total)}) were lost for other reasons")
    start = "The map is empty" if line_map.num_lines == 0 else "Of the segments on no line"
    remedy = next((f" What would help most: {REMEDIES[outcome]}." for _, outcome in lost if outcome in REMEDIES), "")
    return f"{head} {start}: {'; '.join(parts)}.{remedy}"
