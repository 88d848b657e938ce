# SPDX-License-Identifier: BSD-3-Clause
"""Every kind of measurement in an adjustment: exact ones cost nothing, units do not matter, the scale is found."""

import math
from dataclasses import replace

import numpy as np
import pytest
from _measured import with_measurements
from _survey import Exact, with_everything, with_objects

import groma
from groma.adjustment.assemble import TERMS, assemble
from groma.adjustment.assembly_options import AssemblyOptions, RightTurnPrior
from groma.adjustment.parts import adjust_parts, write_parts
from groma.adjustment.terms.contract import Group, Term
from groma.errors import InputError
from groma.evaluation.alignment import align_poses
from groma.factors.contract import Ref
from groma.factors.priors.position_prior import PositionPrior
from groma.io.archive import read_archive
from groma.problem.residuals import residuals_of
from groma.scene import Cameras, Relations, Similarity
from groma.scene.synthetic.scenes import holistic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.solver.termination import Termination

#: Every kind of relation has a standard deviation of its own in these scenes.
SIGMA_ON, SIGMA_ANGLE = 0.02, math.radians(1.0)


def related(scene):
    """The scene with all relations that its planes allow, each with a standard deviation."""
    n = scene.planes.hesse[:, :3]
    first, second = np.triu_indices(len(n), 1)
    cosine = np.abs((n[first] * n[second]).sum(axis=1))
    pairs, old = np.column_stack([first, second]), scene.relations
    return scene.replace(
        relations=Relations(
            point_on_plane=old.point_on_plane,
            line_on_plane=old.line_on_plane,
            parallel_planes=pairs[cosine > 0.5],
            perpendicular_planes=pairs[cosine < 0.5],
            point_on_plane_sigma=np.full(len(old.point_on_plane), SIGMA_ON),
            line_on_plane_sigma=np.full(len(old.line_on_plane), SIGMA_ON),
            perpendicular_planes_sigma=np.full(int((cosine < 0.5).sum()), SIGMA_ANGLE),
        )
    )


@pytest.fixture(scope="module")
def exact():
    measured = with_measurements(holistic(20, noise_px=0.0, seed=3).truth, depth_sigma=0.0, pixel_sigma=0.0)
    return related(with_objects(with_everything(measured, Exact()), Exact()))


@pytest.fixture(scope="module")
def noisy():
    made = holistic(20, noise_px=0.5, seed=3)
    measured = related(with_measurements(made.truth)).replace(pose_priors=type(made.truth.pose_priors)())
    start = made.start.replace(
        **{
            name: getattr(measured, name)
            for name in ("point_depths", "right_columns", "line_depths", "plane_observations", "relations")
        }
    )
    return made.truth, start


def cost(scene, **options) -> float:
    problem = assemble(scene, AssemblyOptions(**options)).problem
    return solve(problem, SolverOptions(max_iterations=0)).report.initial_cost


@pytest.mark.parametrize(
    "forms",
    [{}, {"line_residual": "bearing"}, {"line_residual": "normal", "plane_residual": "quaternion"}],
    ids=lambda forms: " ".join(forms.values()) or "usual",
)
def test_exact_measurements_cost_nothing(exact, forms):
    assembly = assemble(exact, AssemblyOptions(**forms))
    others = {"relations in pixels", "camera motions", "principal points", "held scale"}
    assert set(assembly.num_measurements) == {term.name for term in TERMS} - others
    for name, group in zip(assembly.terms, assembly.groups, strict=True):
        assert np.abs(residuals_of(group.factor, assembly.problem.variables)).max() < 1e-7, name


@pytest.mark.parametrize("plane_residual", ["normal_offset", "quaternion"])
def test_the_unit_of_length_does_not_matter(exact, noisy, plane_residual):
    """Everything measured, seen from another world in another unit, is the same problem."""
    scene = noisy[1].replace(pose_priors=exact.pose_priors)
    moved = scene.transformed(Similarity(7.0, np.diag([-1.0, -1.0, 1.0]), np.array([3.0, -2.0, 5.0])))
    if plane_residual == "normal_offset":
        assert cost(moved) == pytest.approx(cost(scene), rel=1e-9)
    turned = scene.transformed(Similarity(1.0, np.diag([-1.0, -1.0, 1.0])))
    assert cost(turned, plane_residual=plane_residual) == pytest.approx(
        cost(scene, plane_residual=plane_residual), rel=1e-9
    )


def test_cameras_on_rigs_measure_the_same(exact, noisy):
    """Images taken by a camera beside the middle of its rig: another parametrisation, the same residuals."""
    scene = noisy[1]
    mount = np.array([0, 0, math.sin(0.1), math.cos(0.1), 0.3, -0.2, 0.1])
    inverse = groma.geometry.se3.inverse(mount[None])
    rigs = scene.replace(
        frames=scene.frames.replace(
            rig_from_world=groma.geometry.se3.compose(
                np.repeat(inverse, scene.num_images, axis=0), scene.cam_from_world
            )
        ),
        sensors=scene.sensors.replace(cam_from_rig=mount[None], is_reference=[0]),
    )
    np.testing.assert_allclose(rigs.cam_from_world[:, 4:], scene.cam_from_world[:, 4:], atol=1e-12)
    assert cost(rigs) == pytest.approx(cost(scene), rel=1e-9)


