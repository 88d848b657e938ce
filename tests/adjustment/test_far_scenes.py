# SPDX-License-Identifier: BSD-3-Clause
"""Scenes in coordinates of the ground, of unusual scale, and with a few points at a great distance: the same result.

Truth is the same scene near the origin.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.diagnosis import diagnose_scene
from groma.adjustment.uncertainty import uncertainty
from groma.factors import PoseBetween
from groma.factors.contract import Ref
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.mapping import map as mapping
from groma.mapping.map import MapResult, map_images
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Similarity
from groma.scene.local_frame import local_frame, usual_frame
from groma.scene.synthetic.scenes import holistic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.solver.termination import Termination

#: Where a scene lies in the coordinates of UTM, metres.
TO_UTM = Similarity(translation=np.array([4e5, 5.4e6, 200.0]))
OPTIONS = AdjustOptions(loss="none")


@pytest.fixture(scope="module")
def start():
    return holistic(8, noise_px=0.5, seed=1).start


@pytest.fixture(scope="module")
def near(start):
    return adjust(start, OPTIONS)


def test_only_far_scenes_are_moved(start):
    assert local_frame(start) is None
    move = local_frame(start.transformed(TO_UTM))
    assert move is not None and move.scale == 1.0
    assert np.linalg.norm(move.translation + TO_UTM.translation) < 10.0
    outlier = start.points.xyz.copy()
    outlier[0] = 1e15
    assert local_frame(start.with_points(outlier)) is None
    assert local_frame(start.subset([0], min_observations=10**6)) is None


def test_a_scene_in_ground_coordinates_is_adjusted_as_well(start, near):
    far = adjust(start.transformed(TO_UTM), OPTIONS)
    assert far.report.termination is near.report.termination
    assert far.report.solve.final_cost == pytest.approx(near.report.solve.final_cost, rel=1e-6)
    back = far.scene.transformed(TO_UTM.inverse())
    np.testing.assert_allclose(back.cam_centers_in_world, near.scene.cam_centers_in_world, atol=1e-5)
    np.testing.assert_allclose(back.points.xyz, near.scene.points.xyz, atol=1e-4)
    assert far.problem is not None
    np.testing.assert_array_equal(far.problem.variables["frames"].state, far.scene.frames.rig_from_world)


@pytest.mark.parametrize("form", ["metric", "pixels"])
def test_the_problem_of_a_scene_in_ground_coordinates_is_that_of_its_result(start, form):
    """All that factors measure in the world is moved back with it; lines lose digits 5,000 km from the origin."""
    far = adjust(start.transformed(TO_UTM), replace(OPTIONS, structure_form=form))
    again = solve(far.problem, SolverOptions(max_iterations=0)).report
    assert again.final_costs == pytest.approx(far.report.solve.final_costs, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("exponent", [-12, -9, -6, -3, -1, 1, 3, 6, 9, 12])
def test_the_unit_of_length_does_not_matter(start, exponent):
    """As many steps, and the same minimum: under least squares and robust losses, and with lines alone."""
    unit = Similarity(scale=10.0**exponent)
    for options in (OPTIONS, AdjustOptions(), AdjustOptions(planes=False, points=False)):
        here, there = adjust(start, options), adjust(start.transformed(unit), options)
        assert there.report.termination is here.report.termination
        assert abs(there.report.solve.iterations - here.report.solve.iterations) <= 1
        assert there.report.solve.final_cost == pytest.approx(here.report.solve.final_cost, rel=1e-9)
        back = there.scene.transformed(unit.inverse())
        np.testing.assert_allclose(back.cam_centers_in_world, here.scene.cam_centers_in_world, atol=1e-6)


@pytest.mark.parametrize("exponent", [-12, 12])
def test_what_is_known_does_not_depend_on_the_unit_of_length(start, near, exponent):
    unit = 10.0**exponent
    there = adjust(start.transformed(Similarity(scale=unit)), OPTIONS)
    here, far = near.pose_uncertainty(), there.pose_uncertainty()
    assert far["center"]["median"] == pytest.approx(unit * here["center"]["median"], rel=1e-6)
    assert far["rotation_deg"]["median"] == pytest.approx(here["rotation_deg"]["median"], rel=1e-6)
    assert [f.sentence for f in there.diagnose().findings] == [f.sentence for f in near.diagnose().findings]


@pytest.mark.parametrize("held", [None, "turns", "places", "pose"])
def test_what_is_free_does_not_depend_on_the_unit_of_length(held):
    """Points alone, with what of the first camera is held: as many free motions, the same words, the same knowledge."""
    start, found = holistic(8, noise_px=0.5, seed=1).truth.points_only(), []
    for unit in (1.0, 1e-12, 1e-8, 1e8, 1e12):
        scene = start.transformed(Similarity(scale=unit))
        problem = assemble(scene, AssemblyOptions(gauge="free")).problem
        constant = np.zeros((scene.num_frames, 6), bool)
        constant[0] = {None: [0] * 6, "turns": [0, 0, 0, 1, 1, 1], "places": [1, 1, 1, 0, 0, 0], "pose": [1] * 6}[held]
        frames = replace(problem.variables["frames"], constant=constant)
        problem = Problem({**problem.variables, "frames": frames}, problem.factors)
        said = diagnose_scene(scene, problem=problem)
        centers = uncertainty(scene, gauge="inner", problem=problem).centers / unit**2
        found.append((said.num_free_motions, [one.sentence for one in said.findings], centers))
    assert found[0][0] == {None: 7, "turns": 4, "places": 4, "pose": 1}[held]
    for number, sentences, centers in found[1:]:
        assert number == found[0][0]
        assert sentences == found[0][1]
        np.testing.assert_allclose(centers, found[0][2], rtol=1e-4, atol=1e-7 * found[0][2].max())


@pytest.mark.parametrize("exponent", [-12, 12])
def test_the_unit_of_length_ends_no_solve_early(exponent):
    """Two poses and the motion between them, turns held: what is small in numbers is not small for the scene."""
    unit = 10.0**exponent
    apart = np.array([[0, 0, 0, 1, 0, 0, 0], [0, 0, 0, 1, 2.0 * unit, 0, 0]])
    held = np.zeros((2, 6), bool)
    held[0], held[1, 3:] = True, True
    factor = PoseBetween(
        first=Ref("poses", [0]), second=Ref("poses", [1]),
        first_from_second=np.array([[0, 0, 0, 1, -3.0 * unit, 0, 0]]),
        sqrt_information=np.diag([1 / unit, 1 / unit, 1 / unit, 1, 1, 1])[None],
    )  # fmt: skip
    problem = Problem({"poses": Variables(POSE_CHARTS["left"], apart, held)}, [factor])
    found = solve(problem, SolverOptions(function_tolerance=1e-14))
    assert found["poses"][1, 4] == pytest.approx(3.0 * unit, rel=1e-5)


def test_covariances_are_those_of_the_near_scene(start, near):
    far = adjust(start.transformed(TO_UTM), OPTIONS)
    expected = uncertainty(near.scene, problem=near.problem)
    found = uncertainty(far.scene, problem=far.problem)
    for kind in ("centers", "points", "segment_ends"):
        wanted = getattr(expected, kind)
        np.testing.assert_allclose(getattr(found, kind), wanted, rtol=1e-2, atol=1e-3 * np.abs(wanted).max())
    for kind, ambient in (("lines", near.scene.lines.plucker), ("planes", near.scene.planes.hesse)):
        step = 1e-3 * np.ones(ambient.shape[1])
        move = getattr(TO_UTM, kind)
        J = np.column_stack([(move(e) - move(-e)) / 2.0 for e in np.diag(step)]) / step
        wanted = J @ getattr(expected, kind) @ J.T
        np.testing.assert_allclose(getattr(found, kind), wanted, rtol=2e-2, atol=1e-4 * np.abs(wanted).max())


@pytest.mark.parametrize(
    "world", [Similarity(scale=1e-4), Similarity(scale=1e4), TO_UTM], ids=["small", "large", "ground"]
)
def test_a_diagnosis_does_not_depend_on_the_world(near, world):
    # the first camera and the scale are held, which says nothing of what the data determine
    expected = diagnose_scene(near.scene, AssemblyOptions(gauge="first_camera"))
    found = diagnose_scene(near.scene.transformed(world), AssemblyOptions(gauge="first_camera"))
    assert found.num_unobservable_directions == expected.num_unobservable_directions
    assert [finding.kind for finding in found.findings] == [finding.kind for finding in expected.findings]


def test_points_at_a_great_distance_do_not_end_the_adjustment(start, near):
    places = start.points.xyz.copy()
    places[:3] = 1e14 * places[:3] / np.linalg.norm(places[:3], axis=1, keepdims=True)
    found = adjust(start.with_points(places), AdjustOptions(loss="cauchy"))
    assert found.report.termination is not Termination.STEP_CONVERGED
    expected = adjust(start.keep(points=np.arange(3, start.num_points)), AdjustOptions(loss="cauchy"))
    assert found.report.solve.iterations >= expected.report.solve.iterations


@pytest.mark.parametrize("exponent", [-9, -4, 4, 9])
def test_scenes_of_unusual_size_get_a_unit_of_their_own(start, exponent):
    assert usual_frame(start) is None
    scaled = start.transformed(Similarity(scale=10.0**exponent))
    frame = usual_frame(scaled)
    assert frame is not None and np.log2(frame.scale) == np.round(np.log2(frame.scale))
    assert usual_frame(scaled.transformed(frame)) is None
    np.testing.assert_array_equal(scaled.transformed(frame).transformed(frame.inverse()).points.xyz, scaled.points.xyz)
    far = scaled.transformed(Similarity(translation=10.0**exponent * TO_UTM.translation))
    both = usual_frame(far)
    assert both is not None and both.scale == frame.scale
    assert local_frame(far.transformed(both)) is None and usual_frame(far.transformed(both)) is None


@pytest.mark.parametrize("world", [TO_UTM, Similarity(scale=1e6), Similarity(scale=1e-6)])
def test_a_map_is_made_near_the_origin_in_a_usual_unit_and_moved_back(tmp_path, monkeypatch, start, near, world):
    """What is between the two is looked at without photographs."""
    seen = []

    def mapped(points, *others):
        seen.append(points)
        return MapResult(near.scene, points, start, near.scene, near.report, OPTIONS, {}, "", {}, ())

    monkeypatch.setattr(mapping, "map_segments", mapped)
    for name in start.images.names:
        cv2.imwrite(str(tmp_path / name), np.zeros((768, 1024), np.uint8))
    model = start.points_only().transformed(world)
    found = map_images(tmp_path, tmp_path / "work", model)
    assert usual_frame(seen[0]) is None
    move = usual_frame(model)
    assert move is not None
    back, size = move.inverse(), 1e-6 * max(world.scale, 1e-6)
    np.testing.assert_allclose(found.start.cam_centers_in_world, model.cam_centers_in_world, atol=size)
    np.testing.assert_allclose(found.scene.points.xyz, back.points(near.scene.points.xyz), atol=size)
    np.testing.assert_allclose(found.before.lines.segments, back.points(start.lines.segments), atol=size)
