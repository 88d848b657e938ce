# SPDX-License-Identifier: BSD-3-Clause
"""Nearest points of a tree: the same whoever looks them up, and none where there are none."""

import numpy as np
import pytest

from groma._trees import kd_tree, nearest
from groma.execution import work_with


@pytest.mark.parametrize("number", [1, 3])
def test_neighbours_do_not_depend_on_threads(number):
    rng = np.random.default_rng(0)
    tree, places = kd_tree(rng.normal(size=(500, 3))), rng.normal(size=(3000, 3))
    alone = nearest(tree, places, number)
    with work_with(3):
        shared = nearest(tree, places, number)
    expected = tree.query(places, np.arange(1, number + 1))
    for found in (alone, shared):
        np.testing.assert_array_equal(found[0], expected[0])
        np.testing.assert_array_equal(found[1], expected[1])


def test_where_nothing_is_near_there_is_no_neighbour():
    distance, index = nearest(kd_tree(np.zeros((4, 2))), np.array([[0.5, 0.0], [2.0, 0.0]]), 1, within=1.0)
    np.testing.assert_array_equal(distance, [[0.5], [np.inf]])
    assert index[0, 0] < 4 and index[1, 0] == 4
    assert nearest(kd_tree(np.zeros((4, 2))), np.zeros((0, 2)), 2)[0].shape == (0, 2)
