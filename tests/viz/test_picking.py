# SPDX-License-Identifier: BSD-3-Clause
"""Which line a ray through the mouse meets first."""

from dataclasses import replace

import numpy as np
import pytest

from groma.scene import synthetic
from groma.viz.viewer.content import ray_to_segments, view_content


@pytest.fixture(scope="module")
def scene():
    return synthetic.holistic(10, seed=2).truth


def test_distance_of_a_ray_from_segments_against_sampling():
    rng = np.random.default_rng(4)
    segments = rng.normal(size=(200, 2, 3))
    origin, direction = np.array([0.3, -4.0, 0.2]), np.array([0.1, 1.0, 0.05])
    distance, depth = ray_to_segments(origin, 7 * direction, segments)
    forward = direction / np.linalg.norm(direction)
    steps = np.linspace(0, 1, 4001)[None, :, None]
    way = segments[:, :1] * (1 - steps) + segments[:, 1:] * steps - origin
    ahead = way @ forward
    tangent = np.where(ahead > 0, np.linalg.norm(np.cross(way, forward), axis=2) / ahead, np.inf)
    np.testing.assert_allclose(distance, tangent.min(axis=1), atol=1e-3)
    assert (distance <= tangent.min(axis=1) + 1e-12).all()
    np.testing.assert_allclose(depth, np.take_along_axis(ahead, tangent.argmin(axis=1)[:, None], 1)[:, 0], atol=5e-3)


def test_segments_behind_or_across_the_origin():
    segments = np.array([[[0.1, 0, -1], [0.1, 0, -2]], [[0, 1, -1], [0, 1, 3.0]], [[0, 0, 1], [0, 0, 5.0]]])
    distance, _ = ray_to_segments(np.zeros(3), np.array([0, 0, 1.0]), segments)
    assert np.isinf(distance[0])
    np.testing.assert_allclose(distance[1:], [1 / 3, 0], atol=1e-12)


def test_each_line_is_found_by_a_ray_to_its_middle(scene):
    content = view_content(scene)
    every = np.ones(scene.num_lines, bool)
    for line, segment in enumerate(content.segments):
        ray = segment.mean(axis=0) - content.start_position
        assert content.pick(content.start_position, ray, 1e-6, every) == line
        assert content.pick(content.start_position, -ray, 1e-6, every) is None
        hidden = every.copy()
        hidden[line] = False
        assert content.pick(content.start_position, ray, 1e-6, hidden) != line


def test_of_two_lines_behind_each_other_the_front_one_is_found(scene):
    content = view_content(scene)
    segments = content.segments.copy()
    segments[0] = [[-1, 0, 2], [1, 0, 2]]
    segments[1] = [[0, -1, 4], [0, 1, 4]]
    content = replace(content, segments=segments)
    shown = np.arange(scene.num_lines) < 2
    assert content.pick(np.zeros(3), np.array([0, 0.001, 1]), 0.01, shown) == 0
