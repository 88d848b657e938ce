# SPDX-License-Identifier: BSD-3-Clause
"""One short descriptor for each point of a map, and a first match of a query with all points that some images see.

The descriptors of a point in all its images are averaged, and kept in the few directions in which descriptors of the
map differ most (principal components). To match the coarsest points of a query with each point of the map once, in few
dimensions, costs a small part of matching it with every image in full.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, IntArray
from groma.gates import gate
from groma.localization.features import DescribedPoints, summed, unit
from groma.localization.map_index import MapIndex
from groma.localization.matching import Vectors, match_descriptors
from groma.localization.repeated import GATES as REPEATED


@dataclass(frozen=True)
class LandmarkGates:
    """How much of a query and of descriptors the first match takes."""

    points: int = gate(600, "points", "of a query, the coarsest", "cost: of matching")
    corners: int = gate(200, "points", "of its corners, the strongest", "cost: of matching")
    landmarks: int = gate(6, "points", "of the map for each of these, first those of two images", "cost: of matching")
    dimensions: int = gate(48, "directions", "of descriptors", "derived from their energy: 97 to 98 %")


GATES = LandmarkGates()


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
        total = summed(index.descriptor, index.point, len(index.xyz))
        step = max(len(index.descriptor) // REPEATED.sample, 1)
        some = unit(index.descriptor[::step])
        directions = np.ascontiguousarray(np.linalg.eigh(some.T @ some)[1][:, -gates.dimensions :])
        return DescribedLandmarks(directions, _short(total, directions), upright)

    def match(self, points: DescribedPoints, landmarks: IntArray) -> IntArray:
        """Pairs (n, 2) of points of a query and of some points of the map, of each kind the first, that are alike."""
        found: list[IntArray] = [np.zeros((0, 2), np.int64)]
        for upright, count in ((False, GATES.points), (True, GATES.corners)):
            rows = np.flatnonzero(points.upright == upright)
            own = np.sort(landmarks[self.upright[landmarks] == upright][: GATES.landmarks * count])
            short = _short(unit(points.descriptors[rows]), self.directions)
            pairs = match_descriptors(short, self.descriptor[own])
            found.append(np.column_stack([rows[pairs[:, 0]], own[pairs[:, 1]]]))
        return np.concatenate(found)


def coarsest(points: DescribedPoints) -> IntArray:
    """Return the points of a query that are matched first; corners are in the order of their strength."""
    blobs, corners = np.flatnonzero(~points.upright), np.flatnonzero(points.upright)
    order = np.argsort(-points.sigma[blobs], kind="stable")
    return np.concatenate([blobs[order[: GATES.points]], corners[: GATES.corners]])


def seen_in(index: MapIndex, images: IntArray) -> IntArray:
    """Return the points of a map that some images see, those first that are seen again more often: what two of them
    see, and what the images that come first see.
    """
    count = len(images)
    first, again = np.full((2, len(index.xyz)), count, np.uint16)
    for rank, image in reversed(list(enumerate(images.tolist()))):
        seen = index.point[index.begin[image] : index.begin[image + 1]]
        again[seen] = np.where(first[seen] < count, 0, count)
        first[seen] = rank
    point = np.flatnonzero(first < count)
    return point[np.argsort((first + again)[point], kind="stable")]


def counted_in(index: MapIndex, images: IntArray, points: IntArray) -> IntArray:
    """Return how many of some points each of some images sees."""
    wanted = np.zeros(len(index.xyz), bool)
    wanted[points] = True
    return np.array([wanted[index.point[index.begin[i] : index.begin[i + 1]]].sum() for i in images.tolist()], np.int64)


def _short(descriptors: Vectors, directions: Vectors) -> Vectors:
    short = descriptors @ directions
    return short / np.maximum(np.linalg.norm(short, axis=1, keepdims=True), np.float32(1e-6))
