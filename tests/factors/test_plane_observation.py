# SPDX-License-Identifier: BSD-3-Clause
"""Planes measured in the camera, metric and quaternion form: values, scale and sign, tiny and large errors."""

import numpy as np
import pytest

from groma.errors import InputError
from groma.factors.contract import Ref
from groma.factors.observations.plane_observation import PlaneObservation
from groma.factors.observations.plane_quaternion import PlaneQuaternion
from groma.geometry import quaternion, so3

pytestmark = pytest.mark.kernels

FORMS = pytest.mark.parametrize("form", [PlaneObservation, PlaneQuaternion])


def make(form, planes_in_cam):
    zero = np.zeros(len(planes_in_cam), dtype=int)
    return form(pose=Ref("poses", zero), plane=Ref("planes", zero), planes_in_cam=np.array(planes_in_cam, dtype=float))


def evaluate(form, plane_in_cam, pose, plane):
    """Residual (3,), pose block (3, 6), plane block (3, 4), number of degenerate factors."""
    factor = make(form, [plane_in_cam])
    record = np.full((1, 3, 11), np.nan)
    degenerate = factor.linearize(factor.prepare((pose.reshape(1, 12), np.array([plane]))), 0, 1, (0, 6), record)
    return record[0, :, 10], record[0, :, :6], record[0, :, 6:10], degenerate


def make_pose(rng, size=1.0):
    return np.hstack([so3.exp(rng.normal(size=3)), size * rng.normal(size=(3, 1))])


def to_camera(pose, plane):
    n = pose[:, :3] @ plane[:3]
    return np.hstack([n, plane[3] - pose[:, 3] @ n])


def random_plane(rng):
    plane = rng.normal(size=4)
    return plane / np.linalg.norm(plane[:3])


@FORMS
@pytest.mark.parametrize("factor", [1.0, -1.0, 1e-6, 7.5, -3e4])
def test_perfect_measurement_gives_zero_at_any_scale_and_sign(form, factor):
    rng = np.random.default_rng(0)
    pose, plane = make_pose(rng), random_plane(rng)
    residual, by_pose, by_plane, degenerate = evaluate(form, to_camera(pose, plane), pose, factor * plane)
    np.testing.assert_allclose(residual, 0.0, atol=2e-15)
    assert degenerate == 0 and by_pose.any() and by_plane.any()