def test_depths_of_segments_in_images_with_distortion(exact):
    """Without distortion parameters OPENCV is PINHOLE, but its segments are compared by bearings."""
    old = exact.cameras
    params = np.hstack([old.params, np.zeros((1, 4))])
    cameras = Cameras(old.ids, ("OPENCV",), params, old.width, old.height)
    scene = exact.replace(cameras=cameras, right_columns=type(exact.right_columns)())
    assembly = assemble(scene, AssemblyOptions())
    assert assembly.num_measurements["line depths"] == len(exact.line_depths)
    for group in assembly.groups:
        assert np.abs(residuals_of(group.factor, assembly.problem.variables)).max() < 1e-7
    # A shift of all inverse depths weighs about the same in both forms.
    shifted = {"line_depths": exact.line_depths.replace(inverse_depth=exact.line_depths.inverse_depth * 1.05)}
    only = {"points": False, "planes": False}
    assert cost(scene.replace(**shifted), **only) == pytest.approx(cost(exact.replace(**shifted), **only), rel=0.3)


def test_segments_of_distorted_images_follow_an_estimated_calibration(exact):
    """Their rays are those of the present calibration; with the form that makes them once a sentence says so."""
    old = exact.cameras
    params = np.hstack([old.params, np.zeros((1, 4))])
    cameras = Cameras(old.ids, ("OPENCV",), params, old.width, old.height)
    bent = exact.replace(cameras=cameras, right_columns=type(exact.right_columns)())
    kinds = {}
    for refined in (False, True):
        assembly = assemble(bent, AssemblyOptions(refine_intrinsics=refined))
        kinds[refined] = {factor.type_name for factor in assembly.problem.factors}
        assert not assembly.notes
    assert "line_bearing" in kinds[False] and "line_unprojection" not in kinds[False]
    assert "line_unprojection" in kinds[True]
    notes = assemble(bent, AssemblyOptions(refine_intrinsics=True, line_residual="normal")).notes
    assert any("they hold it" in note for note in notes)


def test_right_columns_without_a_left_image_in_pinhole_form_are_left_out(exact):
    old = exact.cameras
    cameras = Cameras(old.ids, ("RADIAL",), [[*old.params[0, [0, 2, 3]], 0.01, 0.0]], old.width, old.height)
    assembly = assemble(exact.replace(cameras=cameras), AssemblyOptions())
    assert "right columns" not in assembly.num_measurements
    assert assembly.num_measurements["point observations"] == len(exact.point_observations)
    assert any("Rectify the pairs" in note for note in assembly.notes)


def test_measured_lengths_bring_the_scale_back(noisy):
    """Depths of 1 cm at about 5 units: a start that is a tenth too large comes back to within a thousandth."""
    truth, start = noisy
    grown = Similarity(1.1)
    tables = ("frames", "points", "lines", "planes")
    large = start.replace(**{name: getattr(start.transformed(grown), name) for name in tables})
    result = groma.adjust(large)
    scale = align_poses(result.scene.cam_from_world, truth.cam_from_world).scale
    assert scale == pytest.approx(1.0, abs=1e-3)
    report = result.report
    assert report.num_observations == len(start.point_observations) + len(start.line_observations)
    assert report.num_measurements == start.num_measurements
    assert report.rmse_px["points"]["after"] == pytest.approx(0.5 * math.sqrt(2), rel=0.2)
    assert [stage["loss"] for stage in report.stages] == ["cauchy"]
    assert set(report.relations) == {k for k in Relations.kinds() if len(getattr(start.relations, k))}
    assert "point depths" in str(report)


def test_a_metric_scene_that_has_converged_is_kept(noisy):
    """What an adjustment has left, and what tracking has, is no reason to move; a start that is off is."""
    adjusted = groma.adjust(noisy[1]).scene
    again = groma.adjust(adjusted)
    assert again.report.solve.iterations == 0
    assert again.report.termination is Termination.COST_CONVERGED
    assert again.report.rmse_px["points"]["before"] == again.report.rmse_px["points"]["after"]
    for name in ("cam_from_world", "points", "lines", "planes"):
        before, after = (getattr(scene, name) for scene in (adjusted, again.scene))
        fields = {"points": "xyz", "lines": "plucker", "planes": "hesse"}
        before, after = (getattr(x, fields[name]) if name in fields else x for x in (before, after))
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-12)
    further = groma.adjust(adjusted, groma.AdjustOptions(start_tolerance=0.0, function_tolerance=1e-12))
    assert further.report.solve.iterations > 0
    assert further.report.solve.final_cost <= again.report.solve.final_cost
    poses = adjusted.frames.rig_from_world.copy()
    poses[-1, 4:] += 0.02
    moved = groma.adjust(adjusted.replace(frames=adjusted.frames.replace(rig_from_world=poses)))
    assert moved.report.solve.iterations > 0
    assert np.abs(moved.scene.cam_from_world - adjusted.cam_from_world).max() < 2e-3


