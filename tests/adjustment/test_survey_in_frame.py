# SPDX-License-Identifier: BSD-3-Clause
"""Scenes brought into the frame of measurements, files that do not fit, and alignment without an adjustment."""

from dataclasses import replace

import numpy as np
import pytest
from _survey import ELSEWHERE, SIGMA, control_file, made, measured_positions, places_of, with_everything

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.moved_problem import problem_at
from groma.adjustment.survey.align import align
from groma.adjustment.survey.attach import Survey, with_survey
from groma.adjustment.survey.reliability import reliability
from groma.adjustment.survey.similarity import robust_similarity
from groma.errors import InputError
from groma.io.survey import DistancesFile
from groma.problem.residuals import residuals_of
from groma.scene import Similarity

LEAST_SQUARES = AdjustOptions(loss="none", point_sigma_px=0.5, check_lens=False)
UTM = np.array([4e5, 5.4e6, 200.0])


@pytest.fixture(scope="module")
def truth_and_start():
    return made()


def test_positions_bring_a_scene_into_their_frame(truth_and_start):
    truth, _ = truth_and_start
    given = measured_positions(truth, np.random.default_rng(5))
    found = with_survey(truth.transformed(ELSEWHERE), Survey(positions=given))
    off = found.scene.cam_centers_in_world - truth.cam_centers_in_world
    assert np.abs(off).max() < 3 * SIGMA and found.alignment.inliers.all()
    assert found.similarity.scale == pytest.approx(1 / ELSEWHERE.scale, rel=0.01)
    assert len(found.scene.camera_positions) == truth.num_images and "similarity" in found.notes[-1]


def test_an_adjustment_with_positions_is_better_than_either(truth_and_start):
    truth, start = truth_and_start
    rng = np.random.default_rng(5)
    given = measured_positions(truth, rng)
    before = with_survey(start.transformed(ELSEWHERE), Survey(positions=given)).scene
    after = adjust(before, LEAST_SQUARES).scene
    errors = [
        np.linalg.norm(c - truth.cam_centers_in_world, axis=1)
        for c in (given.coordinates, before.cam_centers_in_world, after.cam_centers_in_world)
    ]
    rms = [float(np.sqrt(np.mean(e**2))) for e in errors]
    assert rms[2] < 0.8 * rms[0] and rms[2] < rms[1]


def test_positions_of_unknown_accuracy_have_the_noise_that_they_show(truth_and_start):
    """Of twelve cameras nine heights and twenty others are to spare, from which noise is known: three times that."""
    truth, rng = made(images=12)[0], np.random.default_rng(5)
    noise = rng.normal(size=(truth.num_images, 3)) * [0.01, 0.01, 0.03]
    given = places_of(truth.images.names, truth.cam_centers_in_world + noise, np.nan)
    given = replace(given, usual_sigma=(5.0, 5.0, 10.0), source="EXIF")
    elsewhere = truth.transformed(ELSEWHERE)

    def deviations(survey):
        found = with_survey(elsewhere, survey)
        told = [note for note in found.notes if "share does not show" in note]
        return np.sqrt(np.diagonal(found.scene.camera_positions.covariance, axis1=1, axis2=2))[0], told

    sigma, told = deviations(Survey(positions=given))
    for found, true, spare in zip(sigma[1:], (0.01, 0.03), (20, 9), strict=True):
        assert found == pytest.approx(true, rel=3 / np.sqrt(2 * spare))
    assert len(told) == 1 and "(5, 10)" in told[0]
    for survey, usual in (
        (Survey(positions=given, position_sigma=(0.2,)), [0.2] * 3),  # the user knows
        (
            Survey(positions=given, control=control_file(truth, rng)[0], control_sigma=(SIGMA,)),
            [5, 5, 10],
        ),  # what they share would contradict
        (Survey(positions=replace(given, sigma=np.full((12, 3), 0.5))), [0.5] * 3),  # the file knows
    ):
        assert deviations(survey) == (pytest.approx(usual), [])
    few, _ = truth_and_start
    given = replace(measured_positions(few, rng), sigma=np.full((8, 3), np.nan), usual_sigma=(5.0, 5.0, 10.0))
    found = with_survey(few, Survey(positions=given))
    assert found.scene.camera_positions.covariance[0, 0, 0] == pytest.approx(25.0)


