# SPDX-License-Identifier: BSD-3-Clause
"""Nearest points. SciPy orders them in trees; its import takes a quarter of a second, beside other work if possible.

Who is nearest is looked up in boxes, by loops that allocate nothing: SciPy's queries take memory for every place, and
threads that look up places at the same time wait for each other.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from groma._numba import exact_kernel, kernel, loop
from groma._typing import FloatArray, IntArray
from groma.execution import map_ranges

if TYPE_CHECKING:
    from scipy.spatial import KDTree

#: Places that one piece of work looks up at least, most pieces, each of which makes the boxes, and points in a box that
#: is not divided (cost: time only).
_PLACES_AT_ONCE, _PIECES, _BOX = 1024, 16, 10
#: Margin of squared distances, so that points at the limit are compared by distance (derived from rounding).
ROUNDING = 1.0 + 1e-12


@loop
def boxes_loop(points):
    """Boxes (2 P, 6), least and largest coordinates, of points (N, 3), near ones together: a binary tree.

    Row 1 holds all, 2 k and 2 k + 1 the halves of k, as SciPy's trees divide them; the last P each a few points. Those
    that are empty are inverted. Also returns the first point of each of the last P, and N.
    """
    leaves = 1
    while leaves * _BOX < len(points):
        leaves *= 2
    boxes, first = np.empty((2 * leaves, 6)), np.empty(leaves + 1, np.int64)
    first[0], first[leaves], step = 0, len(points), leaves
    while step > 1:
        for k in range(0, leaves, step):
            first[k + step // 2] = (first[k] + first[k + step]) // 2
        step //= 2
    for k in range(2 * leaves - 1, 0, -1):
        for c in range(3):
            if k < leaves:
                boxes[k, c] = min(boxes[2 * k, c], boxes[2 * k + 1, c])
                boxes[k, c + 3] = max(boxes[2 * k, c + 3], boxes[2 * k + 1, c + 3])
                continue
            boxes[k, c], boxes[k, c + 3] = np.inf, -np.inf
            for i in range(first[k - leaves], first[k - leaves + 1]):
                boxes[k, c] = min(boxes[k, c], points[i, c])
                boxes[k, c + 3] = max(boxes[k, c + 3], points[i, c])
    return boxes, first


@kernel
def _squared_kernel(box, x, y, z):
    """Squared distance of a place from a box."""
    a, b, c = max(box[0] - x, x - box[3], 0.0), max(box[1] - y, y - box[4], 0.0), max(box[2] - z, z - box[5], 0.0)
    return a * a + b * b + c * c


@kernel
def box_near_kernel(boxes, x, y, z):
    """One of the last boxes near a place, by number."""
    node = 1
    while 2 * node < len(boxes):
        left, right = _squared_kernel(boxes[2 * node], x, y, z), _squared_kernel(boxes[2 * node + 1], x, y, z)
        node = 2 * node + (1 if right < left else 0)
    return node - len(boxes) // 2


@loop
def nearest_loop(points, boxes, first, place, bound, nearest, squared):
    """Write the nearest points to a place whose squared distances are below a bound, as many as there is room for.

    Returns how many there are. It begins in a box near the place, so that most boxes are farther than what is found.
    """
    count, width, level = 0, len(nearest), 0
    x, y, z = place[0], place[1], place[2]
    if not _squared_kernel(boxes[1], x, y, z) < bound:
        return 0
    while len(boxes) >> (level + 2):
        level += 1
    node, home = 1, box_near_kernel(boxes, x, y, z)
    while node > 0:
        k = node ^ (home >> level)
        if _squared_kernel(boxes[k], x, y, z) < bound:
            if level > 0:
                node, level = 2 * node, level - 1
                continue
            leaf = k - len(boxes) // 2
            for i in range(first[leaf], first[leaf + 1]):
                a, b, c = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
                far = a * a + b * b + c * c
                if far < bound:
                    m = min(count, width - 1)
                    while m > 0 and squared[m - 1] > far:
                        nearest[m], squared[m] = nearest[m - 1], squared[m - 1]
                        m -= 1
                    nearest[m], squared[m] = i, far
                    count = min(count + 1, width)
                    if count == width:
                        bound = squared[width - 1]
        while node & 1:
            node, level = node >> 1, level + 1
        if node > 0:
            node += 1
    return count


@exact_kernel
def _distance_kernel(a, b):
    x, y, z = a[0] - b[0], a[1] - b[1], a[2] - b[2]
    return math.sqrt(x * x + y * y + z * z)


@loop
def _nearest_points_loop(points, places, within, index, distance):
    """Write which points (M, n) are nearest to places (M, 3), and their distances (M, n), up to ``within`` (M,)."""
    squared, (boxes, first) = np.empty(index.shape[1]), boxes_loop(points)
    for k in range(len(places)):
        count = nearest_loop(points, boxes, first, places[k], within[k] * within[k] * ROUNDING, index[k], squared)
        for m in range(count):
            distance[k, m] = _distance_kernel(points[index[k, m]], places[k])
        while count > 0 and distance[k, count - 1] > within[k]:
            count -= 1
        for m in range(count, index.shape[1]):
            index[k, m], distance[k, m] = len(points), np.inf


def kd_tree(points: FloatArray) -> KDTree:
    """Return the tree of points (N, d)."""
    from scipy.spatial import KDTree

    return KDTree(points)


def nearest(tree: KDTree, places: FloatArray, number: int) -> tuple[FloatArray, IntArray]:
    """Return distances (M, n) to the nearest points of a tree and which they are; infinite and N where none is left.

    Points have at most three dimensions.
    """
    distance, index = nearest_in_order(tree.data[tree.indices], places, number)
    return distance, np.append(tree.indices, tree.n)[index]


def nearest_in_order(
    points: FloatArray, places: FloatArray, number: int, within: FloatArray | float = np.inf
) -> tuple[FloatArray, IntArray]:
    """Do what :func:`nearest` does, with points (N, d) of which near ones are together, up to a distance, also (M,)."""
    within = np.broadcast_to(within, len(places)).astype(np.float64)
    distance, index = np.empty((len(places), number)), np.empty((len(places), number), np.int64)
    points, places = (np.pad(one, ((0, 0), (0, 3 - one.shape[1]))) for one in (points, places))

    def look_up(part: slice) -> None:
        _nearest_points_loop(points, places[part], within[part], index[part], distance[part])

    map_ranges(look_up, len(places), max(_PLACES_AT_ONCE, -(-len(places) // _PIECES)))
    return distance, index
