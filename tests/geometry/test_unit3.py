# SPDX-License-Identifier: BSD-3-Clause
"""Unit vectors: great circles, the logarithm at equal and opposite vectors, the tangent basis, the direction chart."""

import math

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.geometry.charts import unit3


def _directions(seed: int = 1, count: int = 30) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    vectors = np.vstack([vectors, np.eye(3), -np.eye(3), [[0.6, 0.8, 1e-17]], [[0.6, 0.8, -1e-17]], [[1e-9, 0, -1.0]]])
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_tangent_basis_is_orthonormal_and_right_handed():
    u = _directions()
    basis = np.concatenate([unit3.tangent_basis(u), u[:, None]], axis=1)
    np.testing.assert_allclose(basis @ np.swapaxes(basis, 1, 2), np.broadcast_to(np.eye(3), basis.shape), atol=3e-16)
    np.testing.assert_allclose(np.linalg.det(basis), 1.0, atol=1e-15)


def test_tangent_basis_is_continuous_on_each_half():
    u = _directions(2)
    u = u[np.abs(u[:, 2]) > 0.1]
    near = u + 1e-7 * np.random.default_rng(3).normal(size=u.shape)
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    assert np.abs(unit3.tangent_basis(near) - unit3.tangent_basis(u)).max() < 1e-5


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-6, 0.1, 1.5, 3.0, math.pi - 1e-6])
def test_log_undoes_exp(angle):
    u = _directions()
    tangent = angle * unit3.tangent_basis(u)[:, 1]
    moved = unit3.exp(u, tangent)
    np.testing.assert_allclose(np.linalg.norm(moved, axis=1), 1.0, atol=5e-16)
    np.testing.assert_allclose(np.sum(moved * u, axis=1), math.cos(angle), atol=5e-16)
    # The direction of the tangent comes from a vector of length sin(angle), with rounding errors of 1e-16 each.
    expected_error = 1e-15 * max(1.0, angle / max(math.sin(angle), 1e-3 if angle < 1 else 0.0))
    np.testing.assert_allclose(unit3.log(u, moved), tangent, atol=expected_error)


def test_log_of_opposite_vectors_has_length_pi():
    u = _directions()
    found = unit3.log(u, -u)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), math.pi, atol=1e-14)
    np.testing.assert_allclose(np.sum(found * u, axis=1), 0.0, atol=1e-15)


@pytest.mark.kernels
def test_chart_moves_along_great_circles():
    u = _directions()
    delta = np.random.default_rng(4).uniform(-1, 1, (len(u), 2))
    chart = unit3.Unit3()
    tangent = np.einsum("nk,nkj->nj", delta, unit3.tangent_basis(u))
    np.testing.assert_allclose(chart.retract(u, delta), unit3.exp(u, tangent), atol=5e-16)


@pytest.mark.kernels
def test_many_steps_keep_the_length():
    chart, rng = unit3.Unit3(), np.random.default_rng(5)
    u = chart.random(rng, 5)
    for _ in range(100):
        u = chart.retract(u, rng.normal(size=(5, 2)))
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, atol=3e-16)


@pytest.mark.parametrize("batch", [(), (0,), (4,), (2, 3)])
def test_any_batch_shape(batch):
    u = np.random.default_rng(6).normal(size=(*batch, 3))
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    assert unit3.tangent_basis(u).shape == (*batch, 2, 3)
    assert unit3.log(u, u).shape == unit3.exp(u, np.zeros_like(u)).shape == (*batch, 3)


def test_unusable_input_is_refused():
    chart = unit3.Unit3()
    for bad in (0.0, np.nan, np.inf):
        with pytest.raises(InputError, match="finite vector that is not zero"):
            chart.from_ambient(np.full((1, 3), bad))
    with pytest.raises(ShapeError, match=r"delta must have shape \(N, 2\); got \(1, 3\)"):
        chart.retract(np.array([[0.0, 0, 1]]), np.zeros((1, 3)))
    with pytest.raises(ShapeError, match="as many rows"):
        chart.retract(np.array([[0.0, 0, 1]]), np.zeros((2, 2)))
    with pytest.raises(ShapeError, match=r"\(\.\.\., 3\)"):
        unit3.tangent_basis(np.zeros(2))
