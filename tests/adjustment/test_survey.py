# SPDX-License-Identifier: BSD-3-Clause
"""Measurements of other instruments in an adjustment: found by name, in place, weighed, and tested.

Truth is that of made scenes; redundancy numbers and tests are compared with a dense computation and with adjustments
that leave a measurement out.
"""

from dataclasses import replace

import numpy as np
import pytest
from _survey import ELSEWHERE, MARK_PX, SIGMA, control, distances, made, on_rigs, positions, with_everything

import groma
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.assemble import AssemblyOptions, assemble
from groma.adjustment.parts import adjust_parts, join_parts, write_parts
from groma.adjustment.places import at_places_of
from groma.adjustment.survey.align import align
from groma.adjustment.survey.attach import Survey, with_survey
from groma.adjustment.survey.names import rows_by_name
from groma.adjustment.survey.reliability import noncentrality, reliability
from groma.adjustment.survey.similarity import robust_similarity
from groma.errors import InputError
from groma.factors.losses import Trivial
from groma.io.archive import read_archive
from groma.io.survey import ControlFile, CoordinateSystem, DistancesFile, Places
from groma.problem.residuals import jacobians_of, residuals_of
from groma.scene import CameraPositions, Similarity
from groma.scene.survey import CHECK, diagonal_covariance

LEAST_SQUARES = AdjustOptions(loss="none", point_sigma_px=0.5, check_lens=False)
UTM = np.array([4e5, 5.4e6, 200.0])


@pytest.fixture(scope="module")
def truth_and_start():
    return made()


def places_of(names, xyz, sigma=SIGMA, system=""):
    return Places(tuple(names), xyz, np.full(xyz.shape, sigma), CoordinateSystem(system), "positions.csv")


def measured_positions(truth, rng, shift=0.0):
    return places_of(truth.images.names, positions(truth, rng).xyz + shift)


def control_file(truth, rng, normalized=False):
    points, marks, xyz = control(truth, rng)
    names = tuple(truth.images.names[row] for row in marks.image_idx)
    given = places_of(points.names, points.measured, np.nan)
    found = ControlFile(given, points.role == CHECK, names, marks.point_idx, marks.pixel, False)
    if normalized:
        size = np.array([truth.cameras.width[0], truth.cameras.height[0]], float)
        found = replace(found, pixels=(marks.pixel - size / 2) / size.max(), normalized=True)
    return found, xyz


# ---------------------------------------------------------------------------------------------------------- in place


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
    moved = at_places_of(problem, scene.transformed(Similarity(translation=UTM)))
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


def test_positions_on_a_line_are_told_and_cameras_stand_upright():
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
    assert any("on a line" in note for note in found.notes)
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


# ------------------------------------------------------------------------------------------------------- what is wrong


def test_names_are_found_without_folder_and_ending():
    known = ("left/a.JPG", "left/b.jpg", "right/b.jpg", "c.png")
    assert rows_by_name(["A.jpg", "right\\b.jpg", "b.jpg", "c", "c.jpg", "d"], known).tolist() == [0, 2, -1, 3, 3, -1]


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
    refused(
        truth, "not of one kind", control=points, control_sigma=(1.0,), distances=replace(bar, second=("00001.png",))
    )
    refused(truth, "--distance-sigma", distances=replace(bar, sigma=np.array([np.nan])))


def test_exchanged_longitudes_and_latitudes_are_told(truth_and_start):
    truth, _ = truth_and_start
    east, north, up = truth.cam_centers_in_world.T * 10
    degrees = np.column_stack([13.4 + east / 67700, 52.5 + north / 111270, up])
    right = places_of(truth.images.names, degrees, 1.0, "EPSG:4326")
    assert with_survey(truth, Survey(positions=right)).alignment.scatter < 0.2
    refused(truth, "longitude and latitude exchanged", positions=replace(right, coordinates=degrees[:, [1, 0, 2]]))


def test_images_that_are_not_there_are_told(truth_and_start):
    truth, _ = truth_and_start
    given = measured_positions(truth, np.random.default_rng(5))
    found = with_survey(truth.subset(range(6)), Survey(positions=given))
    assert len(found.scene.camera_positions) == 6
    assert any("2 positions of images that are not in the scene: 00007.png" in note for note in found.notes)


