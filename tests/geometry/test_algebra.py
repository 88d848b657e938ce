# SPDX-License-Identifier: BSD-3-Clause
"""Products of many small vectors: cross products are NumPy's, bit by bit, whatever the shapes."""

import numpy as np
import pytest

from groma.geometry.algebra import cross


@pytest.mark.parametrize(
    ("first", "second"), [((3,), (3,)), ((5, 3), (3,)), ((4, 1, 3), (1, 6, 3)), ((0, 3), (0, 3)), ((3,), (2, 7, 3))]
)
def test_cross_products_are_those_of_numpy(first, second):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=first), rng.normal(size=second)
    before = a.copy(), b.copy()
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b), strict=True)
    np.testing.assert_array_equal(a, before[0])
    np.testing.assert_array_equal(b, before[1])


def test_cross_products_keep_complex_numbers_and_what_is_not_known():
    a, b = np.array([1.0, 2.0j, 3.0]), np.array([0.5, 1.0, -2.0])
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b), strict=True)
    assert np.isnan(cross(np.array([np.nan, 0.0, 1.0]), b)).sum() == 2
