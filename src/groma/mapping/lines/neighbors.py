# SPDX-License-Identifier: BSD-3-Clause
r"""Neighbours: images that see the same part of the scene from sufficiently different positions.

Images are compared through the points they share. Pair (i, j) scores

.. math:: n_{ij}\,\min(1,\ \alpha_{ij}/\alpha_0)\,\min(1,\ \alpha_1/\alpha_{ij})

with :math:`n_{ij}` the number of shared points and :math:`\alpha_{ij}` the median angle under which their rays meet:
small angles do not determine depth, and large angles change the appearance. Scenes without points use the angle between
viewing directions and the distance of the cameras instead.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_in_threads
from groma.gates import LINE_MAPS, gate
from groma.geometry import quaternion
from groma.mapping.lines.options import MapLinesOptions
from groma.scene import Scene

if TYPE_CHECKING:
    from scipy import sparse


@dataclass(frozen=True)
class NeighborGates:
    """Which images are good neighbours."""

    min_angle_deg: float = gate(4.0, "deg", "between rays, below which points count less", LINE_MAPS)
    max_angle_deg: float = gate(25.0, "deg", "between rays, above which points count less", LINE_MAPS)
    sample: int = gate(64, "points", "per pair of images for the angle", "cost: the median of so many is enough")
    max_turn_deg: float = gate(60.0, "deg", "between viewing directions without points", LINE_MAPS)
    turn_scale_deg: float = gate(20.0, "deg", "of turn like the usual distance, without points", LINE_MAPS)


GATES = NeighborGates()


def covisible_neighbors(
    scene: Scene, num_neighbors: int, min_shared: int = MapLinesOptions.min_shared
) -> list[IntArray]:
    """Choose for every image its neighbours, best first.

    Parameters
    ----------
    scene : Scene
        Images with poses; points and their observations if there are any.
    num_neighbors : int
        At most this many per image.
    min_shared : int
        Shared points below which two images are no neighbours.

    Returns
    -------
    list of C arrays (n_i,) int
        Indices of images, n_i <= num_neighbors. Empty where nothing is shared.

    Notes
    -----
    Work and memory grow with the number of pairs of images that share points, not with the square of images.
    """
    if len(scene.point_observations) == 0:
        return _by_geometry(scene, num_neighbors)
    sees = _sees(scene)
    shared = _Shared(sees, (sees @ sees.T).tocsr(), scene.points.xyz, scene.cam_centers_in_world)
    return map_in_threads(partial(shared.best_of, num=num_neighbors, min_shared=min_shared), range(scene.num_images))


@dataclass(frozen=True, eq=False)
class _Shared:
    """The points that images share."""

    #: (C, P) one where an image sees a point, and (C, C) how many two images share.
    sees: sparse.csr_array
    number: sparse.csr_array
    xyz: FloatArray
    centers: FloatArray

    def best_of(self, i: int, num: int, min_shared: int) -> IntArray:
        """The best neighbours of an image."""
        row = slice(self.number.indptr[i], self.number.indptr[i + 1])
        others, counts = np.asarray(self.number.indices[row]), np.asarray(self.number.data[row], np.int64)
        keep = (others != i) & (counts >= min_shared)
        others, counts = others[keep], counts[keep]
        # Angles are looked at for four times as many as are wanted.
        order = np.argsort(-counts, kind="stable")[: 4 * num]
        others, counts = others[order], counts[order]
        seen = np.zeros(len(self.xyz), bool)
        seen[self._seen_by(i)] = True
        safe = np.maximum(self._angles(i, others, seen), 1e-6)
        low, high = np.deg2rad(GATES.min_angle_deg), np.deg2rad(GATES.max_angle_deg)
        score = counts * np.minimum(1.0, safe / low) * np.minimum(1.0, high / safe)
        return others[np.argsort(-score, kind="stable")[:num]].astype(np.int64)

    def _angles(self, i: int, others: IntArray, seen: BoolArray) -> FloatArray:
        """Median angles (N,) under which rays of shared points meet; ``seen`` (P,): the points that image i sees."""
        shared = [common[seen[common]] for common in map(self._seen_by, others.tolist())]
        shared = [common[:: max(1, len(common) // GATES.sample)] for common in shared]
        count = np.array([len(common) for common in shared], np.int64)
        owner, last = np.repeat(np.arange(len(others)), count), np.cumsum(count)
        xyz = self.xyz[np.concatenate([np.zeros(0, np.int64), *shared])]
        angles = _angles(xyz - self.centers[i], xyz - self.centers[others[owner]])
        angles = angles[np.lexsort((angles, owner))]
        return 0.5 * (angles[last - (count + 1) // 2] + angles[last - count // 2 - 1])

    def _seen_by(self, image: int) -> IntArray:
        return self.sees.indices[self.sees.indptr[image] : self.sees.indptr[image + 1]]


def _sees(scene: Scene) -> sparse.csr_array:
    """(C, P) one where an image sees a point."""
    from scipy import sparse  # takes a quarter of a second to import

    observations = scene.point_observations
    ones = np.ones(len(observations), np.int32)
    shape = (scene.num_images, scene.num_points)
    sees = sparse.csr_array((ones, (observations.image_idx, observations.point_idx)), shape=shape)
    sees.sum_duplicates()
    sees.sort_indices()
    sees.data[:] = 1
    return sees


def _angles(first: FloatArray, second: FloatArray) -> FloatArray:
    cross = np.linalg.norm(np.cross(first, second), axis=-1)
    return np.arctan2(cross, np.einsum("...i,...i->...", first, second))


def _by_geometry(scene: Scene, num_neighbors: int) -> list[IntArray]:
    """Neighbours without points: similar viewing direction, near by, not at the same place."""
    poses, centers = scene.cam_from_world, scene.cam_centers_in_world
    axis = quaternion.rotate(quaternion.conjugate(poses[:, :4]), np.broadcast_to([0.0, 0.0, 1.0], (len(poses), 3)))
    extent = np.linalg.norm(centers - centers.mean(0), axis=1).max(initial=0.0) if len(centers) else 0.0

    def of_image(i: int) -> IntArray:
        distance = np.linalg.norm(centers - centers[i], axis=1)
        turn = _angles(axis, np.broadcast_to(axis[i], axis.shape))
        usable = (distance > 1e-6 * extent) & (turn < np.deg2rad(GATES.max_turn_deg))
        usable[i] = False
        others = np.flatnonzero(usable)
        spread = np.median(np.sort(distance[others])[:num_neighbors]) if len(others) else 1.0
        cost = turn[others] / np.deg2rad(GATES.turn_scale_deg) + distance[others] / spread
        return others[np.argsort(cost, kind="stable")[:num_neighbors]]

    return [of_image(i) for i in range(len(poses))]
