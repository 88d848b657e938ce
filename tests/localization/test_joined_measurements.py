# SPDX-License-Identifier: BSD-3-Clause
"""What was measured of a map in a map that it was joined to: kept, moved, or left out and said."""

from types import SimpleNamespace

import numpy as np
import pytest
from worlds import CAMERA

from groma.adjustment.terms.principal_points import near_the_middle
from groma.geometry import quaternion, so3
from groma.localization.joining.measurements import with_measurements_of
from groma.localization.registered import with_queries
from groma.localization.stored import StoredImage
from groma.scene import (
    CameraPositions,
    Cameras,
    ControlPoints,
    Distances,
    Held,
    KnownDirections,
    LineDepths,
    LineObservations,
    Lines,
    Marks,
    PlaneObservations,
    Planes,
    PointDepths,
    PointObservations,
    Points,
    RightColumns,
    Scene,
    Similarity,
)
from groma.scene.survey import CHECK, CONTROL, UNKNOWN, Kind

#: The world of the second map, seen from the first.
MOTION = Similarity(0.4, so3.exp(np.array([0.3, -0.5, 1.0])), np.array([1.0, 2.0, 3.0]))
#: Images of the joint map that were in the second; the first image is in both maps.
IMAGES, FRESH = np.array([0, 3, 4, 5]), np.array([False, True, True, True])


@pytest.fixture
def joint():
    """Six cameras before twenty points, all seen by all of them."""
    rng = np.random.default_rng(0)
    poses = np.hstack([quaternion.from_matrix(so3.exp(rng.normal(0, 0.05, (6, 3)))), rng.uniform(-0.5, 0.5, (6, 3))])
    xyz = rng.uniform([-1, -1, 4], [1, 1, 6], (20, 3))
    scene = Scene.from_images(CAMERA.table(), [f"{k}.jpg" for k in range(6)], np.zeros(6, int), poses)
    pixel = np.concatenate([CAMERA.project(pose, xyz) for pose in poses])
    seen = PointObservations.numbered(np.repeat(np.arange(6), 20), np.tile(np.arange(20), 6), pixel)
    points = Points(np.arange(20) + 1, xyz, np.zeros((20, 3), np.uint8), np.zeros(20))
    return scene.replace(points=points, point_observations=seen)


def second_of(joint):
    """The second map in its own world, with points in another order."""
    return joint.subset(IMAGES).keep(points=np.arange(20)[::-1]).transformed(MOTION.inverse())


def positions(scene, rows, sigma=0.01):
    return CameraPositions(rows, scene.cam_centers_in_world[rows], np.tile(sigma**2 * np.eye(3), (len(rows), 1, 1)))


def joined(joint, second, first=None):
    return with_measurements_of(joint, first or joint, second, MOTION, IMAGES, FRESH)


def test_nothing_was_measured(joint):
    out, sentence = joined(joint, second_of(joint))
    assert sentence == "" and not out.num_measurements


def test_places_go_along_where_the_first_map_has_none(joint):
    second = second_of(joint)
    down = np.array([[0, 0, -1.0]])
    second = second.replace(
        camera_positions=positions(second, [0, 1, 3]),
        known_directions=KnownDirections([Kind.IMAGE], [2], down, down, [0.01]),
        distances=Distances.between(Kind.IMAGE, [1], [3], [2.0], [0.1]),
    )
    out, sentence = joined(joint, second)
    # The first image is known to the first map, which has measured nothing there; its place is left out.
    assert out.camera_positions.image_idx.tolist() == [3, 5] and sentence.endswith("left out: 1 camera position.")
    np.testing.assert_allclose(out.camera_positions.xyz, joint.cam_centers_in_world[[3, 5]], atol=1e-12)
    np.testing.assert_allclose(out.camera_positions.covariance[0], (0.4 * 0.01) ** 2 * np.eye(3), atol=1e-15)
    np.testing.assert_allclose(out.known_directions.vector, down @ MOTION.rotation.T)
    assert out.known_directions.idx.tolist() == [4]
    assert (out.distances.first_idx.tolist(), out.distances.second_idx.tolist()) == ([3], [5])
    np.testing.assert_allclose([out.distances.distance[0], out.distances.sigma[0]], [0.8, 0.04])


