# SPDX-License-Identifier: BSD-3-Clause
"""SO(3): coefficients against exact series, exp and log against SciPy at all magnitudes, Jacobians, kernels."""

import math
from fractions import Fraction

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from groma.errors import ShapeError
from groma.geometry import so3

ANGLES = [0.0, 1e-300, 1e-12, 1e-8, 1e-5, 1e-4, 1e-3, 1e-2, 0.1, 0.5, 1.0, 1.99, 2.0, 2.01, 3.0]
NEAR_PI = [math.pi - gap for gap in (1e-3, 1e-6, 1e-9, 1e-12)]


def _axes(count: int = 12) -> np.ndarray:
    axes = np.random.default_rng(1).normal(size=(count, 3))
    axes = np.vstack([axes, np.eye(3), -np.eye(3), [[1.0, 1.0, 0.0]]])
    return axes / np.linalg.norm(axes, axis=1, keepdims=True)


def _exact_coefficients(theta2: float) -> list[float]:
    """A to E by rational arithmetic: sum of (-x)^k / (2k + n)! for n = 1 .. 5."""
    x = Fraction(theta2)
    return [float(sum((-x) ** k / math.factorial(2 * k + n) for k in range(40))) for n in range(1, 6)]


@pytest.mark.parametrize("theta", [*ANGLES, *NEAR_PI])
def test_coefficients_keep_all_digits(theta):
    theta2 = theta * theta
    found = np.array(so3.coefficients(np.array(theta2)))
    # A is zero at pi, where the rounding of the angle itself is what counts; B to E are of the order of 1/n!.
    np.testing.assert_allclose(found[0], _exact_coefficients(theta2)[0], rtol=4e-16, atol=4e-16)
    np.testing.assert_allclose(found[1:], _exact_coefficients(theta2)[1:], rtol=5e-15)


@pytest.mark.kernels
@pytest.mark.parametrize("theta", [*ANGLES, *NEAR_PI, 5.0])
def test_coefficients_kernel_equals_the_batched_function(theta):
    expected = np.array(so3.coefficients(np.array(theta * theta)))[:4]
    np.testing.assert_allclose(so3.coefficients_kernel(theta * theta), expected, rtol=1e-14, atol=1e-16)


