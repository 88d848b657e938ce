# SPDX-License-Identifier: BSD-3-Clause
"""Unit quaternions: Hamilton product and matrices against SciPy, exp and log at 0 and pi, orders, kernels."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groma.errors import InputError, ShapeError
from groma.geometry import quaternion, so3

ANGLES = [0.0, 1e-300, 1e-160, 1e-12, 1e-7, 1e-6, 1e-4, 0.1, 1.0, 3.0, math.pi - 1e-9, math.pi - 1e-15]


def _random(seed: int, count: int = 20) -> np.ndarray:
    return quaternion.normalize(np.random.default_rng(seed).normal(size=(count, 4)))


def test_product_and_matrix_equal_scipy():
    first, second = _random(1), _random(2)
    expected = Rotation.from_quat(first) * Rotation.from_quat(second)
    product = quaternion.multiply(first, second)
    np.testing.assert_allclose(quaternion.to_matrix(product), expected.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(
        quaternion.to_matrix(product), quaternion.to_matrix(first) @ quaternion.to_matrix(second), atol=1e-15
    )
    identity = quaternion.multiply(first, quaternion.conjugate(first))
    np.testing.assert_allclose(identity, np.broadcast_to([0.0, 0, 0, 1], (20, 4)), atol=1e-15)


def test_rotate_equals_the_matrix_and_broadcasts():
    q, vector = _random(3), np.random.default_rng(3).normal(size=(20, 3))
    expected = (quaternion.to_matrix(q) @ vector[..., None])[..., 0]
    np.testing.assert_allclose(quaternion.rotate(q, vector), expected, atol=2e-15)
    np.testing.assert_allclose(quaternion.rotate(q[0], vector), vector @ quaternion.to_matrix(q[0]).T, atol=2e-15)
    assert quaternion.rotate(q[:, None], vector[None, :5]).shape == (20, 5, 3)


def test_from_matrix_is_right_in_all_four_branches():
    q = np.vstack(
        [_random(4, 100), np.eye(4), [[0.5, 0.5, 0.5, 0.5]], [[1e-9, 0.0, 0.0, 1.0]], [[0.0, 1.0, 1e-9, 0.0]]]
    )
    q = quaternion.normalize(q)
    assert set(np.argmax(np.abs(q), axis=1)) == {0, 1, 2, 3}
    found = quaternion.from_matrix(quaternion.to_matrix(q))
    assert (found[:, 3] >= 0).all()
    sign = np.sign(np.sum(found * q, axis=1, keepdims=True))
    np.testing.assert_allclose(sign * found, q, atol=1e-15)
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-15)


@pytest.mark.parametrize("theta", ANGLES)
def test_log_undoes_exp(theta):
    axis = np.random.default_rng(5).normal(size=(20, 3))
    omega = theta * axis / np.linalg.norm(axis, axis=1, keepdims=True)
    q = quaternion.exp(omega)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-15)
    np.testing.assert_allclose(quaternion.log(q), omega, rtol=0, atol=2e-15 * theta)
    np.testing.assert_allclose(quaternion.log(-q), omega, rtol=0, atol=2e-15 * theta)
    np.testing.assert_allclose(quaternion.to_matrix(q), so3.exp(omega), atol=1e-15)


def test_log_takes_the_shorter_way_round():
    long_way = quaternion.exp(np.array([0.0, 0.0, 2 * math.pi - 0.1]))
    np.testing.assert_allclose(quaternion.log(long_way), [0.0, 0.0, -0.1], atol=1e-15)
    np.testing.assert_allclose(np.abs(quaternion.log(np.array([0.0, 1.0, 0.0, 0.0]))), [0.0, math.pi, 0.0])


def test_orders():
    q = np.arange(8.0).reshape(2, 4)
    np.testing.assert_array_equal(quaternion.to_wxyz(q), [[3, 0, 1, 2], [7, 4, 5, 6]])
    np.testing.assert_array_equal(quaternion.from_wxyz(quaternion.to_wxyz(q)), q)


@pytest.mark.kernels
@pytest.mark.parametrize("theta", ANGLES)
def test_kernels_equal_the_batched_functions(theta):
    omega = theta * np.array([0.6, 0.0, -0.8])
    q, w, R, out = np.empty(4), np.empty(3), np.empty(9), np.empty(4)
    quaternion.exp_kernel(omega, q)
    np.testing.assert_allclose(q[:3], quaternion.exp(omega)[:3], rtol=1e-15)
    np.testing.assert_allclose(q[3], quaternion.exp(omega)[3], atol=4e-16)  # a cosine: absolute
    quaternion.log_kernel(-q, w)
    np.testing.assert_allclose(w, omega, rtol=0, atol=2e-15 * theta)
    quaternion.to_matrix_kernel(q, R)
    np.testing.assert_allclose(R.reshape(3, 3), quaternion.to_matrix(q), atol=1e-15)
    other = _random(6, 1)[0]
    quaternion.multiply_kernel(q, other, out)
    np.testing.assert_allclose(out, quaternion.multiply(q, other), atol=1e-15)


@pytest.mark.kernels
def test_log_kernel_is_finite_for_zeros():
    w = np.full(3, np.nan)
    quaternion.log_kernel(np.zeros(4), w)
    np.testing.assert_array_equal(w, 0.0)


def test_unusable_input_is_refused():
    with pytest.raises(InputError, match="must not be zero"):
        quaternion.normalize(np.zeros((2, 4)))
    with pytest.raises(ShapeError, match=r"order x, y, z, w; got \(3,\)"):
        quaternion.conjugate(np.zeros(3))
    with pytest.raises(ShapeError, match=r"\(\.\.\., 3\)"):
        quaternion.rotate(np.array([0.0, 0, 0, 1]), np.zeros(4))