def test_lengths_stay_where_both_maps_know_their_unit(joint):
    second = second_of(joint)
    second = second.replace(distances=Distances.between(Kind.IMAGE, [1], [3], [2.0], [0.1]))
    first = joint.replace(distances=Distances.between(Kind.IMAGE, [0], [1], [3.0], [0.1]))
    out, sentence = joined(first, second)
    assert out.distances.distance.tolist() == [3.0, 2.0] and not sentence


@pytest.mark.parametrize("same", [True, False])
def test_places_of_both_hold_in_one_world(joint, same):
    """The same frame of a survey, or two with their own origins."""
    first = joint.replace(camera_positions=positions(joint, [0, 1, 2]))
    other = second_of(joint)
    motion = Similarity(1.0, np.eye(3), np.array([0.002, 0.0, 0.0])) if same else MOTION
    other = joint.subset(IMAGES).transformed(motion.inverse())
    other = other.replace(camera_positions=positions(other, [1, 2, 3]))
    out, sentence = with_measurements_of(first, first, other, motion, IMAGES, FRESH)
    assert len(out.camera_positions) == (6 if same else 3)
    if same:  # as measured, not where the motion puts it
        np.testing.assert_array_equal(out.camera_positions.xyz[3:], other.camera_positions.xyz)
        assert not sentence
    else:
        assert "3 camera positions. Its places were not measured in the world of the first map." in sentence


def test_control_points_are_known_by_name(joint):
    def marked(scene, names, role, image):
        many = np.zeros((len(names), 3))
        points = ControlPoints(names, many, many + 1.0, np.tile(np.eye(3), (len(names), 1, 1)), role)
        return scene.replace(
            control_points=points,
            marks=Marks(
                [image] * len(names), np.arange(len(names)), np.full((len(names), 2), 9.0), np.ones(len(names))
            ),
        )

    first = marked(joint, ("a", "b"), [CONTROL, UNKNOWN], 1)
    second = marked(second_of(joint), ("c", "b", "a"), [CHECK, CONTROL, CHECK], 2)
    out, sentence = joined(first, second)
    assert not sentence and out.control_points.names == ("a", "b", "c")
    assert out.control_points.role.tolist() == [CONTROL, CONTROL, CHECK]
    assert out.marks.image_idx.tolist() == [1, 1, 4, 4, 4] and out.marks.point_idx.tolist() == [0, 1, 2, 1, 0]
    np.testing.assert_allclose(out.control_points.measured[1], MOTION.points(np.ones((1, 3)))[0])
    np.testing.assert_array_equal(out.control_points.measured[0], np.ones(3))


def test_depths_are_of_the_points_that_the_same_features_show(joint):
    second = second_of(joint)
    seen = second.point_observations
    rows = np.flatnonzero(seen.image_idx == 2)[:5]
    depths = PointDepths(seen.image_idx[rows], seen.point_idx[rows], np.full(5, 10.0), np.full(5, 0.5))
    columns = RightColumns(rows, seen.pixel[rows, 0] - 20.0, np.full(5, 0.25))
    gone = joint.keep(point_observations=np.arange(120) != 4 * 20 + int(19 - seen.point_idx[rows[0]]))
    out, sentence = joined(gone, second.replace(point_depths=depths, right_columns=columns))
    np.testing.assert_array_equal(out.point_depths.point_idx, 19 - seen.point_idx[rows[1:]])
    assert set(out.point_depths.image_idx.tolist()) == {4}
    np.testing.assert_allclose(out.point_depths.depth, 4.0)
    assert out.point_observations.image_idx[out.right_columns.observation_idx].tolist() == [4] * 4
    np.testing.assert_allclose(out.right_columns.baseline, 0.1)
    assert "1 point depth, 1 right column" in sentence