def test_far_from_the_origin_nothing_changes(truth_and_start):
    """The same scene, measured in coordinates of UTM: the same steps and the same result, shifted."""
    truth, start = truth_and_start
    near, far = (
        with_survey(start, Survey(positions=measured_positions(truth, np.random.default_rng(5), shift)))
        for shift in (0.0, UTM)
    )
    results = [adjust(one.scene, LEAST_SQUARES) for one in (near, far)]
    assert results[0].report.solve.iterations == results[1].report.solve.iterations
    assert results[1].report.solve.final_cost == pytest.approx(results[0].report.solve.final_cost, rel=1e-6)
    centers = [result.scene.cam_centers_in_world for result in results]
    np.testing.assert_allclose(centers[1] - UTM, centers[0], atol=1e-6)
    tests = [reliability(result.scene, result.problem) for result in results]
    for one, other in zip(tests[0].measurements, tests[1].measurements, strict=True):
        assert other.residual == pytest.approx(one.residual, abs=1e-6)
        assert other.normalized == pytest.approx(one.normalized, abs=1e-4)


def test_a_solved_problem_keeps_its_residuals_where_it_is_moved(truth_and_start):
    truth, _ = truth_and_start
    scene = with_everything(truth, np.random.default_rng(1))
    problem = assemble(scene, AssemblyOptions()).problem
    moved = problem_at(problem, scene.transformed(Similarity(translation=UTM)))
    for before, after in zip(problem.factors, moved.factors, strict=True):
        old, new = (residuals_of(f, p.variables) for f, p in ((before, problem), (after, moved)))
        np.testing.assert_allclose(new, old, atol=2e-5)


def test_control_points_bring_a_scene_into_their_frame(truth_and_start):
    truth, _ = truth_and_start
    given, xyz = control_file(truth, np.random.default_rng(2))
    found = with_survey(truth.transformed(ELSEWHERE), Survey(control=given, control_sigma=(SIGMA,)))
    points = found.scene.control_points
    assert points.role.tolist() == [1, 1, 1, 1, 2, 2] and points.covariance[0, 0, 0] == pytest.approx(SIGMA**2)
    assert np.abs(found.scene.cam_centers_in_world - truth.cam_centers_in_world).max() < 8 * SIGMA
    again = with_survey(
        truth, Survey(control=control_file(truth, np.random.default_rng(2), True)[0], control_sigma=(SIGMA,))
    )
    np.testing.assert_allclose(again.scene.marks.pixel, found.scene.marks.pixel, atol=1e-9)
    after = adjust(found.scene, LEAST_SQUARES).scene
    assert np.abs(after.control_points.xyz - xyz).max() < 3 * SIGMA


def test_a_scale_bar_gives_the_unit(truth_and_start):
    truth, _ = truth_and_start
    rng = np.random.default_rng(3)
    given, xyz = control_file(truth, rng)
    unknown = replace(given, places=replace(given.places, coordinates=np.full((6, 3), np.nan)))
    length = float(np.linalg.norm(xyz[4] - xyz[1]))
    bar = DistancesFile(("p1",), ("p4",), np.array([length]), np.array([1e-3]), "bars.csv")
    found = with_survey(truth.transformed(ELSEWHERE), Survey(control=unknown, distances=bar))
    after = adjust(found.scene, LEAST_SQUARES).scene.control_points.xyz
    assert np.linalg.norm(after[4] - after[1]) == pytest.approx(length, abs=1e-4)
    assert np.linalg.norm(after[2] - after[0]) == pytest.approx(np.linalg.norm(xyz[2] - xyz[0]), rel=0.01)
    by_cameras = replace(bar, first=(truth.images.names[0],), second=(truth.images.names[3],))
    centers = truth.cam_centers_in_world
    by_cameras = replace(by_cameras, distance=np.array([np.linalg.norm(centers[3] - centers[0])]))
    found = with_survey(truth.transformed(ELSEWHERE), Survey(distances=by_cameras))
    assert found.similarity.scale == pytest.approx(1 / ELSEWHERE.scale, rel=1e-9)


