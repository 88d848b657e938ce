# SPDX-License-Identifier: BSD-3-Clause
"""The inverse-depth chart of points: linear in the inverse distance, never through the anchor, plain on the anchor."""

import numpy as np
import pytest

from groma.errors import ShapeError
from groma.geometry.charts.point_inverse_depth import MAX_GROWTH, InverseDepthPoint

pytestmark = pytest.mark.kernels
CHART = InverseDepthPoint()


def test_steps_along_the_ray_are_linear_in_the_inverse_distance():
    anchor, ray = np.array([1.0, -2.0, 0.5]), np.array([0.6, 0.0, 0.8])
    state = CHART.anchored((anchor + 4.0 * ray)[None], anchor[None])
    for step in (-20.0, -1.0, 0.3, 2.0):
        moved = CHART.ambient(CHART.retract(state, (step * ray)[None]))[0]
        distance = (moved - anchor) @ ray
        assert 1.0 / distance == pytest.approx(1.0 / 4.0 - step / 4.0**2)
        np.testing.assert_allclose(moved, anchor + distance * ray, atol=1e-12)


def test_growth_is_limited_and_points_stay_on_their_side():
    state = CHART.anchored(np.array([[0.0, 0.0, 2.0]]), np.zeros((1, 3)))
    assert CHART.retract(state, np.array([[0.0, 0.0, 1e6]]))[0, 2] == pytest.approx(2.0 * MAX_GROWTH)
    assert 0.0 < CHART.retract(state, np.array([[0.0, 0.0, -1e6]]))[0, 2] < 1e-4


def test_steps_across_the_ray_keep_the_depth():
    state = CHART.anchored(np.array([[0.0, 0.0, 2.0]]), np.zeros((1, 3)))
    np.testing.assert_array_equal(CHART.retract(state, np.array([[0.5, -0.25, 0.0]]))[0, :3], [0.5, -0.25, 2.0])


def test_on_its_anchor_a_point_moves_by_addition():
    state = CHART.anchored(np.ones((1, 3)), np.ones((1, 3)))
    step = np.array([[0.1, 0.2, -0.3]])
    moved = CHART.retract(state, step)
    np.testing.assert_allclose(moved[:, :3], 1.0 + step)
    np.testing.assert_allclose(CHART.local(state, moved), step)


def test_with_share_zero_a_point_moves_by_addition():
    state = CHART.anchored(np.ones((1, 3)), np.array([[3.0, 0.0, 0.0]]), 0.0)
    step = np.array([[100.0, 0.2, -0.3]])
    moved = CHART.retract(state, step)
    np.testing.assert_array_equal(moved[:, :3], 1.0 + step)
    np.testing.assert_array_equal(CHART.local(state, moved), moved[:, :3] - 1.0)


def test_points_that_no_step_reaches_give_plain_differences():
    state = CHART.anchored(np.array([[0.0, 0.0, 2.0]]), np.zeros((1, 3)))
    other = CHART.anchored(np.array([[0.0, 0.0, -2.0]]), np.zeros((1, 3)))
    np.testing.assert_array_equal(CHART.local(state, other), [[0.0, 0.0, -4.0]])


def test_shapes_are_checked():
    with pytest.raises(ShapeError, match=r"\(N, 3\)"):
        CHART.anchored(np.zeros((2, 3)), np.zeros((3, 3)))
