# SPDX-License-Identifier: BSD-3-Clause
"""A pose graph: poses, and measured motions between pairs of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from groma._rows import connected_parts
from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.geometry import se3
from groma.scene.table import Table, column

_STILL = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class GraphPoses(Table, noun="pose"):
    """The nodes of a pose graph. Note the direction: world_from_body, as pose graphs are written."""

    #: (N,) identifiers, each once.
    ids: IntArray = column(np.int64)
    #: (N, 7) pose [qx qy qz qw tx ty tz].
    world_from_body: FloatArray = column(np.float64, 7)
    #: (N,) whether the pose is held.
    held: BoolArray = column(np.bool_, fill=False)


@dataclass(frozen=True, eq=False)
class Motions(Table, noun="motion"):
    """The edges of a pose graph: where the second body is, seen from the first."""

    #: (E,) rows of the two poses.
    first_idx: IntArray = column(np.int64)
    second_idx: IntArray = column(np.int64)
    #: (E, 7) measured pose of the second body in the first.
    first_from_second: FloatArray = column(np.float64, 7)
    #: (E, 6, 6) inverse covariance of the error (rho, omega), scene units and radians, in the frame of the second body.
    information: FloatArray = column(np.float64, 6, 6)


@dataclass(frozen=True)
class PoseGraph:
    """Poses and the motions measured between them."""

    poses: GraphPoses
    motions: Motions
    #: All poses lie in the plane z = 0 and turn about z alone.
    planar: bool = False

    def __post_init__(self) -> None:
        count = len(self.poses)
        if len(np.unique(self.poses.ids)) < count:
            raise InputError("Two poses of the graph have the same id. Number them apart.")
        for name in ("first_idx", "second_idx"):
            rows = getattr(self.motions, name)
            if len(rows) and (rows.min() < 0 or rows.max() >= count):
                bad = int(np.flatnonzero((rows < 0) | (rows >= count))[0])
                raise InputError(f"Motion {bad} has {name} {rows[bad]}; the poses are 0 to {count - 1}.")

    def replace(self, **fields: Any) -> Self:
        """Return a copy with some fields replaced."""
        return type(self)(**{**vars(self), **fields})

    def odometry(self) -> BoolArray:
        """Return which motions (E,) lead from one pose to the next: their ids follow each other."""
        ids = self.poses.ids
        return np.asarray(ids[self.motions.second_idx] - ids[self.motions.first_idx] == 1)

    def parts(self) -> IntArray:
        """Return the connected part (N,) that each pose belongs to, numbered from 0."""
        return connected_parts(self.motions.first_idx, self.motions.second_idx, len(self.poses))

    def chained(self) -> Self:
        """Return the graph with all poses composed from motions, along shortest paths from the first of each part.

        A start for graphs whose poses are not known. Between two poses the earliest motion counts.
        """
        count, forward = len(self.poses), self.motions.first_from_second
        motion = np.concatenate([forward, se3.inverse(forward), np.tile(_STILL, (count, 1))])
        before, used = self._shortest_paths()
        # every pose in the frame of the one before it, then of the one before that, four, eight, ... steps back
        poses = motion[used]
        while (before != before[before]).any():
            poses, before = se3.compose(poses[before], poses), before[before]
        placed = se3.compose(self.poses.world_from_body[before], poses)
        return self.replace(poses=self.poses.replace(world_from_body=placed))

    def _shortest_paths(self) -> tuple[IntArray, IntArray]:
        """Return the pose before each pose and the motion used, forwards, then backwards; the first have themselves."""
        from scipy.sparse import coo_matrix  # takes a quarter of a second to import
        from scipy.sparse.csgraph import breadth_first_order

        count, edges = len(self.poses), len(self.motions)
        first, second = self.motions.first_idx, self.motions.second_idx
        ends = np.concatenate([np.stack([first, second]), np.stack([second, first])], axis=1)
        _, kept = np.unique(ends[0] * count + ends[1], return_index=True)
        begins = np.unique(self.parts(), return_index=True)[1]
        rows = np.concatenate([ends[0, kept], np.full(len(begins), count)])  # one more node leads to all first poses
        columns = np.concatenate([ends[1, kept], begins])
        graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count + 1, count + 1)).tocsr()
        before = breadth_first_order(graph, count)[1][:count].astype(np.int64)
        is_first = before == count
        before[is_first] = np.flatnonzero(is_first)
        used = 2 * edges + np.arange(count)
        moved = np.flatnonzero(~is_first)
        key = ends[0, kept] * count + ends[1, kept]
        used[moved] = kept[np.searchsorted(key, before[moved] * count + moved)]
        return before, used
