# SPDX-License-Identifier: BSD-3-Clause
"""Charts of lines: retract, local and basis in general position and at the degenerate places, and what cannot be held.

Degenerate places: through the origin (m = 0), at infinity (d = 0), far away and very near, d_L or phi passing through
zero, the opposite orientation, and drift of m.d after many steps.
"""

import numpy as np
import pytest
from _charts import by_name, differences

from groma.errors import InputError
from groma.geometry import quaternion
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.line_free import FreeLineRight
from groma.geometry.charts.line_orthonormal import OrthonormalLineLeft, OrthonormalLineRight

pytestmark = pytest.mark.kernels

CHARTS = list(LINE_CHARTS.values())
FINITE_ONLY = [chart for chart in CHARTS if not chart.name.startswith("orthonormal")]
SINGULAR = [chart for chart in CHARTS if chart.name != "cartesian"]


def line(point, direction):
    """Plücker line (1, 6) through a point."""
    return np.hstack([np.cross(point, direction), direction])[None].astype(float)


def same_oriented_line(first, second, tolerance=1e-12):
    """Whether Plücker lines (N, 6) agree up to a positive scale, as far as their distance from the origin allows."""
    first, second = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in (first, second))
    np.testing.assert_allclose(first, second, atol=tolerance, rtol=0)


def rank_modulo_scale(chart, state, tolerance=1e-9):
    """Singular values of the basis across the line's own direction."""
    a = chart.ambient(state)[0]
    a = a / np.linalg.norm(a)
    B = chart.basis(state)[0]
    values = np.linalg.svd(B - np.outer(a, a @ B), compute_uv=False)
    return int((values > tolerance * values[0]).sum()), values


# ------------------------------------------------------------------------------------------------- General position


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_retract_and_local_are_inverse(chart):
    rng = np.random.default_rng(2)
    state = chart.random(rng, 30)
    np.testing.assert_allclose(chart.retract(state, np.zeros((30, 4))), state, atol=1e-15)
    np.testing.assert_allclose(chart.local(state, state), 0.0, atol=1e-15)
    for size in (1e-9, 1e-3, 0.3, 0.9):
        delta = size * rng.uniform(-1, 1, (30, 4))
        moved = chart.retract(state, delta)
        np.testing.assert_allclose(chart.local(state, moved), delta, atol=4e-15, rtol=1e-12)
    other = chart.random(rng, 30)
    delta = chart.local(state, other)
    reached, wanted = chart.ambient(chart.retract(state, delta)), chart.ambient(other)
    if chart.name == "cartesian":  # the orientation nearer to that of `state` is the goal
        sign = np.sign(np.sum(state[:, 3:] * other[:, 3:], axis=1, keepdims=True))
        wanted = sign * wanted
    same_oriented_line(reached, wanted)


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_basis_is_the_derivative_of_the_ambient_numbers(chart):
    rng = np.random.default_rng(3)
    random = chart.random(rng, 20)
    steps = chart.retract(random, rng.normal(size=(20, 4)))  # also states that are not canonical
    for state in (random, steps):
        np.testing.assert_allclose(chart.basis(state), differences(chart, state), atol=2e-11, rtol=0)


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_ambient_is_a_plücker_line_and_round_trips(chart):
    rng = np.random.default_rng(4)
    p, d = rng.normal(size=(2, 20, 3))
    scale = 10 ** rng.uniform(-6, 6, (20, 1))
    plücker = scale * np.hstack([np.cross(p, d), d])
    before = plücker.copy()
    a = chart.ambient(chart.from_ambient(plücker))
    assert np.array_equal(plücker, before)
    same_oriented_line(a, plücker)
    np.testing.assert_allclose(np.sum(a[:, :3] * a[:, 3:], axis=1), 0.0, atol=1e-15)
    norm = np.linalg.norm(a, axis=1) if chart.name.startswith("orthonormal") else np.linalg.norm(a[:, 3:], axis=1)
    np.testing.assert_allclose(norm, 1.0, rtol=1e-14)


