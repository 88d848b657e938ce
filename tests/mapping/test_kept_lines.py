# SPDX-License-Identifier: BSD-3-Clause
"""Lines of two maps in the map that they were joined to: each map in a world of its own, the truth known."""

from dataclasses import replace

import numpy as np
import pytest

from groma.geometry import quaternion, so3
from groma.localization.pose.camera import QueryCamera
from groma.mapping.carried.kept_lines import with_lines_of
from groma.scene import LineObservations, Scene, Similarity
from groma.scene.landmarks import Lines

CAMERA = QueryCamera("PINHOLE", np.array([600.0, 610.0, 330.0, 235.0]), 640, 480)
NAMES = tuple(f"{number}.jpg" for number in range(6))
WORLDS = (
    Similarity(2.5, so3.exp(np.array([0.3, -0.5, 1.0])), np.array([1.0, 2.0, 3.0])),
    Similarity(0.4, so3.exp(np.array([-1.0, 0.2, 0.1])), np.array([-4.0, 0.0, 1.0])),
)


@pytest.fixture(scope="module")
def truth():
    """Four lines before six cameras, all seen by all of them."""
    rng = np.random.default_rng(0)
    turn = so3.exp(rng.normal(0.0, 0.05, (6, 3)))
    poses = np.hstack([quaternion.from_matrix(turn), rng.uniform(-0.5, 0.5, (6, 3))])
    ends = rng.uniform([-1.0, -1.0, 4.0], [1.0, 1.0, 6.0], (4, 2, 3))
    segments = np.stack([CAMERA.project(pose, ends.reshape(-1, 3)).reshape(4, 4) for pose in poses])
    scene = Scene.from_images(CAMERA.table(), list(NAMES), np.zeros(6, int), poses)
    seen = LineObservations(np.repeat(np.arange(6), 4), np.tile(np.arange(4), 6), segments.reshape(-1, 4), np.ones(24))
    return scene.replace(lines=Lines.through(ends), line_observations=seen)


def _map(truth, images, lines, world):
    return truth.subset(list(images)).keep(lines=list(lines)).transformed(world)


def test_lines_that_were_not_found_anew_are_kept_at_their_places(truth):
    joint = truth.keep(lines=[0])
    maps = (_map(truth, range(3), [0, 1, 2], WORLDS[0]), _map(truth, range(3, 6), [2, 3], WORLDS[1]))
    out = with_lines_of(joint, maps, (NAMES[:3], NAMES[3:]), np.array([[0, 2]]), 2.0)
    assert out.num_lines == 4 and len(set(out.lines.ids.tolist())) == 4
    np.testing.assert_allclose(out.lines.segments, truth.lines.segments, atol=1e-9)
    # The line that both maps have is one, seen by the images of both; the others by those of their map.
    images = [sorted(out.line_observations.image_idx[out.line_observations.line_idx == row]) for row in range(4)]
    assert images == [list(range(6)), [0, 1, 2], list(range(6)), [3, 4, 5]]


def test_images_that_are_not_in_the_joint_map_tell_nothing(truth):
    joint = truth.subset([0, 1]).keep(lines=[])
    out = with_lines_of(
        joint, (_map(truth, range(3), [1], WORLDS[0]), _map(truth, range(3, 6), [2], WORLDS[1])),
        (NAMES[:3], NAMES[3:]), np.zeros((0, 2), int), 2.0,
    )  # fmt: skip
    assert out.num_lines == 1 and out.line_observations.image_idx.tolist() == [0, 1]


def test_lines_follow_the_images_that_see_them(truth):
    """One camera of the joint map is elsewhere than in its own: a line that it alone sees stays in its image."""
    own = _map(truth, range(3), [1], WORLDS[0])
    own = own.replace(line_observations=own.line_observations.take(np.array([2])))
    poses = truth.frames.rig_from_world.copy()
    poses[2, 4:] += 0.3
    joint = truth.replace(frames=replace(truth.frames, rig_from_world=poses)).keep(lines=[])
    nothing = _map(truth, range(3, 6), [], WORLDS[1])
    out = with_lines_of(joint, (own, nothing), (NAMES[:3], NAMES[3:]), np.zeros((0, 2), int), 2.0)
    pixel = CAMERA.project(poses[2], out.lines.segments[0])
    # The scale is that of all three cameras, so that only the depth is off, and the image is not.
    np.testing.assert_allclose(pixel.ravel(), own.line_observations.segment[0], atol=1e-6)
