# SPDX-License-Identifier: BSD-3-Clause
"""One short descriptor for each point of a map, and a first match of a query with all points that some images see.

The descriptors of a point in all its images are averaged, and kept in the few directions in which descriptors of the
map differ most (principal components). To match the coarsest points of a query with each point of the map once, in few
dimensions, costs a small part of matching it with every image in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, IntArray
from groma.gates import gate
from groma.localization.features import DescribedPoints, unit
from groma.localization.map_index import MapIndex
from groma.localization.matching import Vectors, match_descriptors


@dataclass(frozen=True)
class LandmarkGates:
    """How much of a query and of descriptors the first match takes."""

    points: int = gate(600, "points", "of a query, the coarsest", "cost: of matching")
    corners: int = gate(200, "points", "of its corners, the strongest", "cost: of matching")
    landmarks: int = gate(10_000, "points", "of the map at most, those that two images see first", "cost: of matching")
    dimensions: int = gate(48, "directions", "of descriptors", "derived from their energy: 97 to 98 %")
    sample: int = gate(20_000, "descriptors", "that the directions are computed from", "cost: 10 ms")


GATES = LandmarkGates()


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _sum(descriptor, point, total):
    """Sums of the descriptors of each point, each of length one."""
    for n in range(len(point)):
        square = np.float32(0.0)
        for j in range(descriptor.shape[1]):
            square += np.float32(descriptor[n, j]) ** 2
        factor = np.float32(1.0) / np.sqrt(max(square, np.float32(1e-6)))
        for j in range(descriptor.shape[1]):
            total[point[n], j] += factor * descriptor[n, j]


# ----------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class DescribedLandmarks:
    """Points of a map, one descriptor each."""

    #: (128, K) directions, and (P, K) descriptors in them, of length one.
    directions: Vectors
    descriptor: Vectors
    #: (P,) which were described upright.
    upright: BoolArray

    @staticmethod
    def of(index: MapIndex, upright: BoolArray, gates: LandmarkGates = GATES) -> DescribedLandmarks:
        """Average the descriptors of an index; ``upright`` (P,) are the points that were described so."""
        total = np.zeros((len(index.xyz), 128), np.float32)
        _sum(index.descriptor, index.point, total)
        step = max(len(index.descriptor) // gates.sample, 1)
        some = unit(index.descriptor[::step])
        directions = np.ascontiguousarray(np.linalg.eigh(some.T @ some)[1][:, -gates.dimensions :])
        return DescribedLandmarks(directions, _short(total, directions), upright)

    def match(self, points: DescribedPoints, landmarks: IntArray) -> IntArray:
        """Pairs (n, 2) of points of a query and of some points of the map that are alike."""
        found: list[IntArray] = [np.zeros((0, 2), np.int64)]
        for upright in (False, True):
            rows = np.flatnonzero(points.upright == upright)
            own = landmarks[self.upright[landmarks] == upright]
            short = _short(unit(points.descriptors[rows]), self.directions)
            pairs = match_descriptors(short, self.descriptor[own])
            found.append(np.column_stack([rows[pairs[:, 0]], own[pairs[:, 1]]]))
        return np.concatenate(found)


def coarsest(points: DescribedPoints) -> IntArray:
    """Return the points of a query that are matched first; corners are in the order of their strength."""
    blobs, corners = np.flatnonzero(~points.upright), np.flatnonzero(points.upright)
    order = np.argsort(-points.sigma[blobs], kind="stable")
    return np.concatenate([blobs[order[: GATES.points]], corners[: GATES.corners]])


def seen_in(index: MapIndex, images: IntArray, gates: LandmarkGates = GATES) -> IntArray:
    """Return the points of a map that some images see, at most so many.

    What two of them see is seen again more often, and more often from near the images that come first.
    """
    times, first = np.zeros((2, len(index.xyz)), np.int64)
    for rank, image in enumerate(images.tolist()):
        seen = np.zeros(len(index.xyz), bool)
        seen[index.point[index.begin[image] : index.begin[image + 1]]] = True
        first[seen & (times == 0)] = rank
        times += seen
    point = np.flatnonzero(times)
    return np.sort(point[np.lexsort((first[point], times[point] < 2))[: gates.landmarks]])


def counted_in(index: MapIndex, images: IntArray, points: IntArray) -> IntArray:
    """Return how many of some points each of some images sees."""
    wanted = np.zeros(len(index.xyz), bool)
    wanted[points] = True
    return np.array([wanted[index.point[index.begin[i] : index.begin[i + 1]]].sum() for i in images.tolist()], np.int64)


def _short(descriptors: Vectors, directions: Vectors) -> Vectors:
    short = descriptors @ directions
    return short / np.maximum(np.linalg.norm(short, axis=1, keepdims=True), np.float32(1e-6))