def test_collinear_positions_are_reported_and_cameras_are_upright():
    rng = np.random.default_rng(0)
    line = np.outer(np.linspace(0, 30, 12), [0.6, 0.8, 0.0]) + rng.normal(size=(12, 3)) * 0.01
    truth, _ = made(12)
    # camera axes: x to the right of the way, y down, z along it
    axes = np.array([[0.8, -0.6, 0.0], [0.0, 0.0, -1.0], [0.6, 0.8, 0.0]])
    from groma.geometry import quaternion

    pose = np.hstack([np.tile(quaternion.from_matrix(axes), (12, 1)), -(line @ axes.T)])
    scene = truth.with_poses(pose).keep(points=[])
    given = places_of(scene.images.names, line + rng.normal(size=line.shape) * SIGMA)
    found = with_survey(scene.transformed(ELSEWHERE), Survey(positions=given))
    assert any("are collinear" in note for note in found.notes)
    np.testing.assert_allclose(found.scene.cam_from_world[:, :4], scene.cam_from_world[:, :4], atol=0.01)


def test_gross_errors_do_not_move_the_similarity():
    rng = np.random.default_rng(4)
    source = rng.normal(size=(20, 3)) * [10, 10, 2]
    target = ELSEWHERE.points(source) + rng.normal(size=source.shape) * 0.01
    wrong = [3, 8, 9, 12, 17]
    target[wrong] += rng.normal(size=(5, 3)) * 30
    found = robust_similarity(source, target)
    assert np.flatnonzero(~found.inliers).tolist() == wrong
    assert found.scatter == pytest.approx(0.01, rel=0.35)
    assert found.similarity.scale == pytest.approx(ELSEWHERE.scale, abs=0.001)


def refused(scene, words, **survey):
    with pytest.raises(InputError, match=words):
        with_survey(scene, Survey(**survey))


def test_files_that_do_not_fit_say_why(truth_and_start):
    truth, _ = truth_and_start
    rng = np.random.default_rng(5)
    given = measured_positions(truth, rng)
    refused(
        truth,
        "none of its 8 names is an image.*nearest: 00001.png",
        positions=replace(given, names=tuple(f"{k:05d}x.png" for k in range(1, 9))),
    )
    refused(truth, "left-handed", positions=replace(given, coordinates=given.coordinates[:, [1, 0, 2]]))
    refused(truth, r"--position-sigma 0\.02", positions=replace(given, sigma=np.full((8, 3), np.nan)))
    refused(truth, "three are needed", positions=places_of(given.names[:2], given.coordinates[:2]))
    points, _ = control_file(truth, rng)
    refused(truth, "no control point.*nearest: p1", control=points, control_sigma=(1.0,), check=("q1",))
    refused(truth, "images of another size", control=replace(points, pixels=points.pixels * 3), control_sigma=(1.0,))
    bar = DistancesFile(("p0",), ("p7",), np.ones(1), np.ones(1), "bars.csv")
    refused(truth, "neither a control point nor an image", control=points, control_sigma=(1.0,), distances=bar)
    same = replace(bar, second=("p0",))
    refused(truth, "p0 and p0 are the same", control=points, control_sigma=(1.0,), distances=same)
    to_line = replace(bar, first=("00001.png",), second=("line:5",))
    refused(truth, "there is no line 5.*groma map finds lines first", distances=to_line)
    refused(truth, "--distance-sigma", distances=replace(bar, sigma=np.array([np.nan])))