def test_cartesian_retract_turns_and_shifts():
    """The foot point shifts by beta and the direction turns by atan(alpha) as the formula says."""
    chart = LINE_CHARTS["cartesian"]
    state = chart.random(np.random.default_rng(5), 10)
    d, p = state[:, 3:], np.cross(state[:, 3:], state[:, :3])
    moved = chart.retract(state, np.tile([0.3, -0.4, 0.0, 0.0], (10, 1)))
    np.testing.assert_allclose(np.sum(moved[:, 3:] * d, axis=1), np.cos(np.arctan(0.5)), rtol=1e-14)
    np.testing.assert_allclose(np.cross(p, moved[:, 3:]), moved[:, :3], atol=1e-14)  # still through p
    shifted = chart.retract(state, np.tile([0.0, 0.0, 3.0, 4.0], (10, 1)))
    np.testing.assert_allclose(shifted[:, 3:], d, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(np.cross(d, shifted[:, :3]) - p, axis=1), 5.0, rtol=1e-13)


def test_left_and_right_forms_are_one_rotation_apart():
    """B_left = B_right blkdiag(U^T, 1), and retractions of U theta (left) and theta (right) agree."""
    rng = np.random.default_rng(6)
    for name in ("orthonormal", "free"):
        right, left = LINE_CHARTS[f"{name}_right"], LINE_CHARTS[f"{name}_left"]
        state = right.random(rng, 10)
        U = quaternion.to_matrix(state[:, :4])
        expected = right.basis(state)
        expected[:, :, :3] = expected[:, :, :3] @ np.swapaxes(U, 1, 2)
        np.testing.assert_allclose(left.basis(state), expected, atol=1e-15)
        delta = rng.normal(size=(10, 4))
        turned = np.hstack([(U @ delta[:, :3, None])[:, :, 0], delta[:, 3:]])
        same_oriented_line(left.ambient(left.retract(state, turned)), right.ambient(right.retract(state, delta)))


# ------------------------------------------------------------------------------------------- Through the origin (m = 0)
THROUGH_ORIGIN = [
    np.array([[0.0, 0.0, 0.0, *d]]) for d in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -2], [0.3, -0.5, 0.1])
]


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
@pytest.mark.parametrize("ambient", THROUGH_ORIGIN, ids=str)
def test_line_through_the_origin_has_a_state(chart, ambient):
    state = chart.from_ambient(ambient)
    assert np.array_equal(state, chart.from_ambient(ambient))
    same_oriented_line(chart.ambient(state), ambient, 1e-15)
    np.testing.assert_allclose(chart.basis(state), differences(chart, state), atol=2e-11, rtol=0)
    delta = np.array([[0.1, -0.2, 0.3, -0.15]])
    np.testing.assert_allclose(chart.local(state, chart.retract(state, delta)), delta, atol=1e-14)


@pytest.mark.parametrize("ambient", THROUGH_ORIGIN, ids=str)
def test_rank_at_the_origin(ambient):
    """Rank 4 and condition 1 for the Cartesian chart; the others lose one motion."""
    chart = LINE_CHARTS["cartesian"]
    rank, values = rank_modulo_scale(chart, chart.from_ambient(ambient))
    assert rank == 4
    assert values[0] / values[-1] == pytest.approx(1.0, abs=1e-12)
    for chart in SINGULAR:
        rank, values = rank_modulo_scale(chart, chart.from_ambient(ambient))
        assert rank == 3, chart
        assert values[-1] < 1e-15
    right = LINE_CHARTS["orthonormal_right"]
    assert np.abs(right.basis(right.from_ambient(ambient))[0, :, 1]).max() < 1e-15


@pytest.mark.parametrize("distance", [1e-12, 1e-6, 1e-3])
def test_near_the_origin(distance):
    ambient = line([distance, 0, 0], [0.0, 0.6, 0.8])
    for chart in CHARTS:
        state = chart.from_ambient(ambient)
        same_oriented_line(chart.ambient(state), ambient, 1e-15)
        np.testing.assert_allclose(chart.basis(state), differences(chart, state), atol=2e-11, rtol=0)
    chart = LINE_CHARTS["cartesian"]
    rank, values = rank_modulo_scale(chart, chart.from_ambient(ambient))
    assert rank == 4
    assert values[0] / values[-1] < 1.01


