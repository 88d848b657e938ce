# SPDX-License-Identifier: BSD-3-Clause
"""Connected parts of graphs."""

import numpy as np
import pytest
import scipy.sparse.csgraph

from groma._rows import connected_parts


@pytest.mark.parametrize("num_pairs", [0, 30, 60, 200])
def test_connected_parts_are_those_of_scipy(num_pairs):
    """Numbered alike, too: clusters are adjusted in this order."""
    first, second = np.random.default_rng(num_pairs).integers(0, 80, (2, num_pairs))
    graph = scipy.sparse.coo_matrix((np.ones(num_pairs), (first, second)), shape=(80, 80))
    expected = scipy.sparse.csgraph.connected_components(graph, directed=False)[1]
    np.testing.assert_array_equal(connected_parts(first, second, 80), expected)


def test_a_long_chain_in_any_order_is_one_part():
    order = np.random.default_rng(0).permutation(5000)
    assert (connected_parts(order[:-1], order[1:], 5000) == 0).all()
