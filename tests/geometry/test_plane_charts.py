# SPDX-License-Identifier: BSD-3-Clause
"""Charts of planes: retract, local and basis in general position, far away, through the origin and at infinity.

Also: logarithms of tiny steps, both signs of a plane, drift, and what a chart cannot hold.
"""

import numpy as np
import pytest
from _charts import STEP, by_name, differences

from groma.errors import InputError
from groma.geometry import quaternion
from groma.geometry.charts.plane_charts import PLANE_CHARTS

pytestmark = pytest.mark.kernels

CHARTS = list(PLANE_CHARTS.values())
QUATERNIONS = [chart for chart in CHARTS if chart.name.startswith("quaternion")]
THROUGH_ORIGIN_TOO = [chart for chart in CHARTS if chart.name != "closest_point"]


def plane(normal, offset):
    """Plane (1, 4)."""
    return np.array([[*normal, offset]], dtype=float)


def same_plane(first, second, tolerance=1e-12, oriented=False):
    """Whether planes (N, 4) agree up to scale; up to a positive one if oriented."""
    first, second = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in (first, second))
    if not oriented:
        second = second * np.sign(np.sum(first * second, axis=1, keepdims=True))
    np.testing.assert_allclose(first, second, atol=tolerance, rtol=0)


# ------------------------------------------------------------------------------------------------- General position


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_retract_and_local_are_inverse(chart):
    rng = np.random.default_rng(2)
    state = chart.random(rng, 30)
    np.testing.assert_allclose(chart.retract(state, np.zeros((30, 3))), state, atol=1e-15)
    np.testing.assert_allclose(chart.local(state, state), 0.0, atol=1e-15)
    for size in (1e-9, 1e-3, 0.3, 1.2):
        delta = size * rng.uniform(-1, 1, (30, 3))
        moved = chart.retract(state, delta)
        np.testing.assert_allclose(chart.local(state, moved), delta, atol=4e-15, rtol=1e-12)
    other = chart.random(rng, 30)
    same_plane(chart.ambient(chart.retract(state, chart.local(state, other))), chart.ambient(other))


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_basis_is_the_derivative_of_the_ambient_numbers(chart):
    rng = np.random.default_rng(3)
    random = chart.random(rng, 20)
    for state in (random, chart.retract(random, rng.normal(size=(20, 3)))):
        np.testing.assert_allclose(chart.basis(state), differences(chart, state), atol=4e-11, rtol=0)


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_from_ambient_round_trips(chart):
    rng = np.random.default_rng(4)
    ambient = 10 ** rng.uniform(-6, 6, (20, 1)) * rng.normal(size=(20, 4))
    before = ambient.copy()
    same_plane(chart.ambient(chart.from_ambient(ambient)), ambient, oriented=chart.name != "closest_point")
    assert np.array_equal(ambient, before)


def test_quaternion_increments_multiply():
    """exp(delta) on the left or on the right, by an independent product."""
    rng = np.random.default_rng(5)
    state, delta = PLANE_CHARTS["quaternion_left"].random(rng, 10), rng.normal(size=(10, 3))
    step = quaternion.exp(delta)
    left, right = (PLANE_CHARTS[f"quaternion_{side}"].retract(state, delta) for side in ("left", "right"))
    np.testing.assert_allclose(left, quaternion.multiply(step, state), atol=1e-15)
    np.testing.assert_allclose(right, quaternion.multiply(state, step), atol=1e-15)


def test_normal_turns_by_the_angle():
    chart = PLANE_CHARTS["normal_offset"]
    state = chart.random(np.random.default_rng(6), 10)
    for angle in (1e-5, 0.1, 3.0):
        moved = chart.retract(state, np.tile([0.6 * angle, -0.8 * angle, 0.25], (10, 1)))
        sine = np.linalg.norm(np.cross(state[:, :3], moved[:, :3]), axis=1)
        cosine = np.sum(state[:, :3] * moved[:, :3], axis=1)
        np.testing.assert_allclose(np.arctan2(sine, cosine), angle, rtol=1e-10)
        np.testing.assert_allclose(moved[:, 3], state[:, 3] + 0.25, rtol=1e-15)


# ---------------------------------------------------------------------------------------------------- Degenerate places
@pytest.mark.parametrize("normal", [[1, 0, 0], [0, 0, 1], [0, 0, -3], [0.3, -0.5, 0.1]], ids=str)
@pytest.mark.parametrize("chart", THROUGH_ORIGIN_TOO, ids=by_name)
def test_plane_through_the_origin(chart, normal):
    ambient = plane(normal, 0.0)
    state = chart.from_ambient(ambient)
    same_plane(chart.ambient(state), ambient, 1e-15, oriented=True)
    B = chart.basis(state)
    np.testing.assert_allclose(B, differences(chart, state), atol=4e-11, rtol=0)
    values = np.linalg.svd(B[0], compute_uv=False)
    assert values[0] / values[-1] == pytest.approx(1.0)
    delta = np.array([[0.1, -0.2, 0.3]])
    np.testing.assert_allclose(chart.local(state, chart.retract(state, delta)), delta, atol=1e-15)