def test_a_scene_in_place_stays(truth_and_start):
    truth, _ = truth_and_start
    rng = np.random.default_rng(5)
    scene = with_survey(truth, Survey(positions=measured_positions(truth, rng))).scene
    again = with_survey(scene, Survey(control=control_file(truth, rng)[0], control_sigma=(1.0,)))
    assert np.array_equal(again.scene.frames.rig_from_world, scene.frames.rig_from_world)
    assert len(again.scene.camera_positions) == 8 and len(again.scene.control_points) == 6


# --------------------------------------------------------------------------------------------------------------- align


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
    assert "orientations took part" in two.notes[0]


def test_a_scene_is_aligned_with_measurements(truth_and_start):
    truth, _ = truth_and_start
    points, _ = control_file(truth, np.random.default_rng(2))
    given = Survey(control=points, control_sigma=(1.0,), positions=measured_positions(truth, np.random.default_rng(1)))
    found = align(truth.transformed(ELSEWHERE), given)
    assert found.names == (*truth.images.names, "p0", "p1", "p2", "p3") and found.rmse < 4 * SIGMA
    assert len(found.scene.camera_positions) == 0 and len(found.to_dict()["residuals"]) == 12
    with pytest.raises(InputError, match="none of its 8 names"):
        align(truth, truth.replace(images=truth.images.replace(names=tuple("abcdefgh"))))


# --------------------------------------------------------------------------------------------------------- reliability


def dense(problem):
    """Whitened Jacobian of all factors and residuals, by plain NumPy; and the rows of each factor."""
    starts, size = {}, 0
    for name, group in problem.variables.items():
        if not group.is_constant:
            starts[name] = size
            size += len(group) * group.manifold.dof
    rows, residuals, where = [], [], []
    for factor in problem.factors:
        blocks, residual = jacobians_of(factor, problem.variables), residuals_of(factor, problem.variables)
        J = np.zeros((len(factor), residual.shape[1], size))
        for slot, ref in factor.references():
            if ref.group in starts:
                dof = problem.variables[ref.group].manifold.dof
                for i, k in enumerate(ref.index):
                    J[i, :, starts[ref.group] + k * dof :][:, :dof] += blocks[slot.name][i]
        root = np.asarray(factor.sqrt_information, float)
        root = root if root.ndim == 3 else np.broadcast_to(root, len(factor))[:, None, None] * np.eye(residual.shape[1])
        where.append(slice(sum(map(len, rows)), sum(map(len, rows)) + residual.size))
        rows.append((root @ J).reshape(-1, size))
        residuals.append(np.einsum("nij,nj->ni", root, residual).reshape(-1))
    return np.concatenate(rows), np.concatenate(residuals), where


def small(rng, seed=1):
    """A small scene with every kind of measurement, adjusted by least squares."""
    truth, _ = made(6, seed=seed)
    truth = truth.keep(points=np.arange(truth.num_points) < 60)
    scene = with_everything(truth, rng)
    result = adjust(scene, replace(LEAST_SQUARES, function_tolerance=1e-12))
    return truth, result


def test_redundancy_numbers_and_tests_are_those_of_the_dense_adjustment():
    _, result = small(np.random.default_rng(0))
    found = reliability(result.scene, result.problem)
    A, b, where = dense(result.problem)
    hat = A @ np.linalg.solve(A.T @ A, A.T)
    leave = 1 - np.diag(hat)
    assert leave.sum() == pytest.approx(A.shape[0] - A.shape[1])
    types = [factor.type_name for factor in result.problem.factors]
    rows = iter(found.measurements)
    for name, part in zip(types, where, strict=True):
        if name == "point_reprojection" and part.start == 0:
            continue  # the points of the scene
        for k in range(part.start, part.stop):
            one = next(rows)
            assert one.redundancy == pytest.approx(leave[k], abs=1e-6), (one.kind, one.name)
            assert one.weight == pytest.approx(1.0)
            assert one.normalized == pytest.approx(-b[k] / np.sqrt(leave[k]), abs=1e-4)
            assert one.detectable == pytest.approx(noncentrality() * one.sigma / np.sqrt(leave[k]), rel=1e-4)
    assert next(rows, None) is None
    kinds = [one.kind for one in found.measurements]
    assert set(kinds) == {"camera position", "control point", "mark", "distance"}
    for kind in set(kinds):
        of_kind = sum(one.redundancy for one in found.measurements if one.kind == kind and not one.is_suspect)
        assert found.redundancy[kind] == pytest.approx(of_kind, rel=0.05)


