# SPDX-License-Identifier: BSD-3-Clause
"""Measurements of other instruments in an adjustment: on rigs, in parts, as the gauge."""

import numpy as np
import pytest
from _survey import MARK_PX, SIGMA, made, on_rigs, with_everything, with_objects

import groma
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.parts import adjust_parts, join_parts, num_ties_cut, write_parts
from groma.adjustment.survey.given_poses import given_poses_of
from groma.adjustment.survey.protocol import protocol
from groma.factors.losses import Trivial
from groma.geometry import se3
from groma.io.archive import read_archive, write_archive
from groma.mapping.surveyed import adjust_surveyed
from groma.problem.residuals import residuals_of
from groma.scene import CameraPositions, Held, KnownPlanes, PosePriors
from groma.scene.survey import Kind, diagonal_covariance
from groma.scene.synthetic.scenes import holistic

LEAST_SQUARES = AdjustOptions(loss="none", point_sigma_px=0.5, check_lens=False)
UTM = np.array([4e5, 5.4e6, 200.0])


@pytest.fixture(scope="module")
def truth_and_start():
    return made()


def test_positions_are_of_cameras_not_of_their_rigs(truth_and_start):
    scene = on_rigs(truth_and_start[0])
    table = CameraPositions(np.arange(8), scene.cam_centers_in_world, diagonal_covariance(np.full((8, 3), SIGMA)))
    problem = assemble(scene.replace(camera_positions=table), AssemblyOptions()).problem
    for factor in problem.factors:
        np.testing.assert_allclose(residuals_of(factor, problem.variables), 0.0, atol=1e-12)
    assert len(problem.factors) == 1


def test_parts_are_the_whole(truth_and_start, tmp_path):
    """What other instruments measured is in the first part and counts once."""
    rng = np.random.default_rng(0)
    scene = with_objects(with_everything(truth_and_start[0], rng), rng)
    scene = scene.replace(held=Held([Kind.POINT, Kind.IMAGE], [70, 3]))
    whole = adjust(scene, LEAST_SQUARES)
    paths = write_parts(scene, tmp_path / "parts", observations=150)
    assert len(paths) > 2
    assert sum(len(read_archive(path).marks) for path in paths) == len(read_archive(paths[0]).marks) == len(scene.marks)
    result = adjust_parts(paths, tmp_path / "adjusted", Trivial(), point_sigma_px=0.5)
    assert result.report.final_cost == pytest.approx(whole.report.solve.final_cost, rel=1e-6)
    joined = join_parts([tmp_path / "adjusted" / path.name for path in paths])
    np.testing.assert_allclose(joined.cam_centers_in_world, whole.scene.cam_centers_in_world, atol=1e-4)
    assert scene.points.ids[70] in read_archive(paths[0]).points.ids
    kept = joined.points.xyz[joined.points.ids == scene.points.ids[70]]
    np.testing.assert_array_equal(kept[0], scene.points.xyz[70])
    assert joined.held.kind.tolist() == [Kind.POINT, Kind.IMAGE] and len(joined.known_planes) == 8
    np.testing.assert_allclose(joined.control_points.xyz, whole.scene.control_points.xyz, atol=1e-4)


def test_held_lines_stay_in_parts_and_keep_their_points(tmp_path):
    """Lines that fit badly are started again between two stages, but not those that are held, in parts as at once."""
    scene = holistic(20, noise_px=0.5, seed=1).start
    rows = np.array([1, 3, 5, 6])
    scene = scene.replace(held=Held(np.full(4, Kind.LINE), rows))
    assert num_ties_cut(scene, 300) == num_ties_cut(scene.replace(held=Held()), 300) == 0
    paths = write_parts(scene, tmp_path / "parts", observations=300)
    rejected = KnownPlanes([0], [0], np.zeros((1, 3)), np.eye(1, 4, 2), np.ones(1), np.ones(1, bool))
    write_archive(read_archive(paths[0]).replace(known_planes=rejected), paths[0], force=True)
    adjust_parts(paths, tmp_path / "adjusted", Trivial())
    joined = join_parts([tmp_path / "adjusted" / path.name for path in paths])
    place = {int(number): row for row, number in enumerate(joined.lines.ids)}
    after = joined.lines.plucker[[place[int(number)] for number in scene.lines.ids[rows]]]
    np.testing.assert_allclose(after, scene.lines.plucker[rows], atol=1e-12)
    assert len(joined.known_planes) == 1  # what is rejected takes no part, and stays


def test_measurements_hold_the_gauge(truth_and_start):
    truth, _ = truth_and_start
    scene = with_everything(truth, np.random.default_rng(0))
    assert scene.is_surveyed and scene.has_scale and not truth.has_scale
    for free in (scene, truth):
        assert not np.any(assemble(free, AssemblyOptions()).problem.variables["frames"].free_coordinates() == False)  # noqa: E712
    bar = truth.replace(
        control_points=scene.control_points.replace(role=np.zeros(6, int)),
        marks=scene.marks,
        distances=scene.distances.take([0]),
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


def test_the_protocol_says_what_given_poses_are_worth(truth_and_start):
    """The noise they count with, what they are off, and which images have none."""
    truth = with_everything(truth_and_start[0], np.random.default_rng(0))
    off = np.array([0.0, 0.03, -0.04, np.radians(2.0), 0.0, 0.0])
    given = se3.compose(se3.exp(np.tile(off, (7, 1))), truth.frames.rig_from_world[:7])
    sigma = np.tile(np.repeat([0.05, np.radians(0.5)], 3), (7, 1))
    scene = truth.replace(pose_priors=PosePriors(np.arange(7), given, sigma))
    told = given_poses_of(scene)["given_poses"]
    assert told["number"] == 7 and told["without"] == [truth.images.names[7]]
    np.testing.assert_allclose([told["sigma"], told["sigma_deg"]], [0.05, 0.5])
    np.testing.assert_allclose([told["rms"], told["rms_deg"]], [0.05 / np.sqrt(3), 2.0 / np.sqrt(3)], rtol=1e-3)
    found = adjust_surveyed(scene)
    text = protocol(found.result.summary() | {"survey": found.to_dict()})
    assert "Given poses" in text and "shift along an axis" in text and "  0.05 " in text
    assert f"Without a given pose, or with a wrong one: {truth.images.names[7]}." in text
    assert given_poses_of(truth) == {}
