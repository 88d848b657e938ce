# SPDX-License-Identifier: BSD-3-Clause
"""Priors on poses, camera centres and numbers, and relative poses: values, frames, small and large rotations.

Their derivatives in general position are checked in test_all_factors.py.
"""

import numpy as np
import pytest
from scipy.linalg import expm, logm

from groma.errors import InputError, ShapeError
from groma.factors._examples import make_example, random_poses
from groma.factors._record import poses_from_states
from groma.factors.checks.check import check_factor, linearized, residuals_of
from groma.factors.contract import Ref
from groma.factors.priors.pose_between import PoseBetween
from groma.factors.priors.pose_prior import PosePrior
from groma.factors.priors.position_prior import PositionPrior
from groma.factors.priors.similarity_between import SimilarityBetween
from groma.factors.priors.vector_prior import VectorPrior
from groma.geometry import se3, sim3
from groma.geometry.manifold import Euclidean

pytestmark = pytest.mark.kernels
N = 6
EACH = Ref("poses", np.arange(N))


@pytest.fixture
def rng():
    return np.random.default_rng(17)


def test_measurements_are_finite_and_references_of_one_length(rng):
    poses = random_poses(rng, N, rotation=0.5)
    with pytest.raises(ShapeError, match=r"PoseBetween.second must have one index per factor, 6 like its first; got 5"):
        PoseBetween(first=EACH, second=Ref("poses", np.arange(N - 1)), first_from_second=poses)
    poses[2, 4] = np.nan
    with pytest.raises(InputError, match=r"PosePrior.cam_from_world must be finite; row 2 is .* \(1 such rows\)"):
        PosePrior(pose=EACH, cam_from_world=poses)


def hat(xi):
    rho, (x, y, z) = xi[:3], xi[3:]
    return np.block([[np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), rho[:, None]], [np.zeros((1, 4))]])


def vee(matrix):
    return np.array([*matrix[:3, 3], matrix[2, 1], matrix[0, 2], matrix[1, 0]])


def flat(matrices):
    return np.ascontiguousarray(matrices[:, :3]).reshape(len(matrices), 12)


def matrices(poses):
    return np.concatenate(
        [poses_from_states(poses).reshape(-1, 3, 4), np.tile([[[0.0, 0, 0, 1]]], (len(poses), 1, 1))], 1
    )


def test_pose_prior_is_the_twist_that_was_applied(rng):
    prior = random_poses(rng, N, rotation=2.0)
    xi = rng.normal(size=(N, 6))
    moved = np.array([expm(hat(x)) @ T for x, T in zip(xi, matrices(prior), strict=True)])
    r = residuals_of(PosePrior(pose=EACH, cam_from_world=prior), (flat(moved),))
    np.testing.assert_allclose(r, xi, rtol=1e-11, atol=1e-12)
    np.testing.assert_allclose(
        residuals_of(PosePrior(pose=EACH, cam_from_world=prior), (poses_from_states(prior),)), 0.0, atol=1e-14
    )


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.0099, 0.0101, 0.099, 0.101, 1.0, 3.0, np.pi - 1e-7])
def test_logarithm_and_jacobian_are_precise_at_every_angle(angle, rng):
    """The residual against the twist applied; the Jacobian against the series of the left Jacobian of SE(3)."""
    axes = rng.normal(size=(N, 3))
    xi = np.hstack([rng.normal(size=(N, 3)), angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)])
    identity = np.tile([0, 0, 0, 1.0, 0, 0, 0], (N, 1))
    ambient = flat(np.array([expm(hat(x)) for x in xi]))
    record, _ = linearized(PosePrior(pose=EACH, cam_from_world=identity), (ambient,), [6])
    np.testing.assert_allclose(record[:, :, 6], xi, rtol=1e-8, atol=1e-13 + 1e-14 / max(np.pi - angle, 1e-3))
    for x, J in zip(xi, record[:, :, :6], strict=True):
        W, P = hat(x)[:3, :3], hat(np.r_[0, 0, 0, x[:3]])[:3, :3]
        ad = np.block([[W, P], [np.zeros((3, 3)), W]])
        series, term = np.zeros((6, 6)), np.eye(6)
        for k in range(1, 60):
            series += term
            term = term @ ad / (k + 1)
        np.testing.assert_allclose(J @ series, np.eye(6), atol=2e-11)


def test_pose_prior_survives_a_rotation_by_pi(rng):
    identity = np.tile([0, 0, 0, 1.0, 0, 0, 0], (N, 1))
    axes = np.vstack([np.eye(3), rng.normal(size=(3, 3))])
    q = np.hstack([axes / np.linalg.norm(axes, axis=1, keepdims=True), np.zeros((N, 1)), rng.normal(size=(N, 3))])
    record, _ = linearized(PosePrior(pose=EACH, cam_from_world=identity), (poses_from_states(q),), [6])
    assert np.isfinite(record).all()
    np.testing.assert_allclose(np.linalg.norm(record[:, 3:, 6], axis=1), np.pi, rtol=1e-12)


def test_pose_between_lives_in_the_frame_of_the_second_camera(rng):
    first, second = random_poses(rng, N, rotation=2.0), random_poses(rng, N, rotation=2.0)
    T1, T2 = matrices(first), matrices(second)
    xi = 0.3 * rng.normal(size=(N, 6))
    # first_from_second = measured Exp(xi): the error acts first, on coordinates of the second camera.
    measured = np.array([a @ np.linalg.inv(b) @ expm(-hat(x)) for a, b, x in zip(T1, T2, xi, strict=True)])
    factor = PoseBetween(first=EACH, second=Ref("others", np.arange(N)), first_from_second=se3.from_matrix(measured))
    np.testing.assert_allclose(residuals_of(factor, (flat(T1), flat(T2))), xi, atol=1e-12)
    expected = vee(logm(np.linalg.inv(measured[0]) @ T1[0] @ np.linalg.inv(T2[0])).real)
    np.testing.assert_allclose(residuals_of(factor, (flat(T1), flat(T2)))[0], expected, atol=1e-10)


