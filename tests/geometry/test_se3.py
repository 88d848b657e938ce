# SPDX-License-Identifier: BSD-3-Clause
"""SE(3): exp against the matrix exponential, log at all magnitudes, adjoint, the full Jacobians, kernels."""

import math

import numpy as np
import pytest
from scipy.linalg import expm

from groma.errors import ShapeError
from groma.geometry import se3

ANGLES = [0.0, 1e-300, 1e-12, 1e-6, 1e-4, 1e-2, 0.1, 1.0, 1.99, 2.01, 3.0, math.pi - 1e-9]


def _twists(theta: float, seed: int = 1, count: int = 12) -> np.ndarray:
    rng = np.random.default_rng(seed)
    omega = rng.normal(size=(count, 3))
    omega *= theta / np.linalg.norm(omega, axis=1, keepdims=True)
    return np.hstack([rng.normal(size=(count, 3)), omega])


def _small_adjoint(xi: np.ndarray) -> np.ndarray:
    """ad of a twist, (6, 6), written out independently of the library."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = np.cross(np.eye(3), xi[3:])  # row i is e_i x w, row i of w^
    out[:3, 3:] = np.cross(np.eye(3), xi[:3])
    return out


@pytest.mark.parametrize("theta", [*ANGLES, math.pi, 5.0])
def test_exp_equals_the_matrix_exponential(theta):
    xi = _twists(theta)
    np.testing.assert_allclose(se3.to_matrix(se3.exp(xi)), expm(se3.hat(xi)), atol=5e-14)  # accuracy of expm
    np.testing.assert_array_equal(se3.vee(se3.hat(xi)), xi)


@pytest.mark.parametrize("theta", ANGLES)
def test_log_undoes_exp(theta):
    xi = _twists(theta)
    found = se3.log(se3.exp(xi))
    np.testing.assert_allclose(found[:, :3], xi[:, :3], atol=1e-14)
    np.testing.assert_allclose(found[:, 3:], xi[:, 3:], rtol=0, atol=3e-15 * theta)


def test_log_at_pi_is_one_of_the_two_twists():
    pose = se3.exp(_twists(math.pi))
    np.testing.assert_allclose(se3.to_matrix(se3.exp(se3.log(pose))), se3.to_matrix(pose), atol=1e-14)


def test_group():
    first, second, third = (se3.exp(_twists(theta, seed)) for theta, seed in ((0.4, 1), (2.0, 2), (3.1, 3)))
    matrices = [se3.to_matrix(pose) for pose in (first, second, third)]
    np.testing.assert_allclose(se3.to_matrix(se3.compose(first, second)), matrices[0] @ matrices[1], atol=5e-15)
    np.testing.assert_allclose(
        se3.to_matrix(se3.inverse(third)) @ matrices[2], np.tile(np.eye(4), (12, 1, 1)), atol=5e-15
    )
    together = se3.compose(se3.compose(first, second), third)
    apart = se3.compose(first, se3.compose(second, third))
    np.testing.assert_allclose(se3.to_matrix(together), se3.to_matrix(apart), atol=1e-14)
    np.testing.assert_array_equal(se3.compose(se3.identity(), first)[:, 4:], first[:, 4:])
    back = se3.from_matrix(matrices[0])
    np.testing.assert_allclose(se3.to_matrix(back), matrices[0], atol=1e-15)
    np.testing.assert_allclose(se3.to_matrix(se3.from_matrix(matrices[0][:, :3])), matrices[0], atol=1e-15)


def test_transform_points_broadcasts():
    pose, points = se3.exp(_twists(1.0)), np.random.default_rng(4).normal(size=(5, 3))
    moved = se3.transform_points(pose[:, None], points)
    assert moved.shape == (12, 5, 3)
    T = se3.to_matrix(pose)
    np.testing.assert_allclose(moved, points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3], atol=5e-15)


def test_adjoint_moves_an_increment_across():
    pose, xi = se3.exp(_twists(2.0, 5)), _twists(0.7, 6)
    left = se3.compose(pose, se3.exp(xi))
    right = se3.compose(se3.exp((se3.adjoint(pose) @ xi[..., None])[..., 0]), pose)
    np.testing.assert_allclose(se3.to_matrix(left), se3.to_matrix(right), atol=2e-14)
    np.testing.assert_allclose(se3.adjoint(se3.exp(xi)), np.stack([expm(_small_adjoint(x)) for x in xi]), atol=1e-13)


@pytest.mark.parametrize("theta", ANGLES)
def test_left_jacobian_equals_the_series_of_ad(theta):
    # phi1(M) = sum M^k / (k+1)! is the upper right block of exp([[M, I], [0, 0]]).
    for xi, J in zip(_twists(theta), se3.left_jacobian(_twists(theta)), strict=True):
        block = np.zeros((12, 12))
        block[:6, :6] = _small_adjoint(xi)
        block[:6, 6:] = np.eye(6)
        np.testing.assert_allclose(J, expm(block)[:6, 6:], atol=1e-13)


@pytest.mark.parametrize("theta", [0.0, 1e-6, 0.1, 1.5, 2.5])
def test_left_jacobian_is_the_derivative_of_exp(theta):
    xi, h = _twists(theta), 1e-3
    here = se3.inverse(se3.exp(xi))
    J = se3.left_jacobian(xi)
    for k in range(6):
        value = {j: se3.log(se3.compose(se3.exp(xi + j * h * np.eye(6)[k]), here)) for j in (-2, -1, 1, 2)}
        numeric = (8 * (value[1] - value[-1]) - (value[2] - value[-2])) / (12 * h)
        np.testing.assert_allclose(J[:, :, k], numeric, atol=1e-11)  # truncation h^4 / 30 times a fifth derivative


@pytest.mark.parametrize("theta", ANGLES)
def test_jacobian_identities(theta):
    xi = _twists(theta)
    identity = np.broadcast_to(np.eye(6), (12, 6, 6))
    J = se3.left_jacobian(xi)
    np.testing.assert_allclose(J, se3.adjoint(se3.exp(xi)) @ se3.right_jacobian(xi), atol=1e-14)
    np.testing.assert_allclose(J @ se3.left_jacobian_inverse(xi), identity, atol=2e-14)
    np.testing.assert_allclose(se3.right_jacobian(xi) @ se3.right_jacobian_inverse(xi), identity, atol=2e-14)


@pytest.mark.kernels
@pytest.mark.parametrize("theta", [0.0, 1e-9, 1e-3, 1.0, math.pi])
def test_kernels_equal_the_batched_functions(theta):
    first, second = _twists(theta)[:2]
    A, B, out = np.empty(12), np.empty(12), np.empty(12)
    se3.exp_kernel(first, A)
    se3.exp_kernel(second, B)
    np.testing.assert_allclose(A.reshape(3, 4), se3.to_matrix(se3.exp(first))[:3], atol=2e-15)
    se3.compose_kernel(A, B, out)
    expected = se3.compose(se3.exp(first), se3.exp(second))
    np.testing.assert_allclose(out.reshape(3, 4), se3.to_matrix(expected)[:3], atol=5e-15)


@pytest.mark.parametrize("batch", [(), (0,), (4,), (2, 3)])
def test_any_batch_shape(batch):
    xi = np.random.default_rng(7).normal(size=(*batch, 6))
    pose = se3.exp(xi)
    assert pose.shape == (*batch, 7)
    assert se3.identity(*batch).shape == (*batch, 7)
    assert se3.log(pose).shape == (*batch, 6)
    assert se3.to_matrix(pose).shape == (*batch, 4, 4)
    for matrix in (se3.adjoint(pose), se3.left_jacobian(xi), se3.left_jacobian_inverse(xi)):
        assert matrix.shape == (*batch, 6, 6)


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match=r"\(\.\.\., 7\).*got \(6,\)"):
        se3.inverse(np.zeros(6))
    with pytest.raises(ShapeError, match=r"\(\.\.\., 6\), translation then rotation; got \(7,\)"):
        se3.exp(np.zeros(7))
    with pytest.raises(ShapeError, match=r"\(\.\.\., 3, 4\) or"):
        se3.from_matrix(np.zeros((3, 3)))


def test_a_camera_looks_at_its_target_and_stands_upright():
    centers, targets = np.random.default_rng(11).normal(size=(2, 20, 3))
    poses = se3.looking_at(centers, targets)
    seen = se3.transform_points(poses, targets)
    np.testing.assert_allclose(seen[:, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(seen[:, 2], np.linalg.norm(targets - centers, axis=1))
    above = se3.transform_points(poses, targets + np.array([0.0, 0.0, 0.1]))
    np.testing.assert_allclose(above[:, 0], 0.0, atol=1e-12)
    assert (above[:, 1] < 0.0).all()  # y points down
    np.testing.assert_allclose(se3.transform_points(poses, centers), 0.0, atol=1e-12)
    np.testing.assert_allclose(se3.looking_at(centers[0], targets[0]), poses[0], atol=1e-14)
    below = se3.looking_at(centers, targets, up=(0.0, 0.0, -1.0))
    assert (se3.transform_points(below, targets + np.array([0.0, 0.0, 0.1]))[:, 1] > 0.0).all()
