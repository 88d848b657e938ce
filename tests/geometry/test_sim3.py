# SPDX-License-Identifier: BSD-3-Clause
"""Sim(3): exp against the matrix exponential in all corners of (angle, log scale), log, adjoint, Jacobians."""

import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm

from groma.errors import InputError, ShapeError
from groma.geometry import se3, sim3, transform

ANGLES = [0.0, 1e-300, 1e-9, 1e-4, 0.1, 2.0, math.pi - 1e-9]
SIGMAS = [0.0, 1e-300, 1e-9, -1e-4, 0.1, -2.0, 4.0]
CORNERS = [(theta, sigma) for theta in ANGLES for sigma in SIGMAS]


def _tangents(theta: float, sigma: float, count: int = 6, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    omega = rng.normal(size=(count, 3))
    omega *= theta / np.linalg.norm(omega, axis=1, keepdims=True)
    return np.hstack([rng.normal(size=(count, 3)), omega, np.full((count, 1), sigma)])


def _small_adjoint(zeta: np.ndarray) -> np.ndarray:
    """Columns are the brackets [zeta, e_k] of the 4x4 matrices."""
    M = sim3.hat(zeta)
    basis = sim3.hat(np.eye(7))
    return sim3.vee(M @ basis - basis @ M).T


@pytest.mark.parametrize(("theta", "sigma"), CORNERS)
def test_exp_equals_the_matrix_exponential(theta, sigma):
    zeta = _tangents(theta, sigma)
    expected = expm(sim3.hat(zeta))
    found = sim3.to_matrix(sim3.exp(zeta))
    # The reference is the weaker side: expm of a multiple of the identity is off by 5e-13 of exp(4).
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 * max(1.0, math.exp(sigma)))


def _exact_mean(theta: float, sigma: float) -> complex:
    """(exp(z) - 1) / z = sum of z^k / (k + 1)! for z = sigma + i theta, by rational arithmetic."""
    x, y = Fraction(sigma), Fraction(theta)
    real, imaginary, total = Fraction(1), Fraction(0), [Fraction(0), Fraction(0)]
    for k in range(50):
        total[0] += real / math.factorial(k + 1)
        total[1] += imaginary / math.factorial(k + 1)
        real, imaginary = real * x - imaginary * y, real * y + imaginary * x
    return complex(float(total[0]), float(total[1]))


@pytest.mark.parametrize(("theta", "sigma"), CORNERS)
def test_translation_keeps_all_digits(theta, sigma):
    across = _exact_mean(theta, sigma) * complex(1.0, 2.0)
    along = 3.0 * _exact_mean(0.0, sigma).real
    found = sim3.exp(np.array([1.0, 2.0, 3.0, 0.0, 0.0, theta, sigma]))[4:7]
    np.testing.assert_allclose(found, [across.real, across.imag, along], rtol=0, atol=2e-15 * max(1.0, abs(along)))


@pytest.mark.parametrize("sigma", [-40.0, 40.0])
def test_exp_holds_for_extreme_scales(sigma):
    zeta = np.array([1.0, 2.0, 3.0, 0.0, 0.0, math.pi, sigma])
    z = complex(sigma, math.pi)
    growth, turn = math.expm1(sigma) / sigma, (np.exp(z) - 1) / z  # closed form, without loss for large sigma
    across = turn * complex(1.0, 2.0)
    np.testing.assert_allclose(sim3.exp(zeta)[4:7], [across.real, across.imag, 3 * growth], rtol=2e-14)


@pytest.mark.parametrize(("theta", "sigma"), CORNERS)
def test_log_undoes_exp(theta, sigma):
    zeta = _tangents(theta, sigma)
    found = sim3.log(sim3.exp(zeta))
    np.testing.assert_allclose(found[:, :3], zeta[:, :3], atol=5e-14)
    np.testing.assert_allclose(found[:, 3:6], zeta[:, 3:6], rtol=0, atol=3e-15 * theta)
    np.testing.assert_allclose(found[:, 6], zeta[:, 6], atol=2e-15)


def test_without_scale_it_is_se3():
    zeta = _tangents(1.3, 0.0)
    pose = se3.exp(zeta[:, :6])
    np.testing.assert_allclose(sim3.exp(zeta)[:, :7], pose, atol=2e-15)
    np.testing.assert_allclose(sim3.left_jacobian(zeta)[:, :6, :6], se3.left_jacobian(zeta[:, :6]), atol=5e-15)


