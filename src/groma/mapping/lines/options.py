# SPDX-License-Identifier: BSD-3-Clause
"""How lines are mapped: lengths, gates and counts."""

from __future__ import annotations

from dataclasses import dataclass

from groma.features.segments import SEGMENTS

#: Shortest segment unless the caller says so, pixels.
MIN_LENGTH = 12.0


@dataclass(frozen=True)
class MapLinesOptions:
    """How to map lines."""

    #: Shortest segment used, pixels; detectors have a limit of their own.
    min_length: float = MIN_LENGTH
    #: A line needs a segment of this length, pixels; shorter segments can only join lines.
    min_longest: float = 0.0
    #: Neighbours per image.
    num_neighbors: int = 10
    #: Smallest number of shared points of neighbours.
    min_shared: int = 8
    #: Smallest number of images of a line.
    min_images: int = 3
    #: Error of poses and cameras in the image, added in quadrature to the segments' sigma; pixels.
    noise: float = 0.15
    #: Bounds of the factor by which sigmas are scaled to the residuals of the first lines; (1, 1) keeps them.
    noise_scale: tuple[float, float] = (0.33, 4.0)
    #: The depth range of the points around a segment is widened by this factor at both sides.
    depth_margin: float = 2.0
    #: Segments are directed, for example dark on the left: the same line then runs the same way in all images.
    directed: bool = True
    #: Fraction of the shorter of two segments that must overlap along the line.
    min_overlap: float = SEGMENTS.overlap
    #: Largest relative standard deviation of the depth of a two-view proposal.
    max_relative_sigma: float = 0.03
    #: Largest standard deviation of the end points of a line, relative to its distance from the cameras or to the
    #: median distance of all lines, whichever is less.
    max_uncertainty: float = 0.012
    #: The same, relative to the distance of the line, without any one of its images: beyond it, a wrong match in that
    #: image would go unnoticed.
    max_unchecked: float = 0.04
    #: A place is ambiguous if another one has more than this share of its support.
    max_rival: float = 0.95
    #: Smallest repeatability of the segments of a line (:mod:`groma.mapping.lines.filtering.kinds`); more is required
    #: where the scene as a whole is less repeatable. 0 keeps all lines of texture, also those that
    #: :mod:`groma.mapping.lines.filtering.texture` finds.
    min_repeatability: float = 0.4
    #: Lines of more images than this are mapped cluster by cluster, each of at most so many images, and joined across
    #: borders (:mod:`groma.mapping.lines.by_clusters`); 0: all at once (cost: memory
    #: of a process).
    cluster_size: int = 250

    @staticmethod
    def selective(min_length: float = MIN_LENGTH) -> MapLinesOptions:
        """Fewer lines of higher precision: known to 2.5 thousandths of their distance, and 25 pixels long."""
        return MapLinesOptions(min_length=min_length, max_uncertainty=0.0025, min_longest=25.0)