def test_exchanged_longitudes_and_latitudes_are_told(truth_and_start):
    truth, _ = truth_and_start
    east, north, up = truth.cam_centers_in_world.T * 10
    degrees = np.column_stack([13.4 + east / 67700, 52.5 + north / 111270, up])
    right = places_of(truth.images.names, degrees, 1.0, "EPSG:4326")
    assert with_survey(truth, Survey(positions=right)).alignment.scatter < 0.2
    refused(truth, "longitude and latitude exchanged", positions=replace(right, coordinates=degrees[:, [1, 0, 2]]))


def test_exchanged_longitudes_and_latitudes_of_control_points_are_told(truth_and_start):
    truth, _ = truth_and_start
    points, _ = control_file(truth, np.random.default_rng(5))
    east, north, up = points.places.coordinates.T * 10
    degrees = np.column_stack([13.4 + east / 67700, 52.5 + north / 111270, up])
    for order in ([0, 1, 2], [1, 0, 2]):
        places = replace(places_of(points.places.names, degrees[:, order], 1.0, "EPSG:4326"))
        given = {"control": replace(points, places=places), "control_sigma": (1.0,)}
        if order[0] == 0:
            assert with_survey(truth, Survey(**given)).alignment.scatter < 0.5
        else:
            refused(truth, "longitude and latitude exchanged", **given)


def test_units_that_contradict_each_other_are_told(truth_and_start):
    """Feet among metres, heights in feet, millimetres of a tape: no noise, but a factor that people know."""
    truth, _ = truth_and_start
    rng = np.random.default_rng(5)
    given, (points, xyz) = measured_positions(truth, rng), control_file(truth, rng)
    feet = replace(points, places=replace(points.places, coordinates=points.places.coordinates / 0.3048))
    stated = {"positions": given, "control_sigma": (1.0,)}
    refused(truth, "positions are 0.30.* look like metres, the latter like feet", control=feet, **stated)
    heights = given.coordinates * [1.0, 1.0, 1.0 / 0.3048]
    refused(
        truth, "if their heights are in feet and the rest is in metres", positions=replace(given, coordinates=heights)
    )
    lower = given.coordinates * [1.0 / 0.3048, 1.0 / 0.3048, 1.0]
    refused(
        truth, "if their heights are in metres and the rest is in feet", positions=replace(given, coordinates=lower)
    )
    apart = np.linalg.norm(xyz[[1, 3]] - xyz[[0, 2]], axis=1)
    tape = DistancesFile(("p0", "p2"), ("p1", "p3"), 1000.0 * apart, np.ones(2), "tape.csv")
    words = "measured distances are .* the former look like millimetres, the latter like metres"
    refused(truth, words, control=points, control_sigma=(1.0,), distances=tape)
    refused(
        truth, words, control=points, distances=replace(tape, second=("p1", "p3"), distance=990.0 * apart), **stated
    )


@pytest.mark.parametrize("seed", range(6))
def test_bad_heights_are_no_other_unit(truth_and_start, seed):
    """Heights that are pure noise, as of photographs with GPS, would fit better the smaller they are made."""
    truth, _ = truth_and_start
    given = measured_positions(truth, np.random.default_rng(seed))
    noise = np.random.default_rng(seed).normal(size=(8, 3)) * [0.02, 0.02, 1.0]
    with_survey(truth, Survey(positions=replace(given, coordinates=given.coordinates + noise)))


def test_lengths_that_are_only_wrong_are_no_other_unit(truth_and_start):
    """A factor of two is a gross error, which the tests name; one unit alone cannot be wrong."""
    truth, _ = truth_and_start
    rng = np.random.default_rng(5)
    given, (points, xyz) = measured_positions(truth, rng), control_file(truth, rng)
    wrong = DistancesFile(("p0",), ("p1",), 2.0 * np.linalg.norm(xyz[1:2] - xyz[0], axis=1), np.ones(1), "tape.csv")
    with_survey(truth, Survey(positions=given, control=points, control_sigma=(1.0,), distances=wrong))
    with_survey(truth, Survey(positions=replace(given, coordinates=given.coordinates / 0.3048)))


