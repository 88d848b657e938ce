# SPDX-License-Identifier: BSD-3-Clause
"""Gross errors of measurements are taken out: the result is that without them, and nothing else goes."""

import numpy as np
import pytest
from _survey import ELSEWHERE, control, control_file, made, positions, with_everything, with_objects

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.diagnosis import diagnose_scene
from groma.adjustment.survey.attach import Survey, with_survey
from groma.adjustment.survey.gross_errors import without_gross_errors
from groma.adjustment.survey.reliability import reliability
from groma.adjustment.terms.open_motions import num_open_motions
from groma.io.archive import read_archive, write_archive
from groma.mapping.surveyed import adjust_surveyed
from groma.scene import Distances
from groma.scene.survey import REJECTABLE, Kind, accepted, rejected_rows, with_rejected

OPTIONS = AdjustOptions(loss="none", point_sigma_px=0.5, check_lens=False, function_tolerance=1e-12)


@pytest.fixture(scope="module")
def truth():
    return made()[0]


def cleaned(scene):
    return without_gross_errors(adjust(scene, OPTIONS), lambda one: adjust(one, OPTIONS))


def off(scene, name, row, column, by):
    """The scene with a row of a table off by so much."""
    table = getattr(scene, name)
    values = getattr(table, column).copy()
    values[row] += by
    return scene.replace(**{name: table.replace(**{column: values})})


@pytest.mark.parametrize(
    ("name", "row", "column", "by", "kind"),
    [
        ("camera_positions", 2, "xyz", [0.3, 0.0, 0.0], "camera position"),
        ("camera_poses", 3, "cam_from_world", [0, 0, 0, 0, 0.2, 0.3, 0.0], "camera pose"),
        ("control_points", 1, "measured", [0.0, 0.0, 0.4], "control point"),
        ("marks", 5, "pixel", [20.0, 0.0], "mark"),
        ("distances", 0, "distance", 0.2, "distance"),
        ("known_planes", 4, "hesse", [0.0, 0.0, 0.0, 0.3], "known plane"),
    ],
)
def test_what_is_wrong_pulls_no_more(truth, name, row, column, by, kind):
    rng = np.random.default_rng(3)
    scene = with_objects(with_everything(truth, rng), rng)
    good, _ = cleaned(scene)
    assert rejected_rows(good.scene) == set()
    result, found = cleaned(off(scene, name, row, column, by))
    assert rejected_rows(result.scene) == {(name, row)}
    without = adjust(with_rejected(scene, {(name, row)}), OPTIONS)
    moved = result.scene.cam_centers_in_world - without.scene.cam_centers_in_world
    assert np.abs(moved).max() < 1e-6
    mine = [one for one in found.measurements if one.is_rejected]
    assert {one.table_row for one in mine} == {(name, row)} and {one.kind for one in mine} == {kind}
    assert all(one.weight == 0.0 for one in mine) and found.suspects[0].is_rejected
    assert f"{kind} {mine[0].name}" == found.to_dict()["rejected"][0]


def test_what_is_rejected_is_tested_against_the_others(truth):
    """Its normalised residual is the deviation from what the others predict, in units of both covariances."""
    scene = truth.replace(camera_positions=positions(truth, np.random.default_rng(0)))
    result = adjust(with_rejected(off(scene, "camera_positions", 2, "xyz", [0.3, 0.1, 0.0]), {("camera_positions", 2)}))
    table = result.scene.camera_positions
    found = [one for one in reliability(result.scene, result.problem).measurements if one.is_rejected]
    total = np.linalg.inv(table.covariance[2] + result.uncertainty().centers[2])
    away = table.xyz[2] - result.scene.cam_centers_in_world[2]
    np.testing.assert_allclose(
        [one.normalized for one in found], total @ away / np.sqrt(np.diag(total)), rtol=0.01, atol=0.02
    )
    assert [one.name for one in found] == [truth.images.names[2]] * 3
    np.testing.assert_allclose([one.residual for one in found], away, atol=1e-6)


def test_several_gross_errors_and_a_good_row_that_was_rejected(truth):
    rng = np.random.default_rng(1)
    scene = with_everything(truth, rng)
    for row, by in ((1, [0.5, 0, 0]), (6, [0, -2.0, 1.0])):
        scene = off(scene, "camera_positions", row, "xyz", by)
    scene = with_rejected(off(scene, "marks", 3, "pixel", [0.0, 30.0]), {("camera_positions", 4), ("distances", 1)})
    result, _ = cleaned(scene)
    assert rejected_rows(result.scene) == {("camera_positions", 1), ("camera_positions", 6), ("marks", 3)}


def test_nobody_knows_which_of_two_scale_bars_is_wrong(truth):
    points, marks, xyz = control(truth, np.random.default_rng(1))
    apart = [np.linalg.norm(xyz[1] - xyz[0]), 1.2 * np.linalg.norm(xyz[3] - xyz[2])]
    bars = Distances.between(Kind.CONTROL_POINT, [0, 2], [1, 3], apart, [0.005, 0.005])
    scene = truth.replace(control_points=points.replace(role=np.zeros(6, int)), marks=marks, distances=bars)
    result, found = cleaned(scene)
    assert rejected_rows(result.scene) == set() and len(found.suspects) == 2


