# SPDX-License-Identifier: BSD-3-Clause
"""Covers planes: the four forms and their conversions, construction, distances, the special planes of each form."""

import numpy as np
import pytest

from groma.errors import ShapeError
from groma.geometry import plane3

COUNT = 200


@pytest.fixture
def planes():
    return np.random.default_rng(4).normal(size=(COUNT, 4))


def points_on(planes, rng, count):
    basis = np.linalg.svd(planes[:, None, :3])[2][:, 1:]
    foot = -planes[:, 3:] * planes[:, :3] / np.sum(planes[:, :3] ** 2, axis=1, keepdims=True)
    return foot[:, None] + rng.normal(size=(len(planes), count, 2)) @ basis


def test_every_form_is_the_same_plane(planes):
    for converted in (
        plane3.hesse(planes),
        plane3.canonical(planes),
        plane3.from_closest_point(plane3.to_closest_point(planes)),
        plane3.to_quaternion(planes),
        plane3.from_quaternion(plane3.to_quaternion(planes)),
    ):
        assert plane3.same_plane(converted, planes, 1e-12).all()


def test_forms_keep_their_promises(planes):
    hesse = plane3.hesse(planes)
    np.testing.assert_allclose(np.linalg.norm(hesse[:, :3], axis=1), 1.0)
    assert plane3.same_plane(hesse, planes, 1e-12, oriented=True).all()
    canonical = plane3.canonical(planes)
    assert (canonical[:, 3] <= 0).all()
    np.testing.assert_allclose(plane3.canonical(-3.0 * planes), canonical)
    closest = plane3.to_closest_point(planes)
    np.testing.assert_allclose(np.linalg.norm(closest, axis=1), -canonical[:, 3])
    np.testing.assert_allclose(np.sum(closest * planes[:, :3], axis=1) + planes[:, 3], 0.0, atol=1e-13)
    np.testing.assert_allclose(plane3.from_closest_point(closest), canonical, atol=1e-12)
    quaternion = plane3.to_quaternion(planes)
    np.testing.assert_allclose(np.linalg.norm(quaternion, axis=1), 1.0)
    assert (quaternion[:, 3] >= 0).all()
    np.testing.assert_allclose(plane3.to_quaternion(-2.0 * planes), quaternion)


def test_construction_against_points(planes):
    rng = np.random.default_rng(5)
    a, b, c = np.moveaxis(points_on(planes, rng, 3), 1, 0)
    assert plane3.same_plane(plane3.from_points(a, b, c), planes, 1e-8).all()
    assert plane3.same_plane(plane3.from_point_and_normal(a, planes[:, :3]), planes, 1e-11, oriented=True).all()
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    np.testing.assert_allclose(np.linalg.norm(plane3.from_points(a, b, c)[:, :3], axis=1), 2 * area)
    seen = plane3.from_points(np.array([0.0, 0, 2]), np.array([1.0, 0, 2]), np.array([0.0, 1, 2]))
    np.testing.assert_allclose(seen, [0, 0, 1, -2])


def test_distance_and_foot(planes):
    point = np.random.default_rng(6).normal(size=(COUNT, 3))
    foot = plane3.closest_point(planes, point)
    distance = plane3.signed_distance(planes, point)
    np.testing.assert_allclose(plane3.signed_distance(planes, foot), 0.0, atol=1e-12)
    normal = plane3.hesse(planes)[:, :3]
    np.testing.assert_allclose(foot + distance[:, None] * normal, point, atol=1e-11)
    assert (plane3.signed_distance(planes, foot + normal) > 0).all()


def test_planes_through_the_origin():
    plane = np.array([[0.0, -2.0, 1.0, 0.0], [0.0, 2.0, -1.0, -0.0]])
    expected = np.array([0.0, 2.0, -1.0, 0.0]) / np.sqrt(5)
    np.testing.assert_allclose(plane3.canonical(plane), [expected, expected])
    np.testing.assert_allclose(plane3.to_quaternion(plane), [expected, expected])
    np.testing.assert_array_equal(plane3.to_closest_point(plane), np.zeros((2, 3)))
    assert np.isnan(plane3.from_closest_point(np.zeros(3))).all()


def test_plane_at_infinity_and_zero():
    infinity = np.array([0.0, 0.0, 0.0, -2.0])
    np.testing.assert_array_equal(plane3.to_quaternion(infinity), [0, 0, 0, 1])
    assert np.isnan(plane3.hesse(infinity)).all() and np.isnan(plane3.to_closest_point(infinity)).all()
    assert plane3.signed_distance(infinity, np.zeros(3)) == -np.inf
    assert plane3.same_plane(infinity, [0.0, 0, 0, 5])
    assert not plane3.same_plane(np.zeros(4), np.zeros(4))


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match="plane must have shape"):
        plane3.hesse(np.zeros(3))