def test_a_doubted_measurement_is_tested_as_if_it_had_taken_no_part():
    """The robust loss lowers its weight; the test is that of the adjustment without it."""
    truth, _ = made(6)
    truth = truth.keep(points=np.arange(truth.num_points) < 60)
    scene = truth.replace(camera_positions=positions(truth, np.random.default_rng(0)))
    xyz = scene.camera_positions.xyz.copy()
    xyz[2] += [0.4, 0.0, 0.0]
    scene = scene.replace(camera_positions=scene.camera_positions.replace(xyz=xyz))
    exact = replace(LEAST_SQUARES, function_tolerance=1e-13)
    result = adjust(scene, exact)
    found = [one for one in reliability(result.scene, result.problem).measurements if one.name == "00003.png"]
    assert found[0].weight < 0.3 and found[0].is_suspect
    assert reliability(result.scene, result.problem).suspects[0].name == "00003.png"
    without = adjust(scene.replace(camera_positions=scene.camera_positions.take(np.arange(6) != 2)), exact)
    spread = without.uncertainty().centers[2] + scene.camera_positions.covariance[2]
    away = xyz[2] - without.scene.cam_centers_in_world[2]
    P = np.linalg.inv(scene.camera_positions.covariance[2])
    score = (
        P
        @ np.linalg.inv(P + np.linalg.inv(without.uncertainty().centers[2]))
        @ np.linalg.inv(without.uncertainty().centers[2])
        @ away
    )
    full = np.linalg.inv(spread)
    np.testing.assert_allclose(score, full @ away, rtol=1e-6)  # the same by two ways
    normalized = (full @ away) / np.sqrt(np.diag(full))
    np.testing.assert_allclose([one.normalized for one in found], normalized, rtol=0.02, atol=0.05)


def test_predicted_errors_are_those_that_occur():
    """The squared errors of all cameras in units of their covariance, over draws of all noise: 3 a camera."""
    truth, _ = made(6)
    truth = truth.keep(points=np.arange(truth.num_points) < 60)
    exact = truth.point_observations.pixel - pixel_noise(truth)
    squares, checks = [], []
    for draw in range(12):
        rng = np.random.default_rng(100 + draw)
        pixel = exact + rng.normal(size=exact.shape) * 0.5
        scene = with_everything(truth.replace(point_observations=truth.point_observations.replace(pixel=pixel)), rng)
        result = adjust(scene, LEAST_SQUARES)
        off = result.scene.cam_centers_in_world - truth.cam_centers_in_world
        squares.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(result.uncertainty().centers), off).mean())
        checks += [one.normalized_square for one in reliability(result.scene, result.problem).check_points]
    # the errors of the cameras of a draw depend on each other: 12 x 6 to 36 independent draws of chi-square 3
    assert 2.2 < np.mean(squares) < 3.9
    assert len(checks) == 24 and 1.8 < np.mean(checks) < 4.4


@pytest.mark.parametrize("sigma", [1.0, 1e5])
def test_measurements_that_weigh_little_place_the_scene_all_the_same(sigma):
    """Positions so weak that beside the pixels they are lost in rounding: the scene ends where they fit best."""
    truth, _ = made(8)
    rng = np.random.default_rng(0)
    scene = truth.transformed(Similarity(1e-3)) if sigma > 1 else truth
    table = positions(scene, rng, sigma * (1e-3 if sigma < 1e3 else 1e-6))
    table = table.replace(covariance=table.covariance * 1e6)
    twist = Similarity.from_array(np.array([0.05, 0.1, -0.02, np.sqrt(1 - 0.0129), 0.3, -0.2, 0.1, 1.1]))
    start = scene.transformed(twist).replace(camera_positions=table)
    result = adjust(start, LEAST_SQUARES)

    def cost(moved):
        off = moved.cam_centers_in_world - table.xyz
        return np.einsum("ni,nij,nj->", off, np.linalg.inv(table.covariance), off)

    best = cost(result.scene)
    size = np.sqrt(table.covariance[0, 0, 0]) * 1e-2
    for k in range(3):
        for sign in (-1, 1):
            assert cost(result.scene.transformed(Similarity(translation=sign * size * np.eye(3)[k]))) >= best
            turn = np.zeros(8)
            turn[[3, 7]], turn[k] = 1.0, sign * 1e-5
            turn[:4] /= np.linalg.norm(turn[:4])
            assert cost(result.scene.transformed(turn)) >= best - 1e-9
    found = reliability(result.scene, result.problem)
    if sigma > 1:
        assert found.redundancy["camera position"] == pytest.approx(3 * 8 - 7, abs=0.01)
    # the noise was a thousandth of what was stated; the photographs add theirs
    assert 0.3 < found.components["camera position"] * 1e3 < 5.0


