# SPDX-License-Identifier: BSD-3-Clause
"""Conversions between charts: the same object, the Jacobian of the increments, covariances there and back.

The Jacobians are compared with differences through retract and local, and with the closed form that joins the
orthonormal and the free-line charts.
"""

import itertools

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.geometry import quaternion
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.conversions import conversion_jacobian, convert, convert_covariance
from groma.geometry.manifold import Euclidean

pytestmark = pytest.mark.kernels

PAIRS = [
    pytest.param(source, target, id=f"{source.name}-{target.name}")
    for charts in (LINE_CHARTS, PLANE_CHARTS)
    for source, target in itertools.product(charts.values(), repeat=2)
]
H = 1e-3


def same_object(first, second, tolerance=1e-13):
    """Whether ambient rows agree up to scale."""
    first, second = (a / np.linalg.norm(a, axis=1, keepdims=True) for a in (first, second))
    second = second * np.sign(np.sum(first * second, axis=1, keepdims=True))
    np.testing.assert_allclose(first, second, atol=tolerance, rtol=0)


def numeric_jacobian(state, source, target):
    """Move in `source`, convert, and read the increment in `target`."""
    other = convert(state, source, target)
    out = np.empty((len(state), target.dof, source.dof))
    for k in range(source.dof):

        def at(h, k=k):
            delta = np.zeros((len(state), source.dof))
            delta[:, k] = h
            return target.local(other, convert(source.retract(state, delta), source, target))

        out[:, :, k] = (8 * (at(H) - at(-H)) - (at(2 * H) - at(-2 * H))) / (12 * H)
    return out


def random_covariance(rng, count, size):
    root = rng.normal(size=(count, size, size))
    return root @ np.swapaxes(root, 1, 2)


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_same_object(source, target):
    state = source.random(np.random.default_rng(1), 20)
    same_object(target.ambient(convert(state, source, target)), source.ambient(state))


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_jacobian_against_differences(source, target):
    state = source.random(np.random.default_rng(2), 20)
    J = conversion_jacobian(state, source, target)
    # Fourth-order differences: truncation near 1e-13 times the fifth derivative, which the closest point makes large.
    np.testing.assert_allclose(J, numeric_jacobian(state, source, target), atol=2e-9, rtol=1e-9)


@pytest.mark.parametrize(("source", "target"), PAIRS)
def test_covariance_there_and_back(source, target):
    rng = np.random.default_rng(3)
    # A state that came from the target chart: the closest point has no orientation to give back.
    other = target.random(rng, 20)
    state = convert(other, target, source)
    covariance = random_covariance(rng, 20, source.dof)
    other = convert(state, source, target)
    there = convert_covariance(covariance, state, source, target)
    np.testing.assert_array_equal(np.linalg.eigvalsh(there) > 0, True)
    back = convert_covariance(there, other, target, source)
    np.testing.assert_allclose(back, covariance, atol=1e-11, rtol=1e-11)


@pytest.mark.parametrize("name", ["cartesian", "normal_offset"])
def test_same_chart_is_the_identity(name):
    chart = {**LINE_CHARTS, **PLANE_CHARTS}[name]
    state = chart.random(np.random.default_rng(4), 5)
    J = conversion_jacobian(state, chart, chart)
    np.testing.assert_allclose(J, np.broadcast_to(np.eye(chart.dof), J.shape), atol=1e-14)


def test_orthonormal_and_free_line_are_one_chart():
    """R_WL = U Pi and d_L = cot(phi): right increments are related by Pi and -(1 + d_L^2), left ones by I."""
    rng = np.random.default_rng(5)
    Pi = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
    for side, rotation in (("right", Pi), ("left", np.eye(3))):
        source, target = LINE_CHARTS[f"orthonormal_{side}"], LINE_CHARTS[f"free_{side}"]
        state = source.random(rng, 20)
        free = convert(state, source, target)
        U, R = quaternion.to_matrix(state[:, :4]), quaternion.to_matrix(free[:, :4])
        np.testing.assert_allclose(R, U @ Pi, atol=1e-14)
        np.testing.assert_allclose(free[:, 4], 1 / np.tan(state[:, 4]), rtol=1e-13)
        expected = np.zeros((20, 4, 4))
        expected[:, :3, :3] = rotation
        expected[:, 3, 3] = -(1 + free[:, 4] ** 2)
        np.testing.assert_allclose(conversion_jacobian(state, source, target), expected, atol=1e-12)


