# SPDX-License-Identifier: BSD-3-Clause
"""The scene as a value: validation messages, poses through rigs, new scenes from old, comparison with reasons."""

import numpy as np
import pytest
from _comparison import equal, near

from groma.errors import InputError, ShapeError
from groma.evaluation.trajectory import apply_similarity
from groma.geometry import quaternion, se3, sim3, transform
from groma.scene import (
    Cameras,
    Directions,
    Frames,
    Lines,
    Planes,
    PointObservations,
    Points,
    Relations,
    Scene,
    Similarity,
)
from groma.scene.synthetic.noise import project_pinhole
from groma.scene.synthetic.scenes import holistic


@pytest.fixture(scope="module")
def made():
    return holistic(12, seed=5)


def some_similarity(seed: int = 1) -> Similarity:
    rng = np.random.default_rng(seed)
    turn = quaternion.exp(rng.normal(0, 1, (1, 3)))[0]
    return Similarity(2.5, quaternion.to_matrix(turn), rng.normal(0, 5, 3))


def residuals(scene: Scene) -> np.ndarray:
    seen = scene.point_observations
    poses = scene.cam_from_world[seen.image_idx]
    return project_pinhole(scene.cameras.params[0], poses, scene.points.xyz[seen.point_idx])[0] - seen.pixel


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Points([1, 1], np.zeros((2, 3)), np.zeros((2, 3), int), [0, 0]), InputError, "must be unique; 1"),
        (lambda: Points([1], np.zeros((1, 2)), np.zeros((1, 3), int), [0]), ShapeError, r"shape \(N, 3\)"),
        (lambda: Points([1], np.zeros((2, 3)), np.zeros((1, 3), int), [0]), ShapeError, "equally long"),
        (lambda: Points([1], [[0, np.inf, 0]], np.zeros((1, 3), int), [0]), InputError, "row 0 is"),
        (lambda: Points([1], np.zeros((1, 3)), [[0, 0, 256]], [0]), InputError, "uint8"),
        (lambda: Points([1], np.zeros((1, 3), complex), np.zeros((1, 3), int), [0]), InputError, "numbers"),
        (lambda: Points([0.5], np.zeros((1, 3)), np.zeros((1, 3), int), [0]), InputError, "integers"),
        (lambda: Planes([1], [[1, 1, 0, 0.0]]), InputError, "unit vectors"),
        (lambda: Directions([1], [[0, 0, 2.0]]), InputError, "unit vectors"),
        (lambda: Lines([1], [[1, 0, 0, 1, 0, 0.0]], np.zeros((1, 2, 3))), InputError, "perpendicular"),
        (lambda: Lines.through(np.zeros((1, 2, 3))), InputError, "no length"),
        (lambda: Cameras([1], ("NOTHING",), [[1.0]], [0], [0]), InputError, "PINHOLE"),
        (lambda: Scene(frames=Frames([1], [0], [[0, 0, 0, 1, 0, 0, 0]])), InputError, "there are no rigs"),
        (lambda: Scene(relations=Relations(point_on_line=[[0, 0]])), InputError, "not in the scene"),
        (lambda: Scene(point_observations=PointObservations([0], [0], [[1, 2]], [0])), InputError, "no images"),
        (lambda: Similarity(-1.0), InputError, "positive scale"),
        (lambda: Similarity(1.0, np.diag([1, 1, -1.0])), InputError, "rotation matrix"),
    ],
)
def test_messages(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_dangling_observation_names_row_value_and_range(made):
    seen = made.truth.point_observations
    point_idx = seen.point_idx.copy()
    point_idx[7] = 120
    with pytest.raises(InputError, match=r"point_idx\[7\] is 120, which is not in the scene \(points: 0-119\)"):
        made.truth.replace(point_observations=seen.replace(point_idx=point_idx))


def test_counts(made):
    scene = made.truth
    counts = (
        scene.num_images,
        scene.num_points,
        scene.num_lines,
        scene.num_planes,
        scene.num_cameras,
        scene.num_frames,
    )
    assert counts == (12, 120, 12, 2, 1, 12)
    assert scene.num_observations == scene.num_point_observations + scene.num_line_observations
    assert Scene().num_observations == 0


def test_poses_and_centers(made):
    poses = made.truth.cam_from_world
    np.testing.assert_allclose(np.linalg.norm(made.truth.cam_centers_in_world, axis=1), 5.0, rtol=1e-12)
    np.testing.assert_allclose(made.truth.cam_centers_in_world, se3.inverse(poses)[:, 4:], atol=1e-12)
    changed = made.truth.with_poses(made.start.cam_from_world)
    np.testing.assert_array_equal(changed.cam_from_world, made.start.cam_from_world)
    np.testing.assert_array_equal(made.truth.cam_from_world, poses)


def test_transformed_world_leaves_reprojections(made):
    change = some_similarity()
    moved = made.truth.transformed(change)
    np.testing.assert_allclose(residuals(moved), residuals(made.truth), atol=1e-9)
    lines = Lines.through(moved.lines.segments)
    np.testing.assert_allclose(moved.lines.plucker, lines.plucker, atol=1e-12)
    on_plane = moved.relations.point_on_plane
    points, planes = moved.points.xyz[on_plane[:, 0]], moved.planes.hesse[on_plane[:, 1]]
    np.testing.assert_allclose((points * planes[:, :3]).sum(1) + planes[:, 3], 0, atol=1e-12)
    back = near(moved.transformed(change.inverse()), made.truth, 1e-12)
    assert back, back.reason


def test_subset_keeps_what_is_seen(made):
    chosen = [3, 0, 7]
    part = made.truth.subset(chosen, min_observations=2)
    assert part.images.names == tuple(made.truth.images.names[row] for row in chosen)
    np.testing.assert_array_equal(part.cam_from_world, made.truth.cam_from_world[chosen])
    assert np.bincount(part.point_observations.point_idx, minlength=part.num_points).min() >= 2
    seen, old = part.point_observations, made.truth.point_observations
    known = {
        (name, number): tuple(pixel)
        for name, number, pixel in zip(
            made.truth.images.ids[old.image_idx], made.truth.points.ids[old.point_idx], old.pixel, strict=True
        )
    }
    for image, point, pixel in zip(seen.image_idx, seen.point_idx, seen.pixel, strict=True):
        assert known[part.images.ids[image], part.points.ids[point]] == tuple(pixel)
    whole = equal(made.truth.subset(np.ones(12, bool)), made.truth)
    assert whole, whole.reason
    assert made.truth.subset([0], min_observations=0).num_points == 120


def test_keep_takes_relations_and_observations_along(made):
    """By identifiers: what lay on what before still does, and nothing else does."""
    scene = made.truth
    planes = scene.num_planes - 1 - np.arange(scene.num_planes - 1)  # all but the first, backwards
    points = scene.points.ids % 3 != 0
    part = scene.keep(points=points, planes=planes)
    np.testing.assert_array_equal(part.planes.ids, scene.planes.ids[planes])
    np.testing.assert_array_equal(part.points.ids, scene.points.ids[points])
    assert part.lines is scene.lines and part.line_observations is scene.line_observations

    def named(table, first, second):
        return set(zip(first.ids[table[:, 0]].tolist(), second.ids[table[:, 1]].tolist(), strict=True))

    left = {number for number in scene.points.ids.tolist() if number % 3}
    stay = set(part.planes.ids.tolist())
    before = named(scene.relations.point_on_plane, scene.points, scene.planes)
    after = named(part.relations.point_on_plane, part.points, part.planes)
    assert after == {(point, plane) for point, plane in before if point in left and plane in stay} and after
    on_lines = named(part.relations.point_on_line, part.points, part.lines)
    assert {point for point, _ in on_lines} <= left
    seen = part.point_observations
    assert len(seen) == points[scene.point_observations.point_idx].sum()
    np.testing.assert_array_equal(
        seen.pixel, scene.point_observations.pixel[points[scene.point_observations.point_idx]]
    )
    with pytest.raises(InputError, match="points"):
        scene.keep(points=[scene.num_points])


def test_observations_are_numbered_within_their_image():
    made = PointObservations.numbered([1, 0, 1, 1, 0], [0, 1, 2, 3, 4], np.zeros((5, 2)))
    np.testing.assert_array_equal(made.keypoint_idx, [0, 0, 1, 2, 1])
    assert len(PointObservations.numbered([], [], [])) == 0
    np.testing.assert_array_equal(made.sigma, 1.0)
    unlike = PointObservations.numbered([1, 0], [0, 1], np.zeros((2, 2)), [2.0, 3.0])
    np.testing.assert_array_equal(unlike.sigma, [2.0, 3.0])


def test_lines_carry_their_end_points_along():
    rng = np.random.default_rng(2)
    lines = Lines.through(rng.normal(0, 3, (20, 2, 3)))
    np.testing.assert_allclose(lines.moved_to(-3 * lines.plucker).segments, lines.segments, atol=1e-12)
    target = Lines.through(rng.normal(0, 3, (20, 2, 3)))
    moved = lines.moved_to(7 * target.plucker)
    np.testing.assert_allclose(moved.plucker, target.plucker, atol=1e-12)
    ends, direction = moved.segments, target.plucker[:, None, 3:]
    np.testing.assert_allclose(np.cross(ends, direction), np.repeat(target.plucker[:, None, :3], 2, 1), atol=1e-11)
    # Feet: what separates old and new end points is perpendicular to the new line.
    assert np.abs(((ends - lines.segments) * direction).sum(-1)).max() < 1e-12


def test_with_planes_scales_to_unit_normals(made):
    planes = made.truth.planes.hesse
    np.testing.assert_allclose(made.truth.with_planes(5 * planes).planes.hesse, planes, atol=1e-15)
    with pytest.raises(InputError, match="infinity"):
        made.truth.with_planes(0 * planes)


def test_with_poses_needs_single_images(made):
    scene = made.truth
    frame_idx = scene.images.frame_idx.copy()
    frame_idx[1] = 0
    with pytest.raises(InputError, match="with_rig_poses"):
        scene.replace(images=scene.images.replace(frame_idx=frame_idx)).with_poses(scene.cam_from_world)


def test_comparison_gives_reasons(made):
    moved = made.truth.with_points(made.truth.points.xyz + 1e-7)
    assert equal(made.truth, made.truth)
    assert "points.xyz[0]" in equal(made.truth, moved).reason
    assert near(made.truth, moved, 1e-6)
    assert "points.xyz" in near(made.truth, moved, 1e-8).reason
    assert "shape" in near(made.truth, made.truth.points_only()).reason
    poses = made.truth.cam_from_world
    poses[:, :4] *= -1
    assert not equal(made.truth, made.truth.with_poses(poses))
    assert near(made.truth, made.truth.with_poses(poses))


def test_arguments_are_not_changed():
    xyz = np.arange(6.0).reshape(2, 3)
    before = xyz.copy()
    scene = Scene(points=Points.at(xyz)).transformed(some_similarity())
    np.testing.assert_array_equal(xyz, before)
    assert scene.num_points == 2


def test_a_scene_is_shown_by_its_counts():
    scene = holistic(6, seed=0).truth
    assert repr(Scene()) == "Scene(empty)"
    assert repr(scene) == (
        f"Scene(6 images, {scene.num_cameras} cameras, {scene.num_points} points, {scene.num_lines} lines, "
        f"{scene.num_planes} planes, {scene.num_observations} observations)"
    )
    assert repr(scene.points) == f"Points({scene.num_points} rows: ids, xyz, color, error)"


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        (np.ones(5, bool), r"must have shape \(6,\)"),
        (["00001.png"], "must be integers or a mask"),
        ([0.0, 1.0], "must be integers or a mask"),
        ([[0, 1]], r"must have shape \(n,\)"),
        ([0, 6], "not in the scene"),
        ([-1], "not in the scene"),
    ],
    ids=str,
)
def test_what_cannot_be_chosen(chosen, words):
    scene = holistic(6, seed=0).truth
    with pytest.raises(InputError, match=words):
        scene.subset(chosen)
    with pytest.raises(InputError, match=words):
        scene.images.take(chosen)


