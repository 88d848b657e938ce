# SPDX-License-Identifier: BSD-3-Clause
"""Nearest points: those of SciPy's trees, the same whoever looks them up, and none where there are none."""

import numpy as np
import pytest

from groma._trees import boxes_loop, kd_tree, nearest, nearest_loop
from groma.execution import work_with

pytestmark = pytest.mark.kernels


@pytest.mark.parametrize("dimensions", [1, 2, 3])
@pytest.mark.parametrize("size", [1, 10, 11, 40, 200, 333])
def test_nearest_points_are_those_of_scipy(size, dimensions):
    rng = np.random.default_rng(size)
    tree, places = kd_tree(rng.normal(size=(size, dimensions))), rng.normal(size=(30, dimensions))
    found, expected = nearest(tree, places, 5), tree.query(places, 5)
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])


def test_neighbours_do_not_depend_on_threads():
    rng = np.random.default_rng(0)
    tree, places = kd_tree(rng.normal(size=(500, 3))), rng.normal(size=(3000, 3))
    alone = nearest(tree, places, 3)
    with work_with(3):
        shared = nearest(tree, places, 3)
    np.testing.assert_array_equal(alone[0], shared[0])
    np.testing.assert_array_equal(alone[1], shared[1])


def test_of_a_place_that_is_none_no_point_is_the_nearest():
    places = np.array([[0.5, 0.0], [np.nan, 0.0]])
    distance, index = nearest(kd_tree(np.zeros((4, 2))), places, 1)
    np.testing.assert_array_equal(distance, [[0.5], [np.inf]])
    assert index[0, 0] < 4 and index[1, 0] == 4
    assert nearest(kd_tree(np.zeros((4, 2))), np.zeros((0, 2)), 2)[0].shape == (0, 2)


def test_points_at_one_place_are_not_looked_at_again_and_again():
    points = np.zeros((100, 3))
    boxes, first = boxes_loop(points)
    index, squared = np.empty(3, np.int64), np.empty(3)
    assert nearest_loop(points, boxes, first, np.zeros(3), 1.0, index, squared) == 3
    assert not squared.any() and (index < first[1]).all()
