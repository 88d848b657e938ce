# SPDX-License-Identifier: BSD-3-Clause
"""Was a photograph mirrored? Its mirror image in the same map, by votes and by how alike the matches are.

What is symmetric is seen in its mirror image, too, with about as many matches. They are less alike: the left side of a
thing looks like its right side, but not as like it as itself. So the most alike matches of both readings tell.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from groma._typing import FloatArray
from groma.gates import gate
from groma.localization.candidates import Candidates, found_near
from groma.localization.expected import nearest_images
from groma.localization.features import DescribedImage, DescribedPoints, mirrored
from groma.localization.map_index import MapIndex
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import Refined, refine
from groma.scene import Scene


@dataclass(frozen=True)
class MirrorGates:
    """Which matches tell a photograph from its mirror image."""

    closest: float = gate(
        0.25, "share", "of the matches of both, the most alike, that are counted", "chosen on the filing cabinet"
    )


GATES = MirrorGates()
#: Matches some points, those of a part of a photograph or of its mirror image, with a map.
Matcher = Callable[[DescribedPoints], Candidates]


@dataclass(eq=False)
class MirrorImage:
    """The mirror image of a photograph in a map."""

    query: DescribedImage
    #: The points that are matched first.
    part: DescribedImage
    camera: QueryCamera
    scene: Scene
    index: MapIndex
    matched: Matcher
    #: Images of the map whose points are looked for near a pose.
    near: int
    _found: Candidates = field(init=False)

    def matches(self, step: int) -> Matches:
        """Its matches, by each so many-th point."""
        points = mirrored(self.part.points.take(np.arange(0, len(self.part.points), step)), self.camera.width)
        self._found = self.matched(points)
        return self._found.matches(self.part.with_points(points), self.scene, self.index)

    def distances(self, other: Refined, reach: float) -> FloatArray:
        """Distances of the descriptors of what agrees with a pose of the mirror image, found as far as so many pixels
        from where it says; the pose is one of the last matches.
        """
        whole = self.query.with_points(mirrored(self.query.points, self.camera.width))
        agreeing = self._found.points[other.point_inliers, 1]
        near = nearest_images(self.index, np.arange(len(self.index.image)), agreeing, self.near)
        found = found_near(whole, self.scene, self.index, near, self.camera, other.pose, (reach, reach), False)
        matches = found.matches(whole, self.scene, self.index)
        fit = refine(self.camera, matches, other.pose, max_errors(matches), gathered=True)
        return found.distance[fit.point_inliers]


def closest_of(first: FloatArray, second: FloatArray, gates: MirrorGates = GATES) -> tuple[int, int]:
    """How many of the smallest distances, of two readings together, belong to each."""
    both = np.concatenate([first, second])
    if not len(both):
        return 0, 0
    limit = np.quantile(both, gates.closest)
    return int((first <= limit).sum()), int((second <= limit).sum())