def test_lenses_that_were_not_calibrated_stay_so(joint):
    """Those of the second map that the first does not have; its own the first knows."""
    own = Cameras.of([1, 2], ["SIMPLE_PINHOLE"] * 2, [[500.0, 320.0, 240.0]] * 2, [[640, 480]] * 2)
    whole = Scene.from_images(own, [f"{k}.jpg" for k in range(6)], [0, 0, 0, 1, 1, 1], joint.cam_from_world)
    second = near_the_middle(whole.subset(IMAGES))
    first = Scene.from_images(own.take([0]), list("abc"), [0, 0, 0], joint.cam_from_world[:3])
    out, sentence = with_measurements_of(whole, first, second, MOTION, IMAGES, FRESH)
    assert out.principal_point_priors.camera_idx.tolist() == [1] and not sentence


def test_what_is_held_is_left_out(joint):
    out, sentence = joined(joint, second_of(joint).replace(held=Held([Kind.IMAGE], [1])))
    assert not len(out.held) and sentence.endswith("left out: 1 held object.")


def test_lines_and_planes_that_cameras_measured_go_along(joint):
    """With their landmarks, for the photographs that the first map lacks."""
    hesse, ends = (
        np.array([[0.0, 0, 1, -5], [1.0, 0, 0, -2]]),
        np.array([[[0.0, 0, 5], [1, 0, 5]], [[0, 0, 4], [0, 1, 4.0]]]),
    )
    whole = joint.replace(planes=Planes([3, 7], hesse), lines=Lines.through(ends))
    second = whole.subset(IMAGES, 0).transformed(MOTION.inverse())
    segments = np.arange(8.0).reshape(2, 4)
    second = second.replace(
        line_observations=LineObservations([2, 0], [1, 0], segments, [1.0, 1.0]),
        line_depths=LineDepths([0, 1], [[0.1, 0.2], [0.3, 0.4]], np.full((2, 2), 0.01), [0.5, 0.5]),
        plane_observations=PlaneObservations(
            [0, 3], [0, 1], [[0.0, 0, 1, -1], [0.0, 1, 0, -1]], np.stack([np.eye(3)] * 2)
        ),
    )
    out, sentence = joined(whole, second)
    assert sentence.endswith("left out: 1 line depth, 1 plane observation.")  # of the image that the first map knows
    assert out.planes.ids.tolist() == [3, 7, 8, 9] and out.num_lines == 4
    np.testing.assert_allclose(out.planes.hesse[3], hesse[1], atol=1e-12)
    np.testing.assert_allclose(out.lines.segments[2:], ends, atol=1e-12)
    row = int(out.line_depths.observation_idx[0])
    assert (out.line_observations.image_idx[row], out.line_observations.line_idx[row]) == (4, 3)
    np.testing.assert_allclose(out.line_depths.inverse_depth, [[0.1 / 0.4, 0.2 / 0.4]])
    assert (out.plane_observations.image_idx.tolist(), out.plane_observations.plane_idx.tolist()) == ([5], [3])
    np.testing.assert_allclose(out.plane_observations.plane_in_cam, [[0, 1, 0, -0.4]])


def test_depths_of_a_map_stay_with_its_segments_beside_those_of_queries(joint):
    segments = np.arange(8.0).reshape(2, 4)
    scene = joint.replace(
        lines=Lines.through(np.array([[[0.0, 0, 5], [1, 0, 5]]])),
        line_observations=LineObservations([2, 0], [0, 0], segments, [1.0, 1.0]),
        line_depths=LineDepths([0, 1], [[0.1, 0.2], [0.3, 0.4]], np.full((2, 2), 0.01), [0.5, 0.5]),
    )
    query = StoredImage(
        "new.jpg", "localized", "", np.array([0.0, 0, 0, 1, 0, 0, 0]), np.eye(6), "PINHOLE",
        np.array([500.0, 500, 320, 240]), np.array([640, 480]), np.array([0]), np.ones((1, 2)), np.array([0]),
        np.ones((1, 4)), 0.0,
    )  # fmt: skip
    out = with_queries(scene, SimpleNamespace(xyz=scene.points.xyz), [query])
    assert out.line_observations.image_idx.tolist() == [2, 0, scene.num_images]
    np.testing.assert_array_equal(out.line_observations.segment[out.line_depths.observation_idx], segments)
    alone = out.subset([scene.num_images])
    assert (len(alone.line_observations), len(alone.line_depths)) == (1, 0)