def test_pose_between_does_not_feel_the_world_move(rng):
    factor = PoseBetween(
        first=EACH, second=Ref("others", np.arange(N)), first_from_second=random_poses(rng, N, rotation=0.5)
    )
    T1, T2 = matrices(random_poses(rng, N, rotation=0.5)), matrices(random_poses(rng, N, rotation=0.5))
    S = matrices(random_poses(rng, 1, rotation=2.0))
    np.testing.assert_allclose(
        residuals_of(factor, (flat(T1), flat(T2))), residuals_of(factor, (flat(T1 @ S), flat(T2 @ S))), atol=1e-12
    )


def test_position_prior_is_the_error_of_the_centre(rng):
    poses, centers = random_poses(rng, N, rotation=2.0), rng.normal(size=(N, 3))
    truth = np.linalg.inv(matrices(poses))[:, :3, 3]
    r = residuals_of(PositionPrior(pose=EACH, cam_center_in_world=centers), (poses_from_states(poses),))
    np.testing.assert_allclose(r, truth - centers, atol=1e-13)


def test_vector_prior_takes_any_size(rng):
    for size in (1, 3, 8):
        x, measured = rng.normal(size=(2, N, size))
        factor = VectorPrior(variable=EACH, measured=measured)
        assert factor.residual_size == size
        record, _ = linearized(factor, (x,), [size])
        np.testing.assert_array_equal(record[:, :, -1], x - measured)
        np.testing.assert_array_equal(record[:, :, :size], np.tile(np.eye(size), (N, 1, 1)))


def test_vector_prior_of_some_coordinates(rng):
    x, measured = rng.normal(size=(N, 4)), rng.normal(size=(N, 2))
    factor = VectorPrior(variable=EACH, measured=measured, coordinates=(1, 2))
    record, _ = linearized(factor, (x,), [4])
    np.testing.assert_array_equal(record[:, :, -1], x[:, 1:3] - measured)
    np.testing.assert_array_equal(record[:, :, :4], np.tile(np.eye(4)[1:3], (N, 1, 1)))
    check_factor(make_example(factor, rng, manifolds={"poses": Euclidean(4)}))
    with pytest.raises(ShapeError, match="has 2 columns, but the variables of group 'poses' have 1 numbers to know"):
        residuals_of(VectorPrior(variable=EACH, measured=measured, coordinates=(1,)), (x,))


def test_poses_far_from_their_prior_keep_their_derivative(rng):
    """Rotation errors up to 2.5 rad, where the inverse left Jacobian is far from the identity."""
    factor = PosePrior(pose=EACH, cam_from_world=random_poses(rng, N, rotation=1.0))
    check_factor(make_example(factor, rng, states={"poses": random_poses(rng, N, rotation=1.5)}))


def test_wrong_shapes_are_refused(rng):
    with pytest.raises(ShapeError, match=r"PosePrior.cam_from_world must have shape \(6, 7\).* got \(6, 6\)"):
        PosePrior(pose=EACH, cam_from_world=np.zeros((N, 6)))
    with pytest.raises(ShapeError, match=r"PositionPrior\.cam_center_in_world"):
        PositionPrior(pose=EACH, cam_center_in_world=np.zeros((N, 2)))
    with pytest.raises(ShapeError, match=r"must have shape \(6, k\)"):
        VectorPrior(variable=EACH, measured=np.zeros((N + 1, 3)))
    with pytest.raises(ShapeError, match="has 2 columns, but the variables of group 'poses' have 3 numbers"):
        residuals_of(VectorPrior(variable=EACH, measured=np.zeros((N, 2))), (np.zeros((N, 3)),))


def test_similarity_between_is_the_error_in_the_unit_of_the_second_camera(rng):
    """Residuals of an error that is applied on the right of the measured similarity, against products of matrices."""

    def some(count):
        return np.hstack([random_poses(rng, count, rotation=2.0), rng.uniform(0.4, 2.5, (count, 1))])

    first, second, error = some(N), some(N), 0.3 * rng.normal(size=(N, 7))
    S1, S2 = sim3.to_matrix(first), sim3.to_matrix(second)
    E = np.array([expm(sim3.hat(x)) for x in error])
    measured = sim3.from_matrix(S1 @ np.linalg.inv(S2) @ np.linalg.inv(E))
    factor = SimilarityBetween(first=EACH, second=Ref("others", np.arange(N)), first_from_second=measured)
    expected = np.hstack([E[:, :3, 3], error[:, 3:]])
    np.testing.assert_allclose(residuals_of(factor, (first, second)), expected, atol=1e-12)


def test_similarity_between_of_poses_is_that_of_poses_to_first_order(rng):
    first, second = random_poses(rng, N, rotation=1.0), random_poses(rng, N, rotation=1.0)
    measured = se3.compose(se3.compose(first, se3.inverse(second)), se3.exp(1e-6 * rng.normal(size=(N, 6))))
    others = Ref("others", np.arange(N))
    poses = PoseBetween(first=EACH, second=others, first_from_second=measured)
    one = np.ones((N, 1))
    scaled = SimilarityBetween(first=EACH, second=others, first_from_second=np.hstack([measured, one]))
    r = residuals_of(scaled, (np.hstack([first, one]), np.hstack([second, one])))
    expected = residuals_of(poses, (poses_from_states(first), poses_from_states(second)))
    np.testing.assert_allclose(r, np.hstack([expected, 0 * one]), atol=1e-11)