def test_a_metric_scene_is_held_by_its_first_camera_alone(noisy):
    frames = assemble(noisy[1], AssemblyOptions()).problem.variables["frames"]
    assert np.asarray(frames.constant).sum() == 6
    bare = noisy[1].replace(**{name: type(getattr(noisy[1], name))() for name in ("point_depths", "right_columns")})
    bare = bare.replace(line_depths=type(bare.line_depths)(), plane_observations=type(bare.plane_observations)())
    assert np.asarray(assemble(bare, AssemblyOptions()).problem.variables["frames"].constant).sum() == 7


@pytest.mark.parametrize("form", [{"line_residual": "bearing"}, {"line_residual": "normal"}])
def test_forms_of_lines_agree(form):
    """Whitened alike, the forms differ to second order in the noise: cameras move by far less than its effect.

    The normal is whitened where the adjustment begins, so it begins near the end here.
    """
    made = holistic(20, noise_px=0.5, seed=4)
    start = made.start.replace(relations=Relations())
    options = groma.AdjustOptions(loss="none", planes=False, function_tolerance=1e-10)
    usual = groma.adjust(start, options)
    other = groma.adjust(usual.scene, replace(options, **form))
    truth = made.truth.cam_from_world
    centers = [align_poses(r.scene.cam_from_world, truth).points(r.scene.cam_centers_in_world) for r in (usual, other)]
    error = np.sqrt(((centers[0] - made.truth.cam_centers_in_world) ** 2).sum(axis=1).mean())
    apart = np.sqrt(((centers[0] - centers[1]) ** 2).sum(axis=1).mean())
    assert apart < 0.1 * error
    before, after = (r.report.rmse_px["lines"]["after"] for r in (usual, other))
    assert after == pytest.approx(before, rel=0.02)


def test_forms_of_planes_agree(noisy):
    usual = groma.adjust(noisy[1], groma.AdjustOptions(function_tolerance=1e-10))
    other = groma.adjust(noisy[1], groma.AdjustOptions(function_tolerance=1e-10, plane_residual="quaternion"))
    moved = np.linalg.norm(usual.scene.cam_centers_in_world - other.scene.cam_centers_in_world, axis=1)
    error = np.linalg.norm(usual.scene.cam_centers_in_world - noisy[0].cam_centers_in_world, axis=1)
    assert np.median(moved) < 0.1 * np.median(error)


@pytest.mark.parametrize("name", ["line_residual", "plane_residual", "point_chart"])
def test_forms_that_are_not_known(noisy, name):
    with pytest.raises(InputError, match=f"{name} must be one of"):
        assemble(noisy[1], AssemblyOptions(**{name: "nothing"}))


def test_a_kind_of_measurement_from_outside(noisy):
    """Positions of cameras, from GPS say: a term that holds its measurements itself."""
    truth, start = noisy
    centers = truth.cam_centers_in_world[:6]

    def factors(draft):
        positions = PositionPrior(pose=Ref("frames", np.arange(6)), cam_center_in_world=centers, sqrt_information=1e3)
        yield Group(positions)

    term = Term("positions", (), (), factors)
    result = groma.adjust(start, groma.AdjustOptions(terms=(term,), gauge="free"))
    assert result.report.num_measurements["positions"] == 6
    np.testing.assert_allclose(result.scene.cam_centers_in_world[:6], centers, atol=3e-3)


def test_parts_are_the_whole(noisy, tmp_path):
    """Depths and columns go with their landmarks, and the parts together cost what the whole costs."""
    scene = noisy[1].replace(relations=Relations(), plane_observations=type(noisy[1].plane_observations)())
    paths = write_parts(scene, tmp_path / "parts", observations=150)
    parts = [read_archive(path) for path in paths]
    assert len(parts) > 2
    for table in ("point_depths", "right_columns", "line_depths"):
        assert sum(len(getattr(part, table)) for part in parts) == len(getattr(scene, table)) > 0
    result = adjust_parts(paths, tmp_path / "adjusted", options=SolverOptions(max_iterations=1))
    assert result.report.initial_cost == pytest.approx(cost(scene, planes=False), rel=1e-9)
    assert result.report.final_cost < result.report.initial_cost


def test_turned_right_cameras_are_found(noisy):
    """Columns of all pairs that are 0.3 pixels too large are told by what else is known of the points."""
    start = noisy[1]
    table = start.right_columns
    start = start.replace(right_columns=table.replace(u_right=table.u_right + 0.3))
    sigma = np.array([1e-5, 0.5 / start.cameras.params[0, 0], 1e-5])
    options = AssemblyOptions(right_turn=RightTurnPrior(np.zeros(3), np.diag(1.0 / sigma)))
    solution = solve(assemble(start, options).problem, SolverOptions())
    axis = groma.geometry.quaternion.to_matrix(solution["right_cameras"][0, :4])[:, 2]
    offset = start.cameras.params[0, 0] * axis[0] / axis[2]
    # half a pixel of noise in several hundred columns
    assert offset == pytest.approx(0.3, abs=4 * 0.5 / math.sqrt(len(table)) * 2)