@pytest.mark.parametrize("theta", [*ANGLES, *NEAR_PI, math.pi, 5.0])
def test_exp_equals_scipy(theta):
    omega = theta * _axes()
    np.testing.assert_allclose(so3.exp(omega), Rotation.from_rotvec(omega).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(so3.exp(omega), expm(so3.hat(omega)), atol=5e-14)


@pytest.mark.parametrize("theta", [*ANGLES, *NEAR_PI])
def test_log_undoes_exp(theta):
    omega = theta * _axes()
    # Relative in the size of the vector: digits survive at 1e-12 as well as at 1 rad. Within gap of pi the sign of the
    # axis is still decided, because the quaternion's scalar part gap/2 is far above its rounding.
    np.testing.assert_allclose(so3.log(so3.exp(omega)), omega, rtol=0, atol=4e-15 * theta)


def test_log_at_pi_is_one_of_the_two_axes():
    omega = math.pi * _axes()
    found = so3.log(so3.exp(omega))
    sign = np.sign(np.sum(found * omega, axis=1, keepdims=True))
    np.testing.assert_allclose(sign * found, omega, atol=1e-14)


def test_log_of_slightly_wrong_rotations_is_finite():
    noisy = so3.exp(math.pi * _axes()) + 1e-12 * np.random.default_rng(2).normal(size=(19, 3, 3))
    assert np.isfinite(so3.log(noisy)).all()
    assert np.isfinite(so3.log(np.eye(3) * (1 + 1e-12))).all()


@pytest.mark.parametrize("theta", [0.0, 1e-9, 1e-5, 1e-2, 1.0, 2.5, math.pi])
def test_left_jacobian_is_the_derivative_of_exp(theta):
    omega, h = theta * _axes(), 1e-3
    J = so3.left_jacobian(omega)
    for k in range(3):
        step = h * np.eye(3)[k]

        def moved(factor, step=step):
            return so3.log(so3.exp(omega + factor * step) @ so3.inverse(so3.exp(omega)))

        numeric = (8 * (moved(1) - moved(-1)) - (moved(2) - moved(-2))) / (12 * h)
        np.testing.assert_allclose(J[:, :, k], numeric, atol=2e-12)  # truncation h^4 / 30 times a fifth derivative


@pytest.mark.parametrize("theta", [*ANGLES, *NEAR_PI, math.pi])
def test_jacobian_identities(theta):
    omega = theta * _axes()
    J, identity = so3.left_jacobian(omega), np.broadcast_to(np.eye(3), (19, 3, 3))
    np.testing.assert_allclose(J, so3.exp(omega) @ so3.right_jacobian(omega), atol=2e-15)
    np.testing.assert_allclose(J @ so3.left_jacobian_inverse(omega), identity, atol=4e-15)
    np.testing.assert_allclose(so3.right_jacobian(omega) @ so3.right_jacobian_inverse(omega), identity, atol=4e-15)


@pytest.mark.kernels
@pytest.mark.parametrize("theta", [0.0, 1e-9, 1e-4, 1e-2, 1.0, 2.5, math.pi])
def test_kernels_equal_the_batched_functions(theta):
    omega = theta * _axes(3)[0]
    R, J = np.empty(9), np.empty((3, 3))
    so3.exp_kernel(*omega, R)
    np.testing.assert_allclose(R.reshape(3, 3), so3.exp(omega), atol=1e-15)
    so3.left_jacobian_kernel(omega, J)
    np.testing.assert_allclose(J, so3.left_jacobian(omega), atol=1e-15)
    so3.left_jacobian_inverse_kernel(omega, J)
    np.testing.assert_allclose(J, so3.left_jacobian_inverse(omega), atol=1e-15)


def test_adjoint_and_hat():
    rng = np.random.default_rng(3)
    omega, vector, R = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), so3.exp(rng.normal(size=(5, 3)))
    left = so3.compose(R, so3.exp(omega))
    right = so3.exp((so3.adjoint(R) @ omega[..., None])[..., 0]) @ R
    np.testing.assert_allclose(left, right, atol=1e-14)
    np.testing.assert_array_equal(so3.vee(so3.hat(omega)), omega)
    np.testing.assert_allclose((so3.hat(omega) @ vector[..., None])[..., 0], np.cross(omega, vector), atol=1e-15)
    np.testing.assert_allclose(so3.rotate(R, vector), np.einsum("nij,nj->ni", R, vector), atol=1e-15)


@pytest.mark.parametrize("batch", [(), (0,), (4,), (2, 3)])
def test_any_batch_shape(batch):
    omega = np.random.default_rng(4).normal(size=(*batch, 3))
    for function in (so3.exp, so3.left_jacobian, so3.left_jacobian_inverse, so3.right_jacobian, so3.hat):
        assert function(omega).shape == (*batch, 3, 3)
    assert so3.log(so3.exp(omega)).shape == (*batch, 3)


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match=r"\(\.\.\., 3\); got \(2,\)"):
        so3.exp(np.zeros(2))
    with pytest.raises(ShapeError, match=r"\(\.\.\., 3, 3\)"):
        so3.vee(np.zeros((4, 3)))


def test_nearest_rotations():
    """No rotation nearby, nor the mirror image's, has a larger trace of R^T M; rotations stay as they are."""
    rng = np.random.default_rng(8)
    matrix = rng.normal(size=(20, 3, 3))
    found = so3.nearest(matrix)
    np.testing.assert_allclose(found @ np.swapaxes(found, 1, 2), np.tile(np.eye(3), (20, 1, 1)), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(found), 1.0, rtol=1e-14)
    trace = np.einsum("nij,nij->n", found, matrix)
    for other in Rotation.random(200, random_state=9).as_matrix():
        assert (np.einsum("ij,nij->n", other, matrix) <= trace).all()
    np.testing.assert_allclose(so3.nearest(found[0]), found[0], atol=1e-15)