@pytest.mark.parametrize("chart", [LINE_CHARTS["free_right"], LINE_CHARTS["free_left"]], ids=by_name)
def test_distance_passes_through_zero(chart):
    state = chart.from_ambient(line([0, 0.2, 0], [1.0, 0, 0]))
    moved = chart.retract(state, np.array([[0.0, 0.0, 0.0, -0.5]]))
    assert moved[0, 4] == pytest.approx(-0.3)
    # the line crossed the origin: its foot point is on the other side
    same_oriented_line(chart.ambient(moved), line([0, -0.3, 0], [1.0, 0, 0]))
    fixed = chart.canonical(moved)
    assert fixed[0, 4] == pytest.approx(0.3)
    same_oriented_line(chart.ambient(fixed), chart.ambient(moved))
    np.testing.assert_allclose(chart.local(moved, fixed), 0.0, atol=1e-14)
    np.testing.assert_allclose(chart.local(state, fixed), [[0, 0, 0, -0.5]], atol=1e-14)
    delta = np.array([[0.2, -0.1, 0.3, -0.4]])  # across zero with a turn, then stored in the other form
    np.testing.assert_allclose(chart.local(state, chart.canonical(chart.retract(state, delta))), delta, atol=1e-14)
    assert isinstance(chart, FreeLineRight)
    np.testing.assert_array_equal(chart.canonical(state), state)


@pytest.mark.parametrize("chart", [OrthonormalLineRight(), OrthonormalLineLeft()], ids=by_name)
@pytest.mark.parametrize("step", [-2.9, -1.4, -0.9, 0.2, 1.3, 2.2, 3.0])
def test_angle_leaves_its_quadrant(chart, step):
    state = chart.random(np.random.default_rng(7), 10)
    moved = chart.retract(state, np.tile([0.1, 0.2, -0.1, step], (10, 1)))
    np.testing.assert_allclose(moved[:, 4], state[:, 4] + step)
    fixed = chart.canonical(moved)
    assert ((fixed[:, 4] >= 0) & (fixed[:, 4] <= np.pi / 2)).all()
    same_oriented_line(chart.ambient(fixed), chart.ambient(moved))
    np.testing.assert_allclose(chart.local(moved, fixed), 0.0, atol=4e-14)
    again = chart.from_ambient(chart.ambient(moved))
    np.testing.assert_allclose(chart.local(fixed, again), 0.0, atol=4e-14)


# -------------------------------------------------------------------------------------------- Far away, and at infinity
@pytest.mark.parametrize("distance", [1e3, 1e6, 1e12])
@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_far_lines(chart, distance):
    ambient = line([distance, 0.5 * distance, 0], [0.1, -0.6, 0.8])
    state = chart.from_ambient(ambient)
    assert np.isfinite(state).all()
    a = chart.ambient(state)
    direction, foot = a[0, 3:], np.cross(a[0, 3:], a[0, :3]) / (a[0, 3:] @ a[0, 3:])
    unit = ambient[0, 3:] / np.linalg.norm(ambient[0, 3:])
    # The orthonormal chart holds the direction with the weight 1/distance; it is not lost, only small.
    np.testing.assert_allclose(direction / np.linalg.norm(direction), unit, atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(foot), np.linalg.norm(np.cross([1, 0.5, 0], unit)) * distance, rtol=1e-12)
    B, numeric = chart.basis(state), differences(chart, state)
    np.testing.assert_allclose(B, numeric, atol=2e-11 * np.abs(B).max(), rtol=0)


def test_orthonormal_chart_far_away_has_uneven_columns():
    """With w2 = 1/distance the first column of the right form shrinks: what rescaling the scene is for."""
    chart = LINE_CHARTS["orthonormal_right"]
    B = chart.basis(chart.from_ambient(line([1e6, 0, 0], [0.0, 0, 1])))[0]
    assert np.linalg.norm(B[:, 0]) == pytest.approx(1e-6)
    assert np.linalg.norm(B[:, 1]) == pytest.approx(1.0)