def test_images_that_are_not_there_are_told(truth_and_start):
    truth, _ = truth_and_start
    given = measured_positions(truth, np.random.default_rng(5))
    found = with_survey(truth.subset(range(6)), Survey(positions=given))
    assert len(found.scene.camera_positions) == 6
    told = "2 positions of images that are not in the scene: "
    assert any(told + "00007.png, 00008.png." in note for note in found.notes)  # each other image has its own name
    mistyped = replace(given, names=("0001.png", *given.names[1:]))
    found = with_survey(truth.subset(range(6)), Survey(positions=mistyped))
    assert any("not in the scene: 0001.png (nearest: 00001.png), 00007.png" in note for note in found.notes)


def test_a_scene_in_place_stays(truth_and_start):
    truth, _ = truth_and_start
    rng = np.random.default_rng(5)
    scene = with_survey(truth, Survey(positions=measured_positions(truth, rng))).scene
    again = with_survey(scene, Survey(control=control_file(truth, rng)[0], control_sigma=(1.0,)))
    assert np.array_equal(again.scene.frames.rig_from_world, scene.frames.rig_from_world)
    assert len(again.scene.camera_positions) == 8 and len(again.scene.control_points) == 6


def test_a_scene_is_aligned_with_another_one(truth_and_start):
    """Two images are somewhere else in the reference; they are left out and named."""
    truth, _ = truth_and_start
    reference = truth.subset([5, 2, 7, 0, 3, 4])
    poses = reference.cam_from_world.copy()
    poses[1, 4:] += [3.0, 0.0, 1.0]
    found = align(truth.transformed(ELSEWHERE), reference.with_poses(poses))
    np.testing.assert_allclose(found.scene.cam_centers_in_world, truth.cam_centers_in_world, atol=1e-9)
    assert found.names == tuple(truth.images.names[k] for k in (0, 2, 3, 4, 5, 7)) and found.rmse < 1e-9
    assert [name for name, used in zip(found.names, found.inliers, strict=True) if not used] == [truth.images.names[2]]
    assert found.similarity.scale == pytest.approx(1 / ELSEWHERE.scale) and np.delete(found.angles, 1).max() < 1e-7
    two = align(truth.transformed(ELSEWHERE), truth.subset([1, 6]))
    np.testing.assert_allclose(two.scene.cam_centers_in_world, truth.cam_centers_in_world, atol=1e-9)
    assert "orientations were used too" in two.notes[0]


def test_a_scene_is_aligned_with_measurements(truth_and_start):
    truth, _ = truth_and_start
    points, _ = control_file(truth, np.random.default_rng(2))
    given = Survey(control=points, control_sigma=(1.0,), positions=measured_positions(truth, np.random.default_rng(1)))
    found = align(truth.transformed(ELSEWHERE), given)
    assert found.names == (*truth.images.names, "p0", "p1", "p2", "p3") and found.rmse < 4 * SIGMA
    assert len(found.scene.camera_positions) == 0 and len(found.to_dict()["residuals"]) == 12
    kept = (points.point_idx != 0) | (np.arange(len(points.point_idx)) == np.argmax(points.point_idx == 0))
    names = tuple(name for name, row in zip(points.image_names, kept, strict=True) if row)
    single = replace(points, image_names=names, point_idx=points.point_idx[kept], pixels=points.pixels[kept])
    found = align(truth.transformed(ELSEWHERE), replace(given, control=single))
    assert found.names[-3:] == ("p1", "p2", "p3")  # a single mark gives p0 no place in the scene
    with pytest.raises(InputError, match="none of its 8 names"):
        align(truth, truth.replace(images=truth.images.replace(names=tuple("abcdefgh"))))


def test_places_beyond_all_bounds_are_refused():
    source = np.random.default_rng(0).normal(size=(6, 3))
    target = source.copy()
    target[2] = 1e200
    with pytest.raises(InputError, match=r"as far out as 1e\+200"):
        robust_similarity(source, target)
