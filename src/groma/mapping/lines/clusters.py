# SPDX-License-Identifier: BSD-3-Clause
"""Images in clusters of covisibility, each with a ring of neighbours: what has to travel to another process.

In come the neighbours of every image; out come clusters of images that see much in common, and the part of the table of
segments that work on a cluster reads: its own segments and those of the ring.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from groma._rows import pointers_of
from groma._typing import IntArray
from groma.mapping.lines.views import LineViews


@dataclass(frozen=True, eq=False)
class Cluster:
    """Some images, and their neighbours around them."""

    #: (n,) the images of the cluster, ascending.
    images: IntArray
    #: (m,) the images of the cluster and of its ring, ascending.
    known: IntArray
    #: (s,) rows of the segments of these in the table of all.
    rows: IntArray

    @staticmethod
    def of(images: IntArray, neighbors: list[IntArray], pointers: IntArray) -> Cluster:
        """Return the cluster of some images; rows of image i are ``pointers[i] : pointers[i + 1]``."""
        known = np.unique(np.concatenate([images, *(neighbors[i] for i in images)]))
        return Cluster(np.sort(images), known, rows_of_images(known, pointers))

    def views(self, views: LineViews) -> LineViews:
        """Return the part of the table that belongs to the cluster and its ring."""
        columns = {
            item.name: getattr(views, item.name)[self.known if item.name in _OF_IMAGES else self.rows]
            for item in fields(LineViews)
            if item.name != "pointers"
        }
        columns["image_idx"] = self.image(columns["image_idx"])
        return LineViews(**columns, pointers=pointers_of(np.diff(views.pointers)[self.known]))

    def image(self, images: IntArray) -> IntArray:
        """Return the numbers that images of the cluster and its ring have in it."""
        return np.searchsorted(self.known, images)

    def row(self, rows: IntArray) -> IntArray:
        """Return the numbers that rows of the table have in the part; those below zero stay."""
        return np.where(rows >= 0, np.searchsorted(self.rows, rows), rows)

    def whole(self, rows: IntArray) -> IntArray:
        """Return rows of the part as those of the table; those below zero stay."""
        return np.where(rows >= 0, self.rows[rows], rows) if len(self.rows) else rows


def rows_of_images(images: IntArray, pointers: IntArray) -> IntArray:
    """Rows of the segments of some images; those of image i are ``pointers[i] : pointers[i + 1]``."""
    return np.concatenate([np.zeros(0, np.int64), *(np.arange(*pointers[i : i + 2].tolist()) for i in images)])


#: Columns of :class:`LineViews` with a row for each image.
_OF_IMAGES = ("camera", "center", "inverse_depth")


def clusters(neighbors: list[IntArray], count: int, pointers: IntArray) -> list[Cluster]:
    """Divide images into at most so many clusters of about equal size, of images that are near each other.

    Images are ordered so that neighbours come close (reverse Cuthill-McKee), and the order is cut. Rows of
    the segments of image i are ``pointers[i] : pointers[i + 1]``.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import reverse_cuthill_mckee

    number = len(neighbors)
    first = np.repeat(np.arange(number), [len(near) for near in neighbors])
    near = np.concatenate([np.zeros(0, np.int64), *neighbors])
    both_ways = np.append(first, near), np.append(near, first)
    graph = csr_array((np.ones(2 * len(near), np.int8), both_ways), (number, number))
    order = np.asarray(reverse_cuthill_mckee(graph, symmetric_mode=True), np.int64)
    return [Cluster.of(part, neighbors, pointers) for part in np.array_split(order, count) if len(part)]
