# SPDX-License-Identifier: BSD-3-Clause
r"""What an earlier map of the same segments says of their places, and where that is no longer to be relied on.

Mapping is repeated after the poses were adjusted. In comes the earlier map with the scene that it was made in. A pair
of images has *moved* if its epipolar lines have, by more than the noise of poses that mapping allows for anyway. What
supported the place of a segment is compared again, at the new poses. Where none of the pairs of an image has moved, the
candidates of its segments are the same as before within that noise, and there is nothing to search; where one has, its
segments that have no place, or have lost it, are searched anew. Out goes what is known of the segments of each image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma import cameras as camera_models
from groma._typing import FloatArray, IntArray
from groma.execution import map_in_threads
from groma.gates import gate
from groma.mapping.groups import grouped
from groma.mapping.lines.line_map import LineMap
from groma.mapping.lines.views import LineViews
from groma.mapping.noise.landmarks import pixels_of
from groma.scene import Scene


@dataclass(frozen=True)
class EarlierGates:
    """When two images have moved."""

    num_points: int = gate(100, "points", "of an image that tell how its epipolar lines moved", "cost: of a quantile")
    moved_share: float = gate(0.1, "share", "of points that moved, or epipolar lines", "chosen on castle, fountain")


GATES = EarlierGates()


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of the segments (n,) of one image, and its k neighbours."""

    #: (n, k) rows of the segments that supported the place of each, -1 for none.
    supporters: IntArray
    #: (n,) why a segment had no place; ``Outcome.NOT_LINKED`` of those that had one.
    rejection: IntArray
    #: Whether a neighbour has moved against the image, or was none before.
    moved: bool

    def pairs(self, slot: int, first_row: int) -> tuple[IntArray, FloatArray]:
        """Segments of the image and those of the neighbour with this number that supported them, and their scores."""
        chosen = np.flatnonzero(self.supporters[:, slot] >= 0)
        return np.column_stack([chosen, self.supporters[chosen, slot] - first_row]), np.ones(len(chosen))


@dataclass(frozen=True, eq=False)
class EarlierMap:
    """A map of the same segments, and the scene that it was made in."""

    scene: Scene
    lines: LineMap

    def same_cameras(self, scene: Scene) -> bool:
        """Whether the cameras are still the same."""
        one, two = self.scene.cameras, scene.cameras
        return one.models == two.models and np.array_equal(one.params, two.params, equal_nan=True)

    def known(self, scene: Scene, views: LineViews, neighbors: list[IntArray], noise: float) -> list[Known]:
        """Return what is known of each image, at the poses of the scene."""
        table = self.scene.point_observations
        order, bounds = grouped(table.image_idx, scene.num_images)

        def known_of(i: int) -> Known:
            others = neighbors[i]
            place = {int(j): slot for slot, j in enumerate(self.lines.neighbors[i])}
            slots = np.array([place.get(int(j), -1) for j in others], np.int64)
            supporters = self.lines.supporters[views.rows(i)][:, slots].astype(np.int64)
            seen = self.scene.points.xyz[table.point_idx[order[bounds[i] : bounds[i + 1]]]]
            moved = bool((slots < 0).any() or (_moved_px(self.scene, scene, views, i, others, seen) > noise).any())
            return Known(np.where(slots >= 0, supporters, -1), self.lines.rejection[views.rows(i)], moved)

        return map_in_threads(known_of, range(len(neighbors)))


def _moved_px(
    before: Scene, after: Scene, views: LineViews, i: int, others: IntArray, places: FloatArray,
) -> FloatArray:  # fmt: skip
    """(k,) how far the epipolar lines of image i in others moved at places it sees, pixels; infinite without places."""
    places = places[:: max(1, len(places) // GATES.num_points)]
    if not len(places) or not len(others):
        return np.full(len(others), np.inf)
    first = _pixels(before, after, np.full(len(places), i), places)
    # Where points were seen before, by the present lens; and the present epipolar lines of the first.
    second = _pixels(before, after, np.repeat(others, len(places)), np.tile(places, (len(others), 1)))
    camera = views.camera[others]
    across = camera[:, :, :3] @ np.linalg.inv(views.camera[i, :, :3])
    epipole = camera @ np.append(views.center[i], 1.0)
    line = np.cross(epipole[:, None], first @ np.swapaxes(across, 1, 2))
    away = np.abs((line * second.reshape(len(others), -1, 3)).sum(2)) / np.linalg.norm(line[:, :, :2], axis=2)
    moved = np.full(len(others), np.inf)
    for n, one in enumerate(away):
        one = one[np.isfinite(one)]
        if len(one):
            moved[n] = np.quantile(one, 1.0 - GATES.moved_share)
    return moved


def _pixels(before: Scene, after: Scene, image_idx: IntArray, places: FloatArray) -> FloatArray:
    """Homogeneous pixels (n, 3) where images saw points, undistorted by the lenses of another scene; NaN behind."""
    pixels = pixels_of(before, image_idx, places)
    straight = np.full((len(places), 3), np.nan)
    front, camera = np.isfinite(pixels).all(axis=1), after.images.camera_idx[image_idx]
    for one in np.unique(camera):
        rows, model = np.flatnonzero(front & (camera == one)), camera_models.model(after.cameras.models[one])
        straight[rows, :2] = model.undistort_pixels(after.cameras.params_of(one), pixels[rows])
    straight[:, 2] = 1.0
    return straight
