# SPDX-License-Identifier: BSD-3-Clause
"""How lines are mapped: lengths, gates and counts."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class MapLinesOptions:
    """How to map lines."""

    #: Shortest segment used, pixels; detectors have a limit of their own.
    min_length: float = 12.0
    #: The longest segment of a line is at least so long, pixels; shorter ones join lines, and make none.
    min_longest: float = 0.0
    #: Neighbours per image.
    num_neighbors: int = 10
    #: Fewest shared points of neighbours.
    min_shared: int = 8
    #: Fewest images of a line.
    min_images: int = 3
    #: Error of poses and cameras in the image, added in quadrature to the segments' sigma; pixels.
    noise: float = 0.15
    #: The sigmas are scaled to what the first lines show, within these bounds; (1, 1) keeps them.
    noise_scale: tuple[float, float] = (0.33, 4.0)
    #: The depth range of the points around a segment is widened by this factor at both sides.
    depth_margin: float = 2.0
    #: Segments are directed, for example dark on the left: the same line then runs the same way in all images.
    directed: bool = True
    #: Share of the shorter of two segments that must overlap along the line.
    min_overlap: float = 0.3
    #: Largest relative standard deviation of the depth of a two-view proposal.
    max_relative_sigma: float = 0.03
    #: Largest standard deviation of a line's end points over their distance from the cameras, or over the usual
    #: distance of a line where that is less.
    max_uncertainty: float = 0.012
    #: The same, over the line's own distance, when any one image of the line is left out: beyond it, a wrong match in
    #: that image would go unnoticed.
    max_unchecked: float = 0.04
    #: A place is ambiguous if another one has more than this share of its support.
    max_rival: float = 0.95
    #: Least share of the segments of a line's kind that are part of a line: see :mod:`groma.mapping.lines.kinds`.
    #: Where less of the whole scene is found again, more is asked. 0 keeps the lines of texture, also those that
    #: :mod:`groma.mapping.lines.texture` finds.
    min_repeatability: float = 0.4
    #: Use lines through known points as further proposals.
    use_points: bool = True
    #: Use vanishing directions, alone and with known points.
    use_directions: bool = True

    @staticmethod
    def selective(min_length: float = 12.0) -> MapLinesOptions:
        """Fewer lines, of which more are right: known to 2.5 thousandths of their distance, and 25 pixels long."""
        return MapLinesOptions(min_length=min_length, max_uncertainty=0.0025, min_longest=25.0)


__all__ = ["MapLinesOptions"]
