# SPDX-License-Identifier: BSD-3-Clause
"""Clusters of images with a ring of neighbours: they cover all once, and hold what work on them reads and no more."""

import numpy as np
import pytest
from _wireframe import arc, random_lines, wireframe

from groma.mapping.lines.clusters import clusters
from groma.mapping.lines.views import build_views


@pytest.fixture(scope="module")
def views():
    rng = np.random.default_rng(4)
    world = wireframe(arc(12), random_lines(30, rng), rng)
    return build_views(world.scene, world.segments, 12.0, 0.5, 1.3)


def _shuffled_path(count, reach, seed=2):
    """Images of a path, each with those up to ``reach`` before and after it as neighbours, in random order."""
    number = np.random.default_rng(seed).permutation(count)
    place = np.argsort(number)
    near = [[p for p in range(place[i] - reach, place[i] + reach + 1) if p != place[i]] for i in range(count)]
    return [np.array([number[p] for p in some if 0 <= p < count], np.int64) for some in near]


@pytest.mark.parametrize("count", [1, 3, 12, 40])
def test_every_image_is_in_one_cluster(views, count):
    found = clusters(_shuffled_path(12, 2), count, views.pointers)
    assert len(found) == min(count, 12)
    assert sorted(np.concatenate([one.images for one in found])) == list(range(12))
    assert max(len(one.images) for one in found) <= -(-12 // count)


def test_a_ring_of_images_on_a_path_is_two_times_the_reach(views):
    """Whatever the order in which images come: they are put along the path first."""
    neighbors = _shuffled_path(12, 1)
    for one in clusters(neighbors, 4, views.pointers):
        assert set(one.known) == {*one.images, *np.concatenate([neighbors[i] for i in one.images])}
        assert len(one.known) <= 3 + 2


def test_the_part_of_a_cluster_is_that_of_the_table(views):
    neighbors = _shuffled_path(12, 2)
    for one in clusters(neighbors, 3, views.pointers):
        part = one.views(views)
        assert len(part.image_idx) == np.diff(views.pointers)[one.known].sum()
        np.testing.assert_array_equal(one.known[part.image_idx], views.image_idx[one.rows])
        for image in one.images:
            here, there = part.rows(int(one.image(image))), views.rows(image)
            for column in ("ends", "ray", "line", "usable", "range"):
                np.testing.assert_array_equal(getattr(part, column)[here], getattr(views, column)[there])
            np.testing.assert_array_equal(part.camera[one.image(image)], views.camera[image])
            rows = np.append(np.arange(there.start, there.stop), -1)
            np.testing.assert_array_equal(one.row(rows), np.append(np.arange(here.start, here.stop), -1))
            np.testing.assert_array_equal(one.whole(one.row(rows)), rows)


def test_images_without_neighbours_are_clusters_of_their_own(views):
    alone = [np.zeros(0, np.int64)] * 12
    assert all(np.array_equal(one.known, one.images) for one in clusters(alone, 12, views.pointers))
