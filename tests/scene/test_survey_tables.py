# SPDX-License-Identifier: BSD-3-Clause
"""Tables of measurements of other instruments: selected, moved and stored with their scene."""

import numpy as np
import pytest
from _survey import ELSEWHERE, made, with_everything, with_objects

from groma.errors import InputError
from groma.io.archive import read_archive, write_archive
from groma.scene import CameraPositions, ControlPoints, Distances, Held, KnownDirections, Marks
from groma.scene.survey import Kind

TABLES = (
    "camera_positions", "camera_poses", "control_points", "marks", "distances", "known_planes", "known_directions",
    "held",
)  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(0)
    held = Held([Kind.IMAGE, Kind.POINT], [3, 7])
    return with_objects(with_everything(made()[0], rng), rng).replace(held=held)


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
    np.testing.assert_allclose(moved.known_directions.vector, scene.known_directions.vector @ R.T, atol=1e-12)
    assert np.array_equal(moved.known_directions.in_camera, scene.known_directions.in_camera)
    planes = scene.known_planes
    off = np.einsum("ni,ni->n", moved.known_planes.hesse[:, :3], moved.known_planes.anchor)
    before = np.einsum("ni,ni->n", planes.hesse[:, :3], planes.anchor) + planes.hesse[:, 3]
    np.testing.assert_allclose(off + moved.known_planes.hesse[:, 3], s * before, atol=1e-9)
    unit = np.repeat([s, 1.0], 3)
    np.testing.assert_allclose(moved.camera_poses.covariance, scene.camera_poses.covariance * np.outer(unit, unit))


def test_what_was_measured_stays_where_the_scene_is_moved_under_it(scene):
    moved = scene.transformed(ELSEWHERE, measured=False)
    columns = {
        "camera_positions": "xyz", "camera_poses": "cam_from_world", "control_points": "measured",
        "distances": "distance", "known_planes": "hesse", "known_directions": "vector",
    }  # fmt: skip
    for name, column in columns.items():
        assert np.array_equal(getattr(getattr(moved, name), column), getattr(getattr(scene, name), column)), name
    np.testing.assert_allclose(moved.control_points.xyz, ELSEWHERE.points(scene.control_points.xyz), atol=1e-12)
    np.testing.assert_allclose(moved.known_planes.anchor, ELSEWHERE.points(scene.known_planes.anchor), atol=1e-12)


def test_they_go_with_their_images(scene):
    part = scene.subset([1, 3, 0])
    assert part.camera_positions.image_idx.tolist() == [2, 0, 1]
    np.testing.assert_allclose(part.camera_positions.xyz[0], scene.camera_positions.xyz[0])
    assert part.distances.first_idx.tolist() == [0, 2] and part.distances.second_idx.tolist() == [1, 0]
    assert scene.subset([1, 3]).distances.first_kind.tolist() == [Kind.CONTROL_POINT]
    assert part.known_directions.idx.tolist() == [2, 0, 1] and part.camera_poses.image_idx.tolist() == [2, 0, 1]
    assert part.held.kind.tolist()[0] == Kind.IMAGE and part.held.idx[0] == 1
    without = scene.keep(points=np.arange(scene.num_points) != 7)
    assert without.held.kind.tolist() == [Kind.IMAGE]
    assert scene.keep(points=np.arange(scene.num_points) != 3).held.idx.tolist() == [3, 6]
    kept = np.isin(scene.marks.image_idx, [0, 1, 3])
    assert len(part.marks) == kept.sum() and len(part.control_points) == len(scene.control_points)


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="positive definite"):
        CameraPositions([0], np.zeros((1, 3)), np.zeros((1, 3, 3)))
    with pytest.raises(InputError, match="unique"):
        ControlPoints(("a", "a"), np.zeros((2, 3)), np.zeros((2, 3)), np.stack([np.eye(3)] * 2), [1, 1])
    with pytest.raises(InputError, match="from itself"):
        Distances.between(Kind.IMAGE, [2], [2], [1.0], [0.1])
    with pytest.raises(InputError, match=r"must be one of.*row 0 is 4"):
        Distances([4], [0], [4], [1], np.zeros((1, 3)), [1.0], [0.1])
    with pytest.raises(InputError, match="unit vectors"):
        KnownDirections([0], [0], [[0, 0, 2.0]], [[0, 0, 1.0]], [0.1])
    with pytest.raises(InputError, match=r"held\.idx.*9.*lines"):
        made()[0].replace(held=Held([Kind.LINE], [9]))
    with pytest.raises(InputError, match=r"Marks\.sigma"):
        Marks([0], [0], np.zeros((1, 2)), [0.0])
