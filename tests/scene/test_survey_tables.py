# SPDX-License-Identifier: BSD-3-Clause
"""Tables of measurements of other instruments: selected, moved and stored with their scene."""

import numpy as np
import pytest
from _survey import ELSEWHERE, made, with_everything

from groma.errors import InputError
from groma.io.archive import read_archive, write_archive
from groma.scene import CameraPositions, ControlPoints, Distances, Marks
from groma.scene.survey import Kind

TABLES = ("camera_positions", "control_points", "marks", "distances")


@pytest.fixture(scope="module")
def scene():
    return with_everything(made()[0], np.random.default_rng(0))


def test_the_archive_holds_them(scene, tmp_path):
    write_archive(scene, tmp_path / "scene.npz")
    back = read_archive(tmp_path / "scene.npz")
    for name in TABLES:
        before, after = getattr(scene, name), getattr(back, name)
        assert len(after) == len(before) > 0
        for column in before.__dataclass_fields__:
            assert np.array_equal(getattr(before, column), getattr(after, column)), (name, column)
    assert scene.num_measurements == back.num_measurements


def test_they_move_with_the_world(scene):
    moved = scene.transformed(ELSEWHERE)
    s, R = ELSEWHERE.scale, ELSEWHERE.rotation
    np.testing.assert_allclose(moved.camera_positions.xyz, ELSEWHERE.points(scene.camera_positions.xyz), atol=1e-12)
    old = scene.camera_positions.replace(covariance=np.diag([1.0, 4.0, 9.0])[None].repeat(8, axis=0))
    turned = scene.replace(camera_positions=old).transformed(ELSEWHERE).camera_positions.covariance
    np.testing.assert_allclose(turned, s**2 * R @ old.covariance @ R.T, atol=1e-12)
    np.testing.assert_allclose(moved.distances.distance, s * scene.distances.distance)
    np.testing.assert_allclose(moved.distances.sigma, s * scene.distances.sigma)
    np.testing.assert_allclose(moved.control_points.measured, ELSEWHERE.points(scene.control_points.measured))
    assert np.array_equal(moved.marks.pixel, scene.marks.pixel)


def test_they_go_with_their_images(scene):
    part = scene.subset([1, 3, 0])
    assert part.camera_positions.image_idx.tolist() == [2, 0, 1]
    np.testing.assert_allclose(part.camera_positions.xyz[0], scene.camera_positions.xyz[0])
    assert part.distances.first_idx.tolist() == [0, 2] and part.distances.second_idx.tolist() == [1, 0]
    assert scene.subset([1, 3]).distances.first_kind.tolist() == [Kind.CONTROL_POINT]
    kept = np.isin(scene.marks.image_idx, [0, 1, 3])
    assert len(part.marks) == kept.sum() and len(part.control_points) == len(scene.control_points)


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="positive definite"):
        CameraPositions([0], np.zeros((1, 3)), np.zeros((1, 3, 3)))
    with pytest.raises(InputError, match="unique"):
        ControlPoints(("a", "a"), np.zeros((2, 3)), np.zeros((2, 3)), np.stack([np.eye(3)] * 2), [1, 1])
    with pytest.raises(InputError, match="from itself"):
        Distances.between(Kind.IMAGE, [2], [2], [1.0], [0.1])
    with pytest.raises(InputError, match=r"Marks\.sigma"):
        Marks([0], [0], np.zeros((1, 2)), [0.0])
