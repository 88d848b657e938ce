# SPDX-License-Identifier: BSD-3-Clause
"""Matches of one query with a map: by description alone, with some images of the map; and near where a pose says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from groma._typing import FloatArray, IntArray
from groma.features.matching.wide_baseline import match_wide_baseline
from groma.features.segments import Segments
from groma.localization.camera import QueryCamera
from groma.localization.features import DescribedImage, unit
from groma.localization.line_matching import SeenLines, lines_near
from groma.localization.map_index import MapIndex
from groma.localization.matches import Matches
from groma.localization.matching import MATCHES, match_descriptors
from groma.scene import Scene


@dataclass(frozen=True, eq=False)
class Candidates:
    """Numbers of what may be seen of what, without repetition."""

    #: (n, 2) points of the query, and of the map; (m, 2) segments of the query, and lines of the map.
    points: IntArray
    lines: IntArray

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
        )


def described_alike(
    query: DescribedImage, scene: Scene, index: MapIndex, images: IntArray, lines: bool = True
) -> tuple[Candidates, IntArray]:
    """Match a query with some images of a map, one after the other.

    Returns
    -------
    Candidates, (k,) int
        What matches, and the number of matching points of each image.
    """
    vectors = unit(query.points.descriptors)
    points, segments, count = [np.zeros((0, 2), np.int64)], [np.zeros((0, 2), np.int64)], []
    determined = np.isfinite(index.line_covariance).all(axis=(1, 2))
    for image in images.tolist():
        own = slice(index.begin[image], index.begin[image + 1])
        pairs = match_descriptors(vectors, unit(index.descriptor[own]))
        points.append(np.column_stack([pairs[:, 0], index.point[own][pairs[:, 1]]]))
        count.append(len(pairs))
        if lines:
            places = np.hstack([query.points.pixels[pairs[:, 0]], index.pixel[own][pairs[:, 1]]])
            segments.append(_alike_lines(query, scene, index, image, places))
    found = np.unique(np.concatenate(segments), axis=0)
    return Candidates(np.unique(np.concatenate(points), axis=0), found[determined[found[:, 1]]]), np.array(count)


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
    points = _points_near(query, index, images, camera, pose, reach[0])
    if not lines:
        return Candidates(points, np.zeros((0, 2), np.int64))
    rows = np.concatenate([np.arange(index.segment_begin[i], index.segment_begin[i + 1]) for i in images])
    line = scene.line_observations.line_idx[index.segment[rows]]
    determined = np.isfinite(index.line_covariance[line]).all(axis=(1, 2))
    known, owner = np.unique(line[determined], return_inverse=True)
    seen = SeenLines(owner.ravel(), index.segment_descriptor[rows[determined]], scene.lines.segments[known])
    pairs = lines_near(camera, pose, seen, query.segments, query.segment_descriptors, reach[1])
    return Candidates(points, np.column_stack([pairs[:, 1], known[pairs[:, 0]]]))


def _points_near(
    query: DescribedImage, index: MapIndex, images: IntArray, camera: QueryCamera, pose: FloatArray, reach: float
) -> IntArray:
    none = np.zeros((0, 2), np.int64)
    rows = np.concatenate([np.arange(index.begin[i], index.begin[i + 1]) for i in images])
    expected = camera.project(pose, index.xyz[index.point[rows]])
    inside = camera.inside(expected, reach)
    rows, expected = rows[inside], expected[inside]
    if not len(rows) or not len(query.points):
        return none
    near = KDTree(expected).sparse_distance_matrix(KDTree(query.points.pixels), reach, output_type="ndarray")
    first, second = near["i"], near["j"]
    one, other = unit(index.descriptor[rows]), unit(query.points.descriptors)
    far = np.sqrt(np.maximum(2.0 - 2.0 * np.einsum("nk,nk->n", one[first], other[second]), 0.0))
    alike = np.flatnonzero(far <= MATCHES.distance)
    alike = alike[np.argsort(far[alike], kind="stable")]
    pairs = np.column_stack([second[alike], index.point[rows[first[alike]]]])
    # The nearest in description for the point of the query, and for that of the map.
    best = [np.isin(np.arange(len(pairs)), np.unique(pairs[:, side], return_index=True)[1]) for side in (0, 1)]
    return pairs[best[0] & best[1]]


__all__ = ["Candidates", "described_alike", "found_near"]
