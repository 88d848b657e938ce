# SPDX-License-Identifier: BSD-3-Clause
"""Where the 3D view starts: everything that counts is in the picture, fills it, and outliers change nothing much."""

import numpy as np
import pytest
from _scene import exact_scene

from groma.geometry import se3
from groma.scene import Lines, Points, Scene
from groma.scene.local_frame import up_of, upward
from groma.scene.survey import CameraPositions
from groma.scene.synthetic.scenes import holistic
from groma.viz.drawable import drawable
from groma.viz.framing import FOR_CAMERAS, OPENING, StartingView, horizontal, starting_view


def _seen(view: StartingView, places: np.ndarray) -> np.ndarray:
    """Places (N, 2) in the picture of the page, whose borders are at one; the formulas of its viewer."""
    first, second = horizontal(view.up)
    ca, sa, ce, se = (f(a) for a in (view.azimuth, view.elevation) for f in (np.cos, np.sin))
    back = ce * (ca * first + sa * second) + se * view.up
    right = np.cross(view.up, back) / ce
    at = places - (view.pivot + view.distance * back)
    depth = -at @ back
    assert (depth > 0).all()
    return np.stack([at @ right, at @ np.cross(back, right)], axis=1) / depth[:, None] / OPENING


def _view(scene: Scene) -> StartingView:
    return starting_view(drawable(scene), np.zeros(3))


def _landmarks(scene: Scene) -> np.ndarray:
    return np.concatenate([scene.points.xyz, scene.lines.segments.reshape(-1, 3)])


@pytest.mark.parametrize("scene", [holistic(10, seed=1).truth, exact_scene()], ids=["room", "box"])
def test_the_landmarks_fill_the_picture(scene):
    at = np.abs(_seen(_view(scene), _landmarks(scene)))
    assert (at <= 1).all(axis=1).mean() > 0.9
    assert at.max() > 0.9 / FOR_CAMERAS


def test_cameras_are_in_the_picture_where_that_makes_nothing_small():
    scene = holistic(10, seed=1).truth
    centers = drawable(scene).centers
    near = scene.frames.rig_from_world.copy()  # the same rotations, in the middle of the room
    near[:, 4:] = 0.1 * near[:, 4:] - 0.9 * se3.to_matrix(near)[:, :3, :3] @ np.median(_landmarks(scene), axis=0)
    among = scene.replace(frames=scene.frames.replace(rig_from_world=near))
    assert (np.abs(_seen(_view(among), drawable(among).centers)) <= 1).all()
    far = scene.frames.rig_from_world.copy()
    far[:, 4:] *= 30.0
    gone = _view(scene.replace(frames=scene.frames.replace(rig_from_world=far)))
    assert gone.distance < 2.0 * _view(scene).distance < 0.2 * 30.0 * np.linalg.norm(centers, axis=1).max()
    at = np.abs(_seen(gone, _landmarks(scene)))
    assert (at <= 1).all(axis=1).mean() > 0.9 and at.max() > 0.5


def test_outliers_do_not_count():
    """Points and lines gone to the horizon leave the view where it was, to a little."""
    scene = holistic(10, seed=1).truth
    rng = np.random.default_rng(0)
    xyz, segments = scene.points.xyz.copy(), scene.lines.segments.copy()
    wild = rng.choice(len(xyz), len(xyz) // 10, replace=False)  # more than one in twenty
    xyz[wild] = 1e3 * rng.normal(size=(len(wild), 3))
    segments[0] += 1e4
    gone = scene.replace(points=Points.at(xyz), lines=Lines.through(segments))
    view, calm = starting_view(drawable(gone), np.zeros(3)), _view(scene)
    assert view.distance == pytest.approx(calm.distance, rel=0.25)
    assert np.linalg.norm(view.pivot - calm.pivot) < 0.25 * calm.distance


def test_one_stray_camera_among_many_does_not_count():
    scene = holistic(60, seed=1).truth
    poses = scene.frames.rig_from_world.copy()
    poses[7, 4:] += 1e3
    stray = scene.replace(frames=scene.frames.replace(rig_from_world=poses))
    assert _view(stray).distance == pytest.approx(_view(scene).distance, rel=0.25)


def test_scenes_with_little_in_them():
    empty = starting_view(drawable(Scene()), np.ones(3))
    np.testing.assert_array_equal(empty.pivot, 1)
    assert empty.distance > 0
    one = _view(Scene(points=Points.at(np.ones((1, 3)))))
    np.testing.assert_allclose(one.pivot, 1)
    assert one.distance > 0


def test_up():
    turned = np.diag([1.0, -1.0, -1.0])
    np.testing.assert_allclose(upward(np.eye(3)[None]), [0, -1, 0])
    np.testing.assert_allclose(upward(np.array([np.eye(3), turned])), [0, 0, 1])  # upside down, and to the other side
    np.testing.assert_allclose(upward(np.zeros((0, 3, 3))), [0, 0, 1])
    # From above, on the way there and back: up is where they were taken.
    there, back = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]), np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
    np.testing.assert_allclose(upward(np.array([there, back])), [-1, 0, 0])
    np.testing.assert_allclose(
        upward(np.array([there, back, there])), [-1, 0, 0]
    )  # a strip more one way than the other
    # A telephone before a wall, every second time held upright: a mean of both, but not across the wall.
    np.testing.assert_allclose(upward(np.array([np.eye(3), [[0, -1, 0], [1, 0, 0], [0, 0, 1]]]))[2], 0)


def test_where_heights_are_measured_z_is_up():
    """Photographs from above whose tops are all to the north."""
    made, rng = exact_scene(), np.random.default_rng(1)
    poses = np.array([[1.0, 0, 0, 0, 0, 0, 10], [1.0, 0, 0, 0, -1, 0, 10]])  # x to the east, y to the south, z down
    points = Points.at(np.column_stack([rng.uniform(-3, 4, (40, 2)), 0.1 * rng.normal(size=40)]))
    scene = Scene.from_images(made.cameras, ("a.jpg", "b.jpg"), [0, 1], poses, points=points)
    np.testing.assert_allclose(up_of(scene), [0, 1, 0], atol=1e-12)  # nothing says otherwise
    measured = CameraPositions(np.arange(2), scene.cam_centers_in_world, np.tile(0.01 * np.eye(3), (2, 1, 1)))
    surveyed = scene.replace(camera_positions=measured)
    np.testing.assert_array_equal(up_of(surveyed), [0, 0, 1])
    assert _view(surveyed).elevation > 0.6  # the ground is seen as from a hill, not as a wall


@pytest.mark.parametrize("far", [1e40, 1e308])
def test_points_beyond_single_precision_move_nothing(far):
    scene = exact_scene()
    xyz = scene.points.xyz.copy()
    xyz[0] = [far, -far, far]
    with np.errstate(over="ignore", invalid="ignore"):
        view = _view(scene.with_points(xyz))
    assert np.isfinite(view.camera_size)
    assert view.distance == pytest.approx(_view(scene).distance, rel=0.1)  # one of twelve points is not in it