def test_choices_by_number_and_by_mask_are_the_same():
    scene = holistic(6, seed=0).truth
    mask = np.array([True, False, True, False, False, True])
    assert equal(scene.subset(mask), scene.subset([0, 2, 5]))
    assert len(scene.images.take([])) == 0 and len(scene.images.take(np.int32(3))) == 1


def test_a_similarity_has_one_array():
    """The form of :mod:`groma.geometry.sim3`, both ways; scenes and poses take either."""
    array = sim3.exp(np.array([0.3, -1.0, 2.0, 0.4, 0.5, -0.6, 0.7]))
    friendly = Similarity.from_array(array)
    np.testing.assert_allclose(friendly.to_array(), array, atol=1e-15)
    np.testing.assert_allclose(friendly.inverse().to_array(), sim3.inverse(array), atol=1e-14)
    made = holistic(3, seed=1).truth
    moved, same = made.transformed(friendly), made.transformed(array)
    np.testing.assert_array_equal(moved.points.xyz, same.points.xyz)
    np.testing.assert_allclose(moved.points.xyz, sim3.apply(array, made.points.xyz), atol=1e-12)
    np.testing.assert_allclose(moved.lines.plucker, transform.similarity_lines(array, made.lines.plucker), atol=1e-12)
    np.testing.assert_allclose(moved.planes.hesse, transform.similarity_planes(array, made.planes.hesse), atol=1e-12)
    poses = se3.inverse(made.cam_from_world)
    np.testing.assert_array_equal(apply_similarity(array, poses), apply_similarity(friendly, poses))
    with pytest.raises(ShapeError, match=r"shape \(8,\)"):
        Similarity.from_array(array[:7])