def test_closest_point_refuses_planes_through_the_origin():
    chart = PLANE_CHARTS["closest_point"]
    for offset in (0.0, 1e-10, -1e-10):
        with pytest.raises(InputError, match=r"within 1e-9 of the origin; row 1 .*normal_offset"):
            chart.from_ambient(np.vstack([plane([0, 0, 2], 1.0), plane([0, 0, 1], offset)]))
    # A step may still end there: zeros, not NaN, and the factors count the plane as degenerate.
    state = chart.from_ambient(plane([0, 3, 4], -10.0))
    np.testing.assert_allclose(state, [[0, 1.2, 1.6]], rtol=1e-15)
    assert not chart.ambient(chart.retract(state, -state)).any()
    assert np.isfinite(chart.basis(0.0 * state)).all()


@pytest.mark.parametrize("distance", [1e3, 1e6, 1e9])
@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_far_plane(chart, distance):
    n = np.array([0.1, -0.6, 0.8]) / np.linalg.norm([0.1, -0.6, 0.8])
    state = chart.from_ambient(plane(n, -distance))
    a = chart.ambient(state)
    np.testing.assert_allclose(a[0, :3] / np.linalg.norm(a[0, :3]), n, atol=1e-14)
    np.testing.assert_allclose(-a[0, 3] / np.linalg.norm(a[0, :3]), distance, rtol=1e-13)
    B = chart.basis(state)
    numeric = differences(chart, state, STEP * distance if chart.name == "closest_point" else STEP)
    np.testing.assert_allclose(B, numeric, atol=4e-11 * max(np.abs(B).max(), distance), rtol=0)


@pytest.mark.parametrize("chart", QUATERNIONS, ids=by_name)
def test_normals_of_far_planes_turn_more(chart):
    """The normal turns about sqrt(1 + r^2) / 2 times as fast as the quaternion: why the unit of length matters."""
    for distance in (1.0, 10.0, 100.0):
        state = chart.from_ambient(plane([0, 0, 1], -distance))
        moved = chart.retract(state, np.array([[1e-6, 0.0, 0.0]]))
        n = moved[0, :3] / np.linalg.norm(moved[0, :3])
        assert np.hypot(n[0], n[1]) == pytest.approx(0.5e-6 * np.hypot(1, distance), rel=1e-4)


def test_plane_at_infinity():
    ambient = plane([0, 0, 0], 2.0)
    for chart in CHARTS:
        if chart in QUATERNIONS:
            state = chart.from_ambient(ambient)
            np.testing.assert_array_equal(state, [[0, 0, 0, 1]])
            np.testing.assert_allclose(chart.basis(state), differences(chart, state), atol=4e-11)
        else:
            with pytest.raises(InputError, match=r"infinity|finite planes"):
                chart.from_ambient(ambient)


@pytest.mark.parametrize("chart", THROUGH_ORIGIN_TOO, ids=by_name)
@pytest.mark.parametrize("size", [1e-300, 1e-12, 1e-8, 1e-7, 1e-4, 1e-3])
def test_tiny_steps_keep_their_digits(chart, size):
    """An arc cosine would lose all digits at 1e-8; the relative error here is rounding of the state, 1e-16 / size."""
    state = chart.from_ambient(plane([0.3, -0.5, 0.1], 0.7))
    delta = size * np.array([[0.6, -0.3, 0.5]])
    found = chart.local(state, chart.retract(state, delta))
    np.testing.assert_allclose(found, delta, rtol=1e-12, atol=4e-16)


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_both_signs_are_one_plane(chart):
    state = chart.random(np.random.default_rng(7), 10)
    flipped = chart.from_ambient(-chart.ambient(state))
    np.testing.assert_allclose(chart.local(state, flipped), 0.0, atol=1e-14)


@pytest.mark.parametrize("chart", QUATERNIONS, ids=by_name)
def test_steps_up_to_half_a_turn_and_beyond(chart):
    state = chart.random(np.random.default_rng(8), 10)
    axis = np.array([0.6, 0.0, -0.8])
    for angle, expected in ((3.1, 3.1), (3.2, 3.2 - 2 * np.pi), (6.2, 6.2 - 2 * np.pi)):
        moved = chart.retract(state, np.tile(angle * axis, (10, 1)))
        np.testing.assert_allclose(chart.local(state, moved), np.tile(expected * axis, (10, 1)), atol=1e-13)


def test_opposite_normals_take_the_other_sign():
    """Beyond 2.2 radians (-n', -w') is the goal; at exactly opposite normals that is no turn at all."""
    chart = PLANE_CHARTS["normal_offset"]
    state = chart.from_ambient(plane([0, 0.6, 0.8], 0.5))
    found = chart.local(state, chart.retract(state, np.array([[2.2, 0, 0]])))
    np.testing.assert_allclose(found, [[2.2, 0, 0]], atol=1e-14)
    found = chart.local(state, chart.retract(state, np.array([[2.3, 0, 0]])))
    np.testing.assert_allclose(found, [[2.3 - np.pi, 0, -1.0]], atol=1e-14)
    np.testing.assert_allclose(chart.local(state, np.array([[0, -0.6, -0.8, 0.5]])), [[0, 0, -1.0]], atol=1e-15)


@pytest.mark.parametrize("chart", THROUGH_ORIGIN_TOO, ids=by_name)
def test_no_drift_after_many_steps(chart):
    rng = np.random.default_rng(9)
    state = chart.random(rng, 3)
    for delta in 0.3 * rng.normal(size=(1000, 3, 3)):
        state = chart.retract(state, delta)
    size = np.linalg.norm(state if chart in QUATERNIONS else state[:, :3], axis=1)
    np.testing.assert_allclose(size, 1.0, rtol=1e-14)
