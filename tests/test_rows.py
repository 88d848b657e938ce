"""Columns of equal length: choosing rows, putting rows together, none at all."""

import numpy as np

from groma._rows import Rows, distinct, medians, pointers_of, sorted_within
from groma.tracking.frame.measurements import LineMeasurements, PlaneMeasurements, PointMeasurements
from groma.tracking.map.lines import FollowedSegments

SEGMENTS = FollowedSegments(np.arange(3), np.arange(12.0).reshape(3, 4), np.ones(3), np.array([5.0, 6.0, 7.0]))


def test_rows_are_chosen_by_index_and_by_mask():
    for rows in ([2, 0], np.array([True, False, True])):
        chosen = SEGMENTS.take(np.asarray(rows))
        np.testing.assert_array_equal(chosen.ends, SEGMENTS.ends[rows])
        np.testing.assert_array_equal(chosen.index, SEGMENTS.index[rows])
        assert isinstance(chosen, FollowedSegments) and len(chosen) == 2


def test_rows_are_put_together_in_order():
    both = SEGMENTS.joined(SEGMENTS.take(np.array([1])))
    np.testing.assert_array_equal(both.strength, [5.0, 6.0, 7.0, 6.0])
    assert FollowedSegments.stack([SEGMENTS, SEGMENTS]).ends.shape == (6, 4)


def test_no_rows_have_the_shape_and_type_of_rows():
    nothing = FollowedSegments.empty()
    assert len(nothing) == len(FollowedSegments.stack([])) == 0
    assert nothing.ends.shape == (0, 4) and nothing.index.dtype == np.int64
    joined = nothing.joined(SEGMENTS)
    assert all(getattr(joined, name).dtype == value.dtype for name, value in vars(SEGMENTS).items())


def test_every_table_of_measurements_can_be_empty():
    kinds: list[type[Rows]] = [PointMeasurements, LineMeasurements, PlaneMeasurements]
    shapes = [[value.shape for value in vars(kind.empty()).values()] for kind in kinds]
    assert shapes == [
        [(0,), (0, 2), (0,), (0,), (0,), (0, 2)],
        [(0,), (0, 4), (0,), (0, 2), (0, 2)],
        [(0,), (0, 4), (0, 3, 3)],
    ]


def test_different_numbers_are_those_of_unique():
    numbers = np.random.default_rng(0).integers(0, 40, 30)
    for some in (numbers, numbers[:0]):
        for found, expected in zip(distinct(some, 40), np.unique(some, return_inverse=True), strict=True):
            np.testing.assert_array_equal(found, expected)


def test_pointers_of_groups_are_whole_numbers_also_without_groups():
    np.testing.assert_array_equal(pointers_of([2, 0, 3]), [0, 2, 2, 5])
    np.testing.assert_array_equal(pointers_of(np.array([True, False])), [0, 1, 1])
    assert pointers_of([]).tolist() == [0] and pointers_of([]).dtype == np.int64


def test_sorted_within_groups_is_what_lexsort_gives():
    """Of few groups and of more than fit a byte, and of none."""
    rng = np.random.default_rng(4)
    for count in (3, 300):
        values, group = rng.normal(size=2000), rng.integers(0, count, 2000)
        np.testing.assert_array_equal(sorted_within(values, group, count), np.lexsort([values, group]))
    assert sorted_within(np.zeros(0), np.zeros(0, int), 0).shape == (0,)


def test_medians_of_groups():
    """Of odd and even numbers of values in any order; a group of none, first, within and last."""
    values, group = np.array([5.0, 1.0, 8.0, 2.0, 4.0, 3.0]), np.array([3, 1, 3, 1, 1, 3])
    np.testing.assert_array_equal(medians(values, group, 5), [0.0, 2.0, 0.0, 5.0, 0.0])
    np.testing.assert_array_equal(medians(values[:2], group[1:3] * 0, 1), [3.0])
    assert medians(np.zeros(0), np.zeros(0, int), 0).shape == (0,)
