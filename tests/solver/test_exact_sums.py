"""Sums that do not depend on the order of their terms, compared with exact fractions."""

from fractions import Fraction

import numpy as np

from groma.solver.reduce import exact_sums


def test_the_order_and_the_groups_make_no_difference():
    rng = np.random.default_rng(0)
    terms = rng.normal(0, 1, (40, 500)) * 10.0 ** rng.integers(-8, 9, (40, 500))
    terms[20:] = -terms[:20] * (1 + 1e-5 * rng.normal(0, 1, (20, 500)))  # five digits cancel
    exact = [float(sum(map(Fraction, column.tolist()))) for column in terms.T]
    found = []
    for groups in (1, 2, 7):
        sums = [np.zeros(500, complex) for _ in range(groups)]
        for row, term in enumerate(rng.permuted(terms, axis=0)):
            exact_sums.add(sums[row % groups], term)
        total = sums[0]
        for other in sums[1:]:
            exact_sums.add_sums(total, other)
        found.append(exact_sums.rounded(total))
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])
    np.testing.assert_allclose(found[0], exact, rtol=1e-15)
    assert (np.abs(terms.sum(axis=0) - exact) > 0).mean() > 0.3, "plain sums are meant to fail here"


def test_places_and_the_other_way_round():
    first, second = np.zeros((3, 2), complex), np.zeros((3, 2), complex)
    exact_sums.add(first, np.array([[1e20, 1.0]]), np.array([2]))
    exact_sums.add(first, np.array([[1.0, 2.0]]), np.array([2]))
    exact_sums.add(second, np.array([[-1e20, 0.1]]), np.array([2]))
    one, other = first.copy(), second.copy()
    exact_sums.add_sums(one, second)
    exact_sums.add_sums(other, first)
    np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(exact_sums.rounded(one), [[0, 0], [0, 0], [1.0, 3.1]])


def test_what_is_not_finite_stays_so():
    sums = np.zeros(2, complex)
    exact_sums.add(sums, np.array([np.inf, np.nan]))
    exact_sums.add(sums, np.array([1.0, 1.0]))
    np.testing.assert_array_equal(exact_sums.rounded(sums), [np.inf, np.nan])
