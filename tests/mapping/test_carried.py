# SPDX-License-Identifier: BSD-3-Clause
"""Measured depths of segments and planes, given to the segments and planes of a new map."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from groma.cameras import model
from groma.estimators.plane_search import PlaneSet
from groma.features.segments import Segments
from groma.geometry import quaternion, so3
from groma.mapping.carried.measured import carried_depths, not_carried, ready_to_map, with_measured_planes
from groma.scene import LineDepths, LineObservations, Lines, PlaneObservations, Planes, Scene
from groma.scene.camera import Cameras

pytestmark = pytest.mark.kernels

POSES = np.hstack([quaternion.from_matrix(so3.exp(np.random.default_rng(0).normal(0, 0.1, (3, 3)))), np.eye(3)])


def scene_of(**tables):
    cameras = Cameras.of([1], ["SIMPLE_RADIAL"], [[500.0, 320.0, 240.0, -0.1]], [[640, 480]])
    return Scene.from_images(cameras, ["a", "b", "c"], np.zeros(3, int), POSES, **tables)


def measured_line():
    """A model with one line of measured depths, and pixels and inverse depths of four places on it."""
    scene = scene_of()
    place = np.array([-1.0, -0.6, 4.0]) + np.multiply.outer([0.0, 1.0, 0.3, 1.2], [2.0, 1.1, 1.5])
    pixel = model("SIMPLE_RADIAL").project(scene.cameras.params_of(0), place)
    seen = LineObservations([1, 2], [0, 0], np.tile(pixel[:2].ravel(), (2, 1)), [1.0, 1.0])
    q = 1.0 / place[:, 2]
    depths = LineDepths([0], [q[:2]], [[0.01, 0.02]], [0.1])
    line = Lines.through(place[None, :2])
    return scene.replace(lines=line, line_observations=seen, line_depths=depths), pixel, q


def test_a_segment_has_the_depths_of_the_one_it_lies_on():
    given, pixel, q = measured_line()
    part, beside = pixel[2:].ravel(), (pixel[2:] + np.array([0.0, 4.0])).ravel()
    own = Segments(np.array([part, beside]), np.ones(2), np.ones(2))
    found = carried_depths(given, [Segments.empty(), own, own])
    assert found is not None and found.shape == (4, 5)
    np.testing.assert_allclose(found[0, :2], q[2:], rtol=1e-6)
    assert (found[1:] == 0.0).all()  # too far away, and in an image without depths
    # No combination of the two is stated better than it is known.
    t = np.linalg.lstsq((pixel[1] - pixel[0])[:, None], (pixel[2:] - pixel[0]).T, rcond=None)[0][0]
    A = np.stack([1 - t, t], axis=1)
    left = np.diag(found[0, [2, 4]]) - A @ np.diag([1e-4, 4e-4]) @ A.T
    assert np.linalg.eigvalsh(left)[0] > -1e-6
    assert carried_depths(given.replace(line_depths=LineDepths()), [own]) is None


def test_a_model_keeps_what_cameras_measured():
    given = measured_line()[0]
    planes = Planes([4, 5], [[0.0, 0, 1, -5], [1.0, 0, 0, -2]])
    noise = np.eye(3)[None]
    seen = PlaneObservations([0], [1], [[1.0, 0, 0, -2]], noise)
    kept = ready_to_map(given.replace(planes=planes, plane_observations=seen))
    assert kept.num_lines == 1 and kept.line_observations.image_idx.tolist() == [1]
    assert kept.planes.ids.tolist() == [5] and kept.plane_observations.plane_idx.tolist() == [0]
    assert not_carried(given, given) == []
    assert "1 line depth." in not_carried(given, Scene())[0]


def test_planes_that_were_measured_are_those_found_at_their_places():
    planes = np.array([[0.0, 0.0, 1.0, -5.0], [1.0, 0.0, 0.0, -2.0]])
    image, plane = np.repeat(np.arange(3), 2), np.tile([0, 1], 3)
    normal = quaternion.rotate(POSES[image, :4], planes[plane, :3])
    inside = np.column_stack([normal, planes[plane, 3] - (normal * POSES[image, 4:]).sum(axis=1)])
    seen = PlaneObservations(image, plane, inside, np.tile(np.diag([100.0, 100.0, 50.0]), (6, 1, 1)))
    before = scene_of(planes=Planes([1, 2], planes), plane_observations=seen)
    near = -planes[:1] + np.array([[0.0, 0.0, 0.0, 0.02]])  # a noise of one measurement beside the first, turned round
    away = planes[1:] + np.array([[0.0, 0.0, 0.0, 0.2]])
    found = np.concatenate([away, near])
    none = np.zeros(2, int)
    planes_found = PlaneSet(found, np.tile(1e-8 * np.eye(4), (2, 1, 1)), none, none, none, none, none, none)
    structure: Any = SimpleNamespace(scene=scene_of(planes=Planes([1, 2], found)), planes=planes_found)
    out = with_measured_planes(structure, before)
    np.testing.assert_array_equal(out.planes.hesse, np.concatenate([found, planes[1:]]))
    assert out.plane_observations.plane_idx.tolist() == [1, 2] * 3