@FORMS
@pytest.mark.parametrize("factor", [-1.0, 1e-5, 200.0, -40.0])
def test_planes_have_neither_scale_nor_sign(form, factor):
    rng = np.random.default_rng(1)
    pose, plane, measured = make_pose(rng), random_plane(rng), random_plane(rng)
    first, second = evaluate(form, measured, pose, plane), evaluate(form, -measured * 3.0, pose, factor * plane)
    if form is PlaneQuaternion:
        np.testing.assert_allclose(second[0], first[0], rtol=1e-12)
    else:
        second = evaluate(form, measured, pose, factor * plane)
        np.testing.assert_allclose(second[0], first[0], rtol=1e-12)
    np.testing.assert_allclose(second[1], first[1], rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(second[2] * factor, first[2], rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(first[2] @ plane, 0.0, atol=1e-13)  # degree zero


def test_metric_residual_is_angle_and_distance():
    measured = np.array([0.0, 0.0, -1.0, 4.0])  # a wall 4 units ahead, normal towards the camera
    identity = np.hstack([np.eye(3), np.zeros((3, 1))])
    for angle, distance in ((0.0, 4.25), (0.02, 4.0), (-0.3, 3.5)):
        wall = np.array([0.0, np.sin(angle), -np.cos(angle), distance])
        residual, *_ = evaluate(PlaneObservation, measured, identity, 5.0 * wall)
        assert np.linalg.norm(residual[:2]) == pytest.approx(abs(np.sin(angle)), abs=1e-15)
        assert residual[2] == pytest.approx(distance - 4.0, abs=1e-14)


def test_basis_is_orthonormal_and_is_the_one_of_the_residual():
    rng = np.random.default_rng(2)
    measured = np.vstack([rng.normal(size=(6, 4)), [[0, 0, 1, 2.0]], [[0, 0, -1, 2.0]], [[1e-9, 0, -1, 2.0]]])
    factor = make(PlaneObservation, measured)
    basis = factor.basis
    normals = factor.planes_in_cam[:, :3]
    frame = np.concatenate([basis, normals[:, :, None]], axis=2)
    np.testing.assert_allclose(np.swapaxes(frame, 1, 2) @ frame, np.broadcast_to(np.eye(3), frame.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, rtol=1e-13)
    identity = np.hstack([np.eye(3), np.zeros((3, 1))])
    plane = random_plane(rng)
    residual, *_ = evaluate(PlaneObservation, measured[0], identity, plane)
    sign = np.sign(normals[0] @ plane[:3])
    np.testing.assert_allclose(residual[:2], sign * basis[0].T @ plane[:3], rtol=1e-12)


def test_metric_residual_does_not_depend_on_the_world_frame():
    rng = np.random.default_rng(3)
    pose, plane, measured = make_pose(rng), random_plane(rng), random_plane(rng)
    world = np.vstack([make_pose(rng, 100.0), [0, 0, 0, 1.0]])  # old world from new world
    moved_pose = (np.vstack([pose, [0, 0, 0, 1.0]]) @ world)[:3]
    moved_plane = world.T @ plane
    before = evaluate(PlaneObservation, measured, pose, plane)
    after = evaluate(PlaneObservation, measured, moved_pose, moved_plane)
    np.testing.assert_allclose(after[0], before[0], atol=1e-11)
    np.testing.assert_allclose(after[1], before[1], atol=1e-11)


# ---------------------------------------------------------------------------------------------------- quaternion form


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-160, 1e-12, 1e-8, 1e-5, 1e-2, 0.0999, 0.1001, 1.0, 3.0, 3.14159])
def test_quaternion_residual_is_the_rotation_vector(angle):
    """The arccos form loses half of the digits at 1e-8 and all below; none may be lost here."""
    rng = np.random.default_rng(4)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    # With the landmark (0, 0, 0, 1), plane at infinity but a fine quaternion, e is the measurement itself.
    measured = np.hstack([np.sin(0.5 * angle) * axis, np.cos(0.5 * angle)])
    identity = np.hstack([np.eye(3), np.zeros((3, 1))])
    for sign in (1.0, -1.0):
        residual, by_pose, by_plane, degenerate = evaluate(PlaneQuaternion, sign * measured, identity, [0, 0, 0, 1.0])
        np.testing.assert_allclose(residual, angle * axis, rtol=1e-12, atol=0.0)
        assert degenerate == 0 and np.isfinite(by_pose).all()
        # By a left increment of the landmark: -J_r(r)^-1.
        increments = 0.5 * np.vstack([np.eye(3), np.zeros((1, 3))])
        np.testing.assert_allclose(by_plane @ increments, -so3.right_jacobian_inverse(angle * axis), atol=1e-11)


def test_quaternion_residual_stays_below_half_a_turn():
    rng = np.random.default_rng(5)
    for _ in range(50):
        pose, plane, measured = make_pose(rng), random_plane(rng), random_plane(rng)
        residual, *_ = evaluate(PlaneQuaternion, measured, pose, plane)
        y = np.hstack([pose[:, :3].T @ measured[:3], pose[:, 3] @ measured[:3] + measured[3]])
        e = quaternion.multiply(y / np.linalg.norm(y), quaternion.conjugate(plane / np.linalg.norm(plane)))
        np.testing.assert_allclose(quaternion.exp(residual), e * np.sign(e[3]), atol=1e-13)
        assert np.linalg.norm(residual) <= np.pi


def test_plane_through_the_origin_is_an_ordinary_plane():
    rng = np.random.default_rng(6)
    pose = make_pose(rng)
    plane = np.array([0.6, 0.0, 0.8, 0.0])
    for w in (1e-9, -1e-9):
        near = np.array([*plane[:3], w])
        for form in (PlaneQuaternion, PlaneObservation):
            residual, by_pose, by_plane, degenerate = evaluate(form, to_camera(pose, plane), pose, near)
            assert degenerate == 0 and np.isfinite(by_pose).all() and np.isfinite(by_plane).all()
            assert np.linalg.norm(residual) < 3e-9


# ----------------------------------------------------------------------------------------------------------- nonsense


def test_degenerate_planes_are_left_out_and_counted():
    pose = np.hstack([np.eye(3), np.zeros((3, 1))])
    for form, plane in (
        (PlaneObservation, [0.0, 0.0, 0.0, 1.0]),
        (PlaneObservation, [np.nan, 0.0, 0.0, 1.0]),
        (PlaneQuaternion, [0.0, 0.0, 0.0, 0.0]),
        (PlaneQuaternion, [0.0, np.nan, 0.0, 0.0]),
    ):
        residual, by_pose, by_plane, degenerate = evaluate(form, [0.0, 0.0, 1.0, 2.0], pose, plane)
        assert degenerate == 1 and not residual.any() and not by_pose.any() and not by_plane.any()


def test_measured_planes_must_have_a_normal():
    with pytest.raises(InputError, match="must not be zero; row 1"):
        make(PlaneObservation, [[0, 0, 1.0, 2.0], [0, 0, 0, 1.0]])
    with pytest.raises(InputError, match="must be finite; row 0"):
        make(PlaneQuaternion, [[0, 0, np.inf, 2.0]])