def marks_of_a_check_point(truth, count):
    """The scene with control points, one check point of which has so many marks; their rows, and true places."""
    points, marks, xyz = control(truth, np.random.default_rng(1))
    check = int(np.flatnonzero(points.is_check)[0])
    seen = np.flatnonzero(marks.point_idx == check)
    marks = marks.take(np.flatnonzero((marks.point_idx != check) | np.isin(np.arange(len(marks)), seen[:count])))
    return truth.replace(control_points=points, marks=marks), np.flatnonzero(marks.point_idx == check), xyz


@pytest.mark.parametrize(
    ("count", "wrong"), [(2, [[150.0, 250.0]]), (3, [[150.0, 250.0]]), (3, [[25.0, -26.0], [128.0, 21.0]])]
)
def test_a_check_point_keeps_two_marks(truth, count, wrong):
    """Of three marks a wrong one goes alone, though others look wrong beside it; of two nobody knows which it is."""
    scene, rows, xyz = marks_of_a_check_point(truth, count)
    for row, by in zip(rows, wrong, strict=False):
        scene = off(scene, "marks", row, "pixel", by)
    result, found = cleaned(scene)
    assert len(rejected_rows(result.scene)) <= count - 2 and {one.kind for one in found.suspects} == {"mark"}
    if (count, len(wrong)) == (3, 1):
        assert rejected_rows(result.scene) == {("marks", rows[0])}
        assert np.abs(result.scene.control_points.xyz - xyz).max() < 0.1


def test_a_stray_mark_takes_no_part_until_it_is_tested(truth):
    """The rays of two others meet: it waits outside, and is named and rejected in the end, unless suspects are kept."""
    given, _ = control_file(truth, np.random.default_rng(1))
    given.pixels[4] = [10.0, 10.0]
    survey = Survey(control=given, control_sigma=(0.02,), mark_sigma_px=0.5)
    start = truth.transformed(ELSEWHERE)
    assert rejected_rows(with_survey(start, survey).scene) == {("marks", 4)}
    found = adjust_surveyed(start, survey, OPTIONS)
    assert rejected_rows(found.result.scene) == {("marks", 4)} and found.reliability.suspects[0].is_rejected
    assert not rejected_rows(adjust_surveyed(start, survey, OPTIONS, keep_suspects=True).result.scene)


def test_the_frame_is_not_given_up(truth):
    """Of three positions one is wrong: without it the turn about the others would be open."""
    scene = truth.replace(camera_positions=positions(truth, np.random.default_rng(0)).take([0, 2, 5]))
    scene = off(scene, "camera_positions", 1, "xyz", [0.0, 0.0, 1.0])
    result, found = cleaned(scene)
    assert rejected_rows(result.scene) == set() and found.suspects
    points, marks, _ = control(truth, np.random.default_rng(1))
    marked = scene.replace(control_points=points.replace(role=np.zeros(6, int)), marks=marks)
    result, _ = cleaned(off(marked, "marks", 5, "pixel", [20.0, 0.0]))  # what is elsewhere goes all the same
    assert rejected_rows(result.scene) == {("marks", 5)}
    assert num_open_motions(scene) == 0 and num_open_motions(with_rejected(scene, {("camera_positions", 1)})) == 1


def test_weak_positions_hold_the_frame_all_the_same(truth):
    """Positions of kilometres beside pixels: their part of the equations is lost in rounding, not the frame."""
    table = positions(truth, np.random.default_rng(0))
    weak = truth.replace(camera_positions=table.replace(covariance=1e12 * table.covariance))
    said = diagnose_scene(weak)
    assert said.num_free_motions == 0 and "held by the measurements alone" in " ".join(map(str, said.findings))
    assert diagnose_scene(weak.replace(camera_positions=table.take([0, 3]))).num_free_motions == 1
    assert diagnose_scene(truth).num_free_motions == 7


def test_standard_deviations_stated_too_small_reject_nothing(truth):
    """All positions are ten times worse than stated: that is told, and all stay."""
    table = positions(truth, np.random.default_rng(0), 0.2)
    scene = truth.replace(camera_positions=table.replace(covariance=table.covariance / 100.0))
    result, found = cleaned(scene)
    assert rejected_rows(result.scene) == set()
    assert len(found.suspects) > 4 and found.components["camera position"] > 5.0


def test_the_archive_keeps_what_was_rejected(truth, tmp_path):
    rng = np.random.default_rng(3)
    scene = with_objects(with_everything(truth, rng), rng)
    rows = {(name, 1) for name in REJECTABLE} | {("control_points", 2)}
    marked = with_rejected(scene, rows)
    assert rejected_rows(marked) == rows and not marked.control_points.is_control[2]
    write_archive(marked, tmp_path / "scene.npz")
    assert rejected_rows(read_archive(tmp_path / "scene.npz")) == rows
    assert all(len(getattr(accepted(marked), name)) == len(getattr(scene, name)) - 1 for name in REJECTABLE)
    write_archive(scene, tmp_path / "before.npz")  # no column where nothing is rejected, as in earlier archives
    assert rejected_rows(read_archive(tmp_path / "before.npz")) == set()


def test_later_adjustments_leave_it_out(truth):
    """Adjusted again with its measurements alone, the scene stays where it was without the gross error."""
    scene = off(with_everything(truth, np.random.default_rng(2)), "camera_positions", 2, "xyz", [0.0, 5.0, 0.0])
    first = adjust_surveyed(scene)
    assert rejected_rows(first.result.scene) == {("camera_positions", 2)}
    again = adjust(first.result.scene, OPTIONS)
    assert np.abs(again.scene.cam_centers_in_world - first.result.scene.cam_centers_in_world).max() < 2e-3
