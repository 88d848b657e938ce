# SPDX-License-Identifier: BSD-3-Clause
"""A box that looks the same from opposite sides: where it is seen from after a gap is left open, unless depth tells."""

import numpy as np
import pytest

from groma.geometry import se3
from groma.io.sequences import Frame, SequenceCamera
from groma.tracking import Tracker, TrackOptions
from groma.tracking.pose.half_turns import turned_by_half

WIDTH, HEIGHT, FOCAL = 320, 240, 260.0
CAMERA = SequenceCamera("PINHOLE", np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT)
#: Boxes from corner to corner; y points down, the floor is at 0. The first one is painted alike on opposite sides.
BOX, BESIDE = ((-0.5, -0.6, -0.3), (0.5, 0.0, 0.3)), ((0.6, -1.0, -0.5), (1.4, 0.0, 0.5))
#: Seen from the other side as well: there a tenth of what is in view would be seen through.
POST = ((0.6, -1.0, -0.3), (0.8, 0.0, -0.1))
GREY = np.random.default_rng(3).integers(40, 220, 4096)


def test_half_turns_move_the_world_and_keep_the_axis():
    pose = se3.exp(np.array([[0.1, -0.2, 0.15, 0.1, 0.3, -0.1]]))[0]
    axis, centre = np.array([0.0, 0.6, 0.8]), np.array([0.3, 0.2, 4.0])
    turned = turned_by_half(pose, axis, centre)
    along, across = centre + 2.0 * axis, np.array([1.0, 0.8, -0.6])
    for place, from_place in ((along, along), (centre + across, centre - across)):
        seen = se3.transform_points(np.stack([turned, pose]), np.stack([place, from_place]))
        np.testing.assert_allclose(seen[0], seen[1], atol=1e-12)
    np.testing.assert_allclose(turned_by_half(turned, axis, centre)[4:], pose[4:], atol=1e-12)


@pytest.mark.parametrize(
    ("boxes", "angle", "status"),
    [
        ([BOX], 180.0, "lost"), ([BOX], 0.0, "lost"), ([BOX, BESIDE], 0.0, "tracked"), ([BOX, BESIDE], 180.0, "lost"),
        ([BOX, POST], 0.0, "tracked"), ([BOX, POST], 180.0, "lost"),
    ],
)  # fmt: skip
def test_after_a_gap_the_other_side_is_told_by_depth_alone(boxes, angle, status):
    tracker = Tracker(CAMERA, TrackOptions(threaded=False))
    statuses = [tracker.process(_frame(boxes, 3.0 * k, 0.1 * k)).status for k in range(4)]
    assert set(statuses) == {"tracked"}
    assert tracker.process(_frame(boxes, angle + 35.0, 10.0)).status == status


def _frame(boxes, angle, time):
    """What a camera sees that looks at the first box from an angle, in degrees."""
    way = np.radians(angle)
    centre = np.array([1.7 * np.sin(way), -1.9, -1.7 * np.cos(way)])
    target = np.array([0.2 * np.cos(way), -0.3, 0.2 * np.sin(way)])
    z = (target - centre) / np.linalg.norm(target - centre)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    R = np.column_stack([x, np.cross(z, x), z])
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    along = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones(u.shape)], axis=-1) @ R.T
    depth = np.where(along[..., 1] > 0, -centre[1] / along[..., 1], 50.0)
    for low, high in boxes:
        both = (np.array([low, high])[:, None, None] - centre) / along
        enter, leave = both.min(axis=0).max(axis=-1), both.max(axis=0).min(axis=-1)
        depth = np.where((enter < leave) & (enter > 0), np.minimum(depth, enter), depth)
    place = centre + depth[..., None] * along + 0.003
    cell = np.floor(np.where(place[..., :1] < 0, -1.0, 1.0) * place * [1, 0, 1] / 0.04 + place * [0, 1, 0] / 0.04)
    grey = GREY[(cell @ [73, 179, 283]).astype(int) % 4096]
    return Frame(time, grey.astype(np.uint8), depth=np.where(depth < 6.0, depth, 0.0).astype(np.float32))