def pixel_noise(truth):
    from groma.scene.synthetic.noise import project_pinhole

    table = truth.point_observations
    poses = truth.cam_from_world[table.image_idx]
    return table.pixel - project_pinhole(truth.cameras.params[0], poses, truth.points.xyz[table.point_idx])[0]


def test_nothing_checks_the_only_scale_bar(truth_and_start):
    truth, _ = truth_and_start
    points, marks, xyz = control(truth, np.random.default_rng(1))
    between, _ = distances(truth, xyz, np.random.default_rng(1))
    scene = truth.replace(control_points=points.replace(role=np.zeros(6, int)), marks=marks, point_distances=between)
    result = adjust(scene, LEAST_SQUARES)
    bar = reliability(result.scene, result.problem).measurements[-1]
    assert bar.kind == "distance" and bar.redundancy < 1e-4
    assert abs(bar.residual) < 1e-4 * SIGMA
    assert reliability(truth) is None


# ------------------------------------------------------------------------------------------------- rigs, parts, gauge


def test_positions_are_of_cameras_not_of_their_rigs(truth_and_start):
    scene = on_rigs(truth_and_start[0])
    table = CameraPositions(np.arange(8), scene.cam_centers_in_world, diagonal_covariance(np.full((8, 3), SIGMA)))
    problem = assemble(scene.replace(camera_positions=table), AssemblyOptions()).problem
    for factor in problem.factors:
        np.testing.assert_allclose(residuals_of(factor, problem.variables), 0.0, atol=1e-12)
    assert len(problem.factors) == 1


def test_parts_are_the_whole(truth_and_start, tmp_path):
    """What other instruments measured is in the first part and counts once."""
    scene = with_everything(truth_and_start[0], np.random.default_rng(0))
    scene = scene.replace(point_distances=type(scene.point_distances)())
    whole = adjust(scene, LEAST_SQUARES)
    paths = write_parts(scene, tmp_path / "parts", observations=150)
    assert len(paths) > 2
    assert sum(len(read_archive(path).marks) for path in paths) == len(read_archive(paths[0]).marks) == len(scene.marks)
    result = adjust_parts(paths, tmp_path / "adjusted", Trivial(), point_sigma_px=0.5)
    assert result.report.final_cost == pytest.approx(whole.report.solve.final_cost, rel=1e-6)
    joined = join_parts([tmp_path / "adjusted" / path.name for path in paths])
    np.testing.assert_allclose(joined.cam_centers_in_world, whole.scene.cam_centers_in_world, atol=1e-4)
    np.testing.assert_allclose(joined.control_points.xyz, whole.scene.control_points.xyz, atol=1e-4)


def test_measurements_hold_the_gauge(truth_and_start):
    truth, _ = truth_and_start
    scene = with_everything(truth, np.random.default_rng(0))
    assert scene.is_surveyed and scene.has_scale and not truth.has_scale
    for free in (scene, truth):
        assert not np.any(assemble(free, AssemblyOptions()).problem.variables["frames"].free_coordinates() == False)  # noqa: E712
    bar = truth.replace(
        control_points=scene.control_points.replace(role=np.zeros(6, int)),
        marks=scene.marks,
        point_distances=scene.point_distances,
    )
    assert not bar.is_surveyed and bar.has_scale
    held = assemble(bar, AssemblyOptions(gauge="first_camera")).problem.variables["frames"].free_coordinates()
    assert (~held).sum() == 6  # the scale is measured


def test_marks_weigh_as_stated(truth_and_start):
    truth, _ = truth_and_start
    scene = with_everything(truth, np.random.default_rng(0))
    marks = [
        f
        for f in assemble(scene, AssemblyOptions(point_sigma_px=3.0)).problem.factors
        if "control_points" in {r.group for _, r in f.references()}
    ]
    np.testing.assert_allclose(marks[0].sqrt_information, 1 / MARK_PX)
    assert groma.adjust(scene, LEAST_SQUARES).report.num_measurements["marks"] == len(scene.marks)
