# SPDX-License-Identifier: BSD-3-Clause
"""Matches of one query with a map: by description alone, with some images of the map; near where a pose says; and of
its mirror image.

What is symmetric is seen in the mirror image of a photograph, too, with about as many matches. They are less alike: the
left side of a thing looks like its right side, but not as like it as itself. So the most alike matches of both readings
tell whether a photograph was mirrored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from groma._rows import distinct, numbered
from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import together
from groma.features.matching.wide_baseline import match_wide_baseline
from groma.features.segments import Segments
from groma.gates import gate
from groma.localization.expected import nearest_images
from groma.localization.features import DescribedImage, DescribedPoints, mirrored, unit
from groma.localization.line_matching import SeenLines, lines_near
from groma.localization.map_index import MapIndex
from groma.localization.matching import match_descriptors, pairs_near
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.matches import Matches, nearest_claims
from groma.localization.pose.refinement import Refined, refine
from groma.scene import Scene


@dataclass(frozen=True)
class MirrorGates:
    """Which matches tell a photograph from its mirror image."""

    closest: float = gate(0.25, "share", "of the matches of both that count", "chosen on the filing cabinet")


GATES = MirrorGates()


@dataclass(frozen=True, eq=False)
class Candidates:
    """Numbers of what may be seen of what, without repetition."""

    #: (n, 2) points of the query, and of the map; (m, 2) segments of the query, and lines of the map.
    points: IntArray
    lines: IntArray
    #: (n,) distances of the descriptors of the points; none where they are not told.
    distance: FloatArray = field(default_factory=lambda: np.zeros(0))

    def matches(self, query: DescribedImage, scene: Scene, index: MapIndex) -> Matches:
        """The matches with places, noise and covariances."""
        here, there = self.points.T
        segment, line = self.lines.T
        return Matches(
            query.points.pixels[here],
            index.xyz[there],
            query.segments.ends[segment].reshape(-1, 2, 2),
            scene.lines.segments[line],
            query.points.sigma[here],
            query.segments.sigma[segment],
            index.point_covariance[there],
            index.line_covariance[line],
            shared_error=float(index.shared_error[int(len(line) > 0)]),
        )

    def telling(self, query: DescribedImage, index: MapIndex) -> BoolArray:
        """(n,) which of its points are more like a view of their point of the map than any other place is."""
        kept = np.flatnonzero(index.telling[self.points[:, 1]] > 0.0)
        here, there = self.points[kept].T
        order, begin = index.views
        owner, number = numbered(begin[there + 1] - begin[there])
        view = index.descriptor[order[begin[there][owner] + number]]
        far = np.linalg.norm(unit(view) - unit(query.points.descriptors[here])[owner], axis=1)
        found = np.zeros(len(self.points), bool)
        found[kept[owner[far <= index.within[there][owner]]]] = True
        return found


def points_alike(points: DescribedPoints, index: MapIndex, images: IntArray) -> list[IntArray]:
    """Match points of a query with some images of a map, one after the other.

    Return pairs (n, 2) for each image: points of the query, and of the image.
    """
    vectors = unit(points.descriptors)
    own = (index.descriptor[index.begin[image] : index.begin[image + 1]] for image in images.tolist())
    return [match_descriptors(vectors, unit(descriptor)) for descriptor in own]


def described_alike(index: MapIndex, images: IntArray, pairs: Sequence[IntArray]) -> Candidates:
    """Return what such pairs say of the points of the map."""
    found: list[IntArray] = [np.zeros((0, 2), np.int64)]
    for image, (first, second) in zip(images.tolist(), (each.T for each in pairs), strict=True):
        found.append(np.column_stack([first, index.point[index.begin[image] + second]]))
    return Candidates(np.unique(np.concatenate(found), axis=0), np.zeros((0, 2), np.int64))


def lines_alike(
    query: DescribedImage, scene: Scene, index: MapIndex, images: IntArray, pairs: Sequence[IntArray]
) -> IntArray:
    """Pairs (m, 2) of segments of a query and lines of a map, by their surroundings and the pairs of points near them
    in some images of the map.
    """
    segments: list[IntArray] = [np.zeros((0, 2), np.int64)]
    for image, (first, second) in zip(images.tolist(), (each.T for each in pairs), strict=True):
        places = np.hstack([query.points.pixels[first], index.pixel[index.begin[image] + second]])
        segments.append(_alike_lines(query, scene, index, image, places))
    found = np.unique(np.concatenate(segments), axis=0)
    return found[np.isfinite(index.line_covariance[found[:, 1], 0, 0])]


def _alike_lines(query: DescribedImage, scene: Scene, index: MapIndex, image: int, places: FloatArray) -> IntArray:
    """Pairs (m, 2) of segments of the query and lines of the map whose segments in an image are alike."""
    own = slice(index.segment_begin[image], index.segment_begin[image + 1])
    table = scene.line_observations
    rows = index.segment[own]
    if not len(rows) or not len(query.segments):
        return np.zeros((0, 2), np.int64)
    there = Segments.from_ends(table.segment[rows])
    found = match_wide_baseline(
        query.segments, there, query.segment_descriptors, index.segment_descriptor[own], places
    ).pairs
    return np.column_stack([found[:, 0], table.line_idx[rows[found[:, 1]]]])


def found_near(
    query: DescribedImage,
    scene: Scene,
    index: MapIndex,
    images: IntArray,
    camera: QueryCamera,
    pose: FloatArray,
    reach: tuple[float, float],
    lines: bool = True,
) -> Candidates:
    """Match a query with what a pose says is in it, of the points and lines that some images of the map see.

    ``reach`` is how far points, and ends of segments from lines, may be from there, pixels.
    """

    def points() -> tuple[IntArray, FloatArray]:
        return _points_near(query, index, images, camera, pose, reach[0])

    def segments() -> IntArray:
        return _lines_near(query, scene, index, images, camera, pose, reach[1])

    (pairs, distance), found = together(points, segments) if lines else (points(), np.zeros((0, 2), np.int64))
    return Candidates(pairs, found, distance)


def _lines_near(
    query: DescribedImage,
    scene: Scene,
    index: MapIndex,
    images: IntArray,
    camera: QueryCamera,
    pose: FloatArray,
    reach: float,
) -> IntArray:
    rows = np.concatenate([np.arange(int(index.segment_begin[i]), int(index.segment_begin[i + 1])) for i in images])
    line = scene.line_observations.line_idx[index.segment[rows]]
    determined = np.isfinite(index.line_covariance[line, 0, 0])
    known, owner = distinct(line[determined], len(scene.lines))
    seen = SeenLines(owner, index.segment_descriptor[rows[determined]], scene.lines.segments[known])
    pairs = lines_near(camera, pose, seen, query.segments, query.segment_descriptors, reach)
    return np.column_stack([pairs[:, 1], known[pairs[:, 0]]])


def _points_near(
    query: DescribedImage, index: MapIndex, images: IntArray, camera: QueryCamera, pose: FloatArray, reach: float
) -> tuple[IntArray, FloatArray]:
    rows = np.concatenate([np.arange(int(index.begin[i]), int(index.begin[i + 1])) for i in images])
    seen = np.zeros(len(index.xyz), bool)
    seen[index.point[rows]] = True
    point = np.flatnonzero(seen)
    expected = np.full((len(index.xyz), 2), np.nan)
    expected[point] = camera.project(pose, index.xyz[point])
    seen[point] = camera.inside(expected[point], reach)
    rows = rows[seen[index.point[rows]]]
    if not len(rows) or not len(query.points):
        return np.zeros((0, 2), np.int64), np.zeros(0)
    first, second, far = pairs_near(
        expected[index.point[rows]], rows, (index.descriptor, index.length), query.points.pixels,
        query.points.descriptors, reach,
    )  # fmt: skip
    point = index.point[rows[first]]
    every = np.ones(len(far), bool)
    kept = np.flatnonzero(nearest_claims(second, far, every) & nearest_claims(point, far, every))
    kept = kept[np.argsort(far[kept], kind="stable")]
    return np.column_stack([second[kept], point[kept]]), far[kept]


@dataclass(eq=False)
class MirrorImage:
    """The mirror image of a photograph in a map."""

    query: DescribedImage
    #: The points that are matched first.
    part: DescribedImage
    camera: QueryCamera
    scene: Scene
    index: MapIndex
    #: Matches some points with the map.
    matched: Callable[[DescribedPoints], Candidates]
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


def closest_of(first: FloatArray, second: FloatArray) -> tuple[int, int]:
    """How many of the smallest distances, of two readings together, belong to each."""
    both = np.concatenate([first, second])
    if not len(both):
        return 0, 0
    limit = np.quantile(both, GATES.closest)
    return int((first <= limit).sum()), int((second <= limit).sum())