@pytest.mark.parametrize("target", LINE_CHARTS.values(), ids=lambda chart: chart.name)
def test_far_lines_keep_their_digits(target):
    """At the distance r, J there times J back is the identity although its entries span r^2."""
    source = LINE_CHARTS["cartesian"]
    for distance in (1e3, 1e6, 1e12):
        p, d = np.array([distance, 0.3 * distance, 0.0]), np.array([0.1, -0.6, 0.8])
        state = source.from_ambient(np.hstack([np.cross(p, d), d])[None])
        other = convert(state, source, target)
        there = conversion_jacobian(state, source, target)[0]
        back = conversion_jacobian(other, target, source)[0]
        # beta in units of the distance, so that all numbers are angles
        scale = np.array([1.0, 1.0, distance, distance])
        np.testing.assert_allclose((back @ there) * scale / scale[:, None], np.eye(4), atol=1e-13)


@pytest.mark.parametrize("distance", [1e-9, 1e-6, 1e-3])
def test_lines_near_the_origin(distance):
    """The roll of a singular chart answers with 1 / distance, and comes back."""
    source, target = LINE_CHARTS["cartesian"], LINE_CHARTS["orthonormal_right"]
    state = source.from_ambient(np.array([[0.0, 0, -distance, 0, 1, 0]]))
    there = conversion_jacobian(state, source, target)[0]
    back = conversion_jacobian(convert(state, source, target), target, source)[0]
    assert np.abs(there).max() == pytest.approx(1 / distance, rel=1e-3)
    np.testing.assert_allclose(back @ there, np.eye(4), atol=1e-15 / distance + 1e-12)


def test_line_through_the_origin_loses_one_motion():
    """Into a singular chart the lost motion is dropped; out of it the covariance has rank 3. Nothing becomes NaN."""
    cartesian = LINE_CHARTS["cartesian"]
    ambient = np.array([[0.0, 0, 0, 0.3, -0.5, 0.1]])
    state = cartesian.from_ambient(ambient)
    for name, chart in LINE_CHARTS.items():
        there = conversion_jacobian(state, cartesian, chart)[0]
        back = conversion_jacobian(chart.from_ambient(ambient), chart, cartesian)[0]
        rank = 4 if name == "cartesian" else 3
        assert np.linalg.matrix_rank(there, 1e-9) == rank
        assert np.linalg.matrix_rank(back, 1e-9) == rank
        product = back @ there
        np.testing.assert_allclose(product @ product, product, atol=1e-13)  # a projection on what is left
        assert np.linalg.norm(there) < 10


def test_planes_through_the_origin():
    ambient = np.array([[0.3, -0.5, 0.1, 0.0]])
    for names in itertools.permutations(["quaternion_left", "quaternion_right", "normal_offset"], 2):
        source, target = (PLANE_CHARTS[name] for name in names)
        state = source.from_ambient(ambient)
        J = conversion_jacobian(state, source, target)
        np.testing.assert_allclose(J, numeric_jacobian(state, source, target), atol=2e-10)
    with pytest.raises(InputError, match="within 1e-9 of the origin"):
        convert(state, source, PLANE_CHARTS["closest_point"])


def test_covariance_predicts_the_scatter():
    """Linear propagation agrees with a sample of small random motions, within the error of the sample (4000 draws)."""
    rng = np.random.default_rng(6)
    source, target = LINE_CHARTS["cartesian"], LINE_CHARTS["free_left"]
    state = source.random(rng, 1)
    covariance = 1e-8 * random_covariance(rng, 1, 4)
    delta = rng.multivariate_normal(np.zeros(4), covariance[0], 4000)
    many = np.repeat(state, 4000, axis=0)
    start = np.repeat(convert(state, source, target), 4000, axis=0)
    found = np.cov(target.local(start, convert(source.retract(many, delta), source, target)).T)
    expected = convert_covariance(covariance, state, source, target)[0]
    root = np.linalg.inv(np.linalg.cholesky(expected))
    # Entries of a whitened sample covariance scatter by sqrt(2 / 4000) = 0.022; five of those.
    np.testing.assert_allclose(root @ found @ root.T, np.eye(4), atol=0.11)


def test_empty_batch():
    source, target = LINE_CHARTS["cartesian"], LINE_CHARTS["free_right"]
    nothing = np.zeros((0, 6))
    assert convert(nothing, source, target).shape == (0, 5)
    assert convert_covariance(np.zeros((0, 4, 4)), nothing, source, target).shape == (0, 4, 4)


def test_errors():
    line, plane = LINE_CHARTS["cartesian"], PLANE_CHARTS["normal_offset"]
    state = line.random(np.random.default_rng(7), 2)
    with pytest.raises(InputError, match="of the same kind"):
        convert(state, line, plane)
    with pytest.raises(InputError, match="kind 'point'"):
        convert(state, line, Euclidean(3, "point"))
    with pytest.raises(ShapeError, match=r"covariance must have shape \(2, 4, 4\)"):
        convert_covariance(np.eye(4), state, line, line)
