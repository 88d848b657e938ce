# SPDX-License-Identifier: BSD-3-Clause
"""Covers maps of points, lines and planes: each against the moved points of the object, the matrices against each
other, and the derivatives against central differences through the exponential map (1e-8: step 1e-6 squared over
rounding)."""

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.geometry import line3, plane3, se3, sim3, transform

COUNT = 60


@pytest.fixture
def rng():
    return np.random.default_rng(9)


def random_pose(rng, count=COUNT):
    q = rng.normal(size=(count, 4))
    return np.hstack([q / np.linalg.norm(q, axis=1, keepdims=True), rng.normal(size=(count, 3))])


def objects(rng):
    a, b, c = rng.normal(size=(3, COUNT, 3))
    return (a, b, c), line3.from_points(a, b), plane3.from_points(a, b, c)


def test_rigid_and_similarity_move_the_points_of_the_object(rng):
    (a, b, c), line, plane = objects(rng)
    pose = random_pose(rng)
    rotation, translation = transform.rotation_and_translation(pose)
    scale = rng.uniform(0.2, 5.0, COUNT)
    for points, lines, planes, motion in (
        (transform.rigid_points, transform.rigid_lines, transform.rigid_planes, pose),
        (transform.rigid_points, transform.rigid_lines, transform.rigid_planes, (rotation, translation)),
        (
            transform.similarity_points,
            transform.similarity_lines,
            transform.similarity_planes,
            sim3.from_parts(scale, rotation, translation),
        ),
    ):
        a2, b2, c2 = (points(motion, x) for x in (a, b, c))
        assert line3.same_line(lines(motion, line), line3.from_points(a2, b2), 1e-12, oriented=True).all()
        assert plane3.same_plane(planes(motion, plane), plane3.from_points(a2, b2, c2), 1e-10, oriented=True).all()
    np.testing.assert_allclose(
        transform.rigid_lines(pose, line)[:, :],
        line3.from_points(transform.rigid_points(pose, a), transform.rigid_points(pose, b)),
        atol=1e-12,
    )
    np.testing.assert_allclose(transform.rigid_points(pose, a), se3.transform_points(pose, a), atol=1e-12)
    np.testing.assert_allclose(
        np.linalg.norm(transform.rigid_planes(pose, plane)[:, :3], axis=1), np.linalg.norm(plane[:, :3], axis=1)
    )


def test_line_matrix_is_the_adjoint(rng):
    pose = random_pose(rng)
    np.testing.assert_allclose(transform.rigid_line_matrix(pose), se3.adjoint(pose), atol=1e-13)


def test_a_similarity_is_a_homography(rng):
    _, line, plane = objects(rng)
    rotation, translation = transform.rotation_and_translation(random_pose(rng))
    scale = rng.uniform(0.2, 5.0, COUNT)
    homography = np.zeros((COUNT, 4, 4))
    homography[:, :3, :3] = scale[:, None, None] * rotation
    homography[:, :3, 3] = translation
    homography[:, 3, 3] = 1.0
    moved = transform.projective_lines(homography, line)
    similar = transform.similarity_lines(sim3.from_parts(scale, rotation, translation), line)
    np.testing.assert_allclose(moved, scale[:, None] * similar, atol=1e-11)
    moved = transform.projective_planes(homography, plane)
    similar = transform.similarity_planes(sim3.from_parts(scale, rotation, translation), plane)
    np.testing.assert_allclose(scale[:, None] * moved, similar, atol=1e-11)


def test_projective_maps(rng):
    homography = rng.normal(size=(COUNT, 4, 4))
    a, b, c = rng.normal(size=(3, COUNT, 4))
    line = line3.from_homogeneous_points(a, b)
    a2, b2, c2 = (transform.projective_points(homography, x) for x in (a, b, c))
    moved = transform.projective_lines(homography, line)
    np.testing.assert_allclose(moved, line3.from_homogeneous_points(a2, b2), atol=1e-11)
    primal = transform.projective_primal_matrix(homography, line3.primal_matrix(line))
    np.testing.assert_allclose(line3.from_primal_matrix(primal), moved, atol=1e-11)
    dual = transform.projective_dual_matrix(homography, line3.dual_matrix(line))
    expected = line3.dual_matrix(moved) / np.linalg.det(homography)[:, None, None]
    np.testing.assert_allclose(dual, expected, rtol=1e-6, atol=1e-8)
    planes = np.linalg.svd(np.stack([a, b, c], axis=1))[2][:, -1]
    images = transform.projective_planes(homography, planes)
    for point in (a2, b2, c2):
        np.testing.assert_allclose(np.sum(images * point, axis=1), 0.0, atol=1e-9)


@pytest.mark.kernels
def test_derivatives_by_the_left_twist(rng):
    (a, _, _), line, plane = objects(rng)
    pose = random_pose(rng)
    step = 1e-6
    for move, derivative, item in (
        (transform.rigid_points, transform.rigid_points_wrt_twist, a),
        (transform.rigid_lines, transform.rigid_lines_wrt_twist, line),
        (transform.rigid_planes, transform.rigid_planes_wrt_twist, plane),
    ):
        analytic = derivative(move(pose, item))
        for j in range(6):
            xi = np.zeros(6)
            xi[j] = step
            plus, minus = (move(se3.compose(se3.exp(s * xi), pose), item) for s in (1.0, -1.0))
            np.testing.assert_allclose(analytic[..., j], (plus - minus) / (2 * step), atol=1e-8)


def test_matrices_are_the_derivatives_by_the_object(rng):
    (a, _, _), line, plane = objects(rng)
    pose, homography = random_pose(rng), rng.normal(size=(COUNT, 4, 4))
    for move, matrix, motion, item in (
        (transform.rigid_points, transform.rotation_and_translation(pose)[0], pose, a),
        (transform.rigid_lines, transform.rigid_line_matrix(pose), pose, line),
        (transform.rigid_planes, transform.rigid_plane_matrix(pose), pose, plane),
        (transform.projective_lines, transform.projective_line_matrix(homography), homography, line),
        (transform.projective_planes, transform.projective_plane_matrix(homography), homography, plane),
    ):
        change = rng.normal(size=item.shape)
        moved = move(motion, item + change) - move(motion, item)
        scale = 1.0 + np.abs(matrix).max()
        np.testing.assert_allclose(np.einsum("nij,nj->ni", matrix, change) / scale, moved / scale, atol=1e-12)


def test_one_motion_moves_many_and_many_move_one(rng):
    _, line, plane = objects(rng)
    pose = random_pose(rng)
    assert transform.rigid_lines(pose[0], line).shape == (COUNT, 6)
    assert transform.rigid_planes(pose, plane[0]).shape == (COUNT, 4)
    assert transform.rigid_lines(pose[:, None], line[None]).shape == (COUNT, COUNT, 6)
    assert transform.similarity_lines(sim3.from_parts(2.0, np.eye(3), np.zeros(3)), line).shape == (COUNT, 6)


def test_errors():
    with pytest.raises(ShapeError, match="b_from_a"):
        transform.rigid_points(np.zeros(6), np.zeros(3))
    with pytest.raises(InputError, match="positive"):
        transform.similarity_points(np.array([0.0, 0, 0, 1, 0, 0, 0, -1]), np.zeros(3))
    with pytest.raises(ShapeError, match=r"got a tuple.*sim3\.from_parts\(s, R, t\)"):  # the form it had once
        transform.similarity_lines((2.0, np.eye(3), np.zeros(3)), np.ones(6))
    with pytest.raises(InputError, match="rank 4"):
        transform.projective_planes(np.zeros((4, 4)), np.zeros(4))