def test_line_at_infinity():
    ambient = np.array([[0.0, 2.0, 0.0, 0.0, 0.0, 0.0]])
    for name in ("orthonormal_right", "orthonormal_left"):
        chart = LINE_CHARTS[name]
        state = chart.from_ambient(ambient)
        assert state[0, 4] == 0.0
        same_oriented_line(chart.ambient(state), ambient)
        assert rank_modulo_scale(chart, state)[0] == 3
    for chart in FINITE_ONLY:
        with pytest.raises(InputError, match=r"finite lines.*row 0.*orthonormal_right"):
            chart.from_ambient(ambient)


# ------------------------------------------------------------------------------------------------ Orientation and drift
def test_opposite_orientation():
    """(-m, -d) is the same line: Cartesian increments treat it so; the other charts keep the orientation."""
    ambient = line([1.0, 2, 3], [0.5, -1, 0.25])
    for chart in CHARTS:
        state, flipped = chart.from_ambient(ambient), chart.from_ambient(-ambient)
        same_oriented_line(chart.ambient(flipped), -ambient)
        delta = chart.local(state, flipped)
        reached = chart.ambient(chart.retract(state, delta))
        if chart.name == "cartesian":
            np.testing.assert_allclose(delta, 0.0, atol=1e-14)
        else:
            assert np.linalg.norm(delta) > 1.0
            same_oriented_line(reached, -ambient)


def test_perpendicular_lines_are_out_of_reach_but_finite():
    chart = LINE_CHARTS["cartesian"]
    first, second = chart.from_ambient(line([1, 0, 0], [0.0, 0, 1])), chart.from_ambient(line([0, 0, 1], [1.0, 0, 0]))
    assert np.isfinite(chart.local(first, second)).all()


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_no_drift_after_many_steps(chart):
    rng = np.random.default_rng(8)
    state = chart.random(rng, 3)
    for delta in 0.3 * rng.normal(size=(1000, 3, 4)):
        state = chart.retract(state, delta)
    a = chart.ambient(state)
    distance = np.maximum(np.linalg.norm(a[:, :3], axis=1), 1.0)
    assert (np.abs(np.sum(a[:, :3] * a[:, 3:], axis=1)) < 1e-12 * distance).all()
    norm = np.linalg.norm(a, axis=1) if chart.name.startswith("orthonormal") else np.linalg.norm(a[:, 3:], axis=1)
    np.testing.assert_allclose(norm, 1.0, rtol=1e-13)
    if chart.state_size == 5:
        np.testing.assert_allclose(np.linalg.norm(state[:, :4], axis=1), 1.0, rtol=1e-14)


@pytest.mark.parametrize("chart", CHARTS, ids=by_name)
def test_moment_not_orthogonal_to_direction(chart):
    """The part of m along d is dropped; the line that is left has d and the foot point d x m / d.d."""
    ambient = line([1.0, 2, 3], [0.5, -1, 0.25])
    spoilt = ambient.copy()
    spoilt[0, :3] += 0.1 * ambient[0, 3:]
    same_oriented_line(chart.ambient(chart.from_ambient(spoilt)), ambient)
    # However little moment is left, the direction is kept.
    d = ambient[0, 3:]
    for size in (1e-9, 1e-13, 1e-15):
        a = chart.ambient(chart.from_ambient(np.hstack([d + size * np.array([2.0, 1, 0]), d])[None]))[0]
        np.testing.assert_allclose(np.cross(a[3:] / np.linalg.norm(a[3:]), d), 0.0, atol=1e-15)
    # A moment along d is no moment at all, up to rounding.
    d = np.array([0.3, -0.5, 0.1])
    a = chart.ambient(chart.from_ambient(np.hstack([d, d])[None]))
    np.testing.assert_allclose(a[0, :3], 0.0, atol=1e-15)
    assert abs(a[0, :3] @ a[0, 3:]) < 1e-16


@pytest.mark.parametrize("chart", SINGULAR, ids=by_name)
def test_retract_restores_a_unit_quaternion(chart):
    state = chart.random(np.random.default_rng(11), 5)
    spoilt = state * [1 + 1e-6, 1 + 1e-6, 1 + 1e-6, 1 + 1e-6, 1]
    np.testing.assert_allclose(chart.retract(spoilt, np.zeros((5, 4))), state, rtol=1e-14, atol=1e-16)