def test_group():
    first, second = sim3.exp(_tangents(0.4, 0.7)), sim3.exp(_tangents(2.0, -1.0, seed=2))
    A, B = sim3.to_matrix(first), sim3.to_matrix(second)
    np.testing.assert_allclose(sim3.to_matrix(sim3.compose(first, second)), A @ B, atol=1e-14)
    np.testing.assert_allclose(sim3.to_matrix(sim3.inverse(first)) @ A, np.tile(np.eye(4), (6, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(sim3.to_matrix(sim3.from_matrix(A)), A, atol=1e-14)
    points = np.random.default_rng(3).normal(size=(6, 3))
    expected = (A[:, :3, :3] @ points[..., None])[..., 0] + A[:, :3, 3]
    np.testing.assert_allclose(sim3.apply(first, points), expected, atol=1e-14)
    np.testing.assert_allclose(sim3.compose(sim3.identity(), second)[:, 4:], second[:, 4:], atol=1e-15)


def test_adjoint_moves_an_increment_across():
    S, zeta = sim3.exp(_tangents(2.0, 0.5)), _tangents(0.7, -0.3, seed=2)
    left = sim3.compose(S, sim3.exp(zeta))
    right = sim3.compose(sim3.exp((sim3.adjoint(S) @ zeta[..., None])[..., 0]), S)
    np.testing.assert_allclose(sim3.to_matrix(left), sim3.to_matrix(right), atol=3e-14)


@pytest.mark.parametrize(("theta", "sigma"), CORNERS)
def test_jacobians(theta, sigma):
    zeta = _tangents(theta, sigma)
    J, size = sim3.left_jacobian(zeta), max(1.0, math.exp(sigma))
    for row, found in zip(zeta, J, strict=True):
        block = np.zeros((14, 14))
        block[:7, :7], block[:7, 7:] = _small_adjoint(row), np.eye(7)
        np.testing.assert_allclose(found, expm(block)[:7, 7:], rtol=0, atol=2e-13 * size)  # accuracy of expm
    identity = np.broadcast_to(np.eye(7), J.shape)
    np.testing.assert_allclose(J @ sim3.left_jacobian_inverse(zeta), identity, atol=1e-12 * size)
    np.testing.assert_allclose(sim3.adjoint(sim3.exp(zeta)) @ sim3.right_jacobian(zeta), J, atol=2e-13 * size)
    right = sim3.right_jacobian(zeta) @ sim3.right_jacobian_inverse(zeta)
    np.testing.assert_allclose(right, identity, atol=1e-12 * size)


def test_left_jacobian_is_the_derivative_of_exp():
    zeta, h = _tangents(1.2, 0.4), 1e-3
    here, J = sim3.inverse(sim3.exp(zeta)), sim3.left_jacobian(zeta)
    for k in range(7):
        value = {j: sim3.log(sim3.compose(sim3.exp(zeta + j * h * np.eye(7)[k]), here)) for j in (-2, -1, 1, 2)}
        numeric = (8 * (value[1] - value[-1]) - (value[2] - value[-2])) / (12 * h)
        np.testing.assert_allclose(J[:, :, k], numeric, atol=1e-11)


@pytest.mark.parametrize("batch", [(), (0,), (4,), (2, 3)])
def test_any_batch_shape(batch):
    zeta = np.random.default_rng(4).normal(size=(*batch, 7))
    S = sim3.exp(zeta)
    assert S.shape == (*batch, 8)
    assert sim3.log(S).shape == (*batch, 7)
    assert sim3.adjoint(S).shape == sim3.left_jacobian(zeta).shape == (*batch, 7, 7)
    np.testing.assert_allclose(sim3.vee(sim3.hat(zeta)), zeta, atol=1e-15)


def test_unusable_input_is_refused():
    with pytest.raises(InputError, match="must be positive; got -1"):
        sim3.inverse(np.array([0.0, 0, 0, 1, 0, 0, 0, -1]))
    with pytest.raises(InputError, match="mirrored"):
        sim3.from_matrix(np.diag([1.0, 1, -1, 1]))
    with pytest.raises(ShapeError, match="Append a scale of 1"):
        sim3.inverse(se3.identity())
    with pytest.raises(ShapeError, match=r"\(\.\.\., 7\)"):
        sim3.exp(np.zeros(6))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)
def test_parts_and_back(batch):
    """Of any shape; every function that moves by a similarity takes the same array."""
    rng = np.random.default_rng(1)
    S = sim3.exp(rng.normal(size=(*batch, 7)))
    scale, rotation, translation = sim3.to_parts(S)
    assert scale.shape == batch and rotation.shape == (*batch, 3, 3) and translation.shape == (*batch, 3)
    np.testing.assert_allclose(
        sim3.to_matrix(sim3.from_parts(scale, rotation, translation)), sim3.to_matrix(S), atol=1e-14
    )
    points = rng.normal(size=(*batch, 3))
    np.testing.assert_allclose(transform.similarity_points(S, points), sim3.apply(S, points), atol=1e-13)


def test_parts_broadcast_and_are_checked():
    assert sim3.from_parts(2.0, np.eye(3), np.zeros((5, 3))).shape == (5, 8)
    assert sim3.from_parts(np.ones(4), np.eye(3), np.zeros(3)).shape == (4, 8)
    with pytest.raises(ShapeError, match=r"rotation must have shape \(\.\.\., 3, 3\)"):
        sim3.from_parts(1.0, np.eye(4), np.zeros(3))
    with pytest.raises(InputError, match="positive"):
        sim3.from_parts(0.0, np.eye(3), np.zeros(3))
    with pytest.raises(ShapeError, match="got a tuple"):
        sim3.inverse((1.0, np.eye(3), np.zeros(3)))
