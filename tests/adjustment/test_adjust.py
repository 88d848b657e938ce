"""Adjusting scenes: noise floor with every chart, structure, gauge, robust stages, distortion, what is refused."""

import dataclasses
import warnings

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.terms.contract import Term
from groma.errors import InputError, ProblemError
from groma.evaluation.poses import evaluate_poses
from groma.scene import Relations
from groma.scene.synthetic.scenes import holistic

CHARTS = ["cartesian", "orthonormal_right", "orthonormal_left", "free_right", "free_left"]


def without_relations(scene):
    return scene.replace(relations=Relations())


def chi_square(result):
    """Reduced chi-square; a scene that is free to move has seven unknowns fewer."""
    solve = result.report.solve
    free = 7 if solve.num_unknowns % 6 == 0 else 0
    return 2 * solve.final_cost / (solve.num_residuals - solve.num_unknowns + free)


@pytest.mark.parametrize("chart", CHARTS)
def test_points_and_lines_reach_the_noise_floor_in_every_chart(chart):
    start = without_relations(holistic(50, seed=0).start)
    result = adjust(start, AdjustOptions(loss="none", line_chart=chart))
    assert result.report.solve.converged
    # 4 600 redundant residuals: one standard deviation of the reduced chi-square is 0.021
    assert abs(chi_square(result) - 1) < 0.05


def test_lines_take_about_as_many_steps_as_points():
    start = without_relations(holistic(50, seed=0).start)
    points = adjust(start, AdjustOptions(loss="none", lines=False)).report.solve
    lines = adjust(start, AdjustOptions(loss="none")).report.solve
    assert points.iterations <= 6
    assert lines.iterations <= 8


@pytest.mark.parametrize("seed", [0, 1])
def test_points_lines_and_planes_reach_the_noise_floor(seed):
    scene = holistic(50, seed=seed)
    result = adjust(scene.start, AdjustOptions(loss="none"))
    assert result.report.solve.converged
    assert result.report.solve.iterations <= 10
    assert abs(chi_square(result) - 1) < 0.05
    # landmarks that belong together do so after the adjustment
    point, plane = result.scene.relations.point_on_plane.T
    hesse = result.scene.planes.hesse[plane]
    off = np.einsum("ij,ij->i", hesse[:, :3], result.scene.points.xyz[point]) + hesse[:, 3]
    assert np.abs(off).max() < 2e-3


def test_relations_do_not_shrink_the_scene():
    """Distances between landmarks cost less in a smaller scene; the scale must be held."""
    scene = holistic(50, seed=2)
    result = adjust(scene.start, AdjustOptions(loss="none"))
    extent = [np.ptp(s.cam_centers_in_world, axis=0).mean() for s in (scene.truth, result.scene)]
    np.testing.assert_allclose(extent[1], extent[0], rtol=0.02)


def test_default_is_robust():
    scene = without_relations(holistic(20, seed=3, noise_px=0.3).start)
    observations = scene.point_observations
    pixel = observations.pixel.copy()
    wrong = np.random.default_rng(0).choice(len(pixel), len(pixel) // 20, replace=False)
    pixel[wrong] += np.random.default_rng(1).uniform(-60, 60, (len(wrong), 2))
    spoiled = scene.replace(point_observations=observations.replace(pixel=pixel))

    def center_rmse(result):
        return evaluate_poses(result.scene, holistic(20, seed=3, noise_px=0.3).truth).center_rmse

    assert center_rmse(adjust(spoiled)) < 0.2 * center_rmse(adjust(spoiled, AdjustOptions(loss="none")))


def test_intrinsics_are_recovered():
    scene = without_relations(holistic(30, seed=4, noise_px=0.2).start)
    params = scene.cameras.params.copy()
    focal = params[0, 0]
    params[:, 0] *= 1.02
    start = scene.with_params(params)
    result = adjust(start, AdjustOptions(loss="none", refine_intrinsics=True))
    after = result.scene.cameras.params[0]
    assert abs(after[0] / focal - 1) < 1e-3
    np.testing.assert_allclose(after[-2:], params[0, -2:], atol=0.2)  # the middle, which counts as a guess
    held = adjust(start, AdjustOptions(loss="none", refine_intrinsics=True, refine_principal_point=False))
    np.testing.assert_array_equal(held.scene.cameras.params[0, -2:], params[0, -2:])


def test_lines_under_distortion_use_bearings():
    from groma.cameras import model

    scene = without_relations(holistic(20, seed=5, noise_px=0.3).start)
    pinhole = scene.cameras.params[0]
    kind = scene.cameras.models[0]
    K = model(kind).pinhole_parameters(pinhole[: model(kind).num_parameters])[0]
    radial = np.array([[K[0], K[2], K[3], -0.12, 0.03]])

    def distort(pixel):
        rays = np.column_stack([(pixel - K[2:]) / K[:2], np.ones(len(pixel))])
        return model("RADIAL").project(radial[0], rays)

    segment = scene.line_observations.segment
    segment = np.hstack([distort(segment[:, :2]), distort(segment[:, 2:])])
    distorted = scene.replace(
        cameras=dataclasses.replace(scene.cameras, models=("RADIAL",), params=radial),
        point_observations=scene.point_observations.replace(pixel=distort(scene.point_observations.pixel)),
        line_observations=scene.line_observations.replace(segment=segment),
    )
    result = adjust(distorted, AdjustOptions(loss="none"))
    assert {"point_reprojection", "line_bearing"} == set(result.report.solve.final_costs)
    assert result.report.rmse_px["lines"]["after"] < 0.6


def test_scene_is_not_changed_and_report_is_complete():
    scene = holistic(10, seed=6).start
    before = scene.frames.rig_from_world.copy()
    events = []
    result = adjust(scene, progress=events.append)
    np.testing.assert_array_equal(scene.frames.rig_from_world, before)
    numbers = result.report.to_dict()
    expected = (
        "num_images num_points num_lines num_planes num_observations initial_cost final_cost iterations termination"
    )
    assert set(expected.split()) <= numbers.keys()
    assert {"total", "setup", "linearize", "schur", "solve", "backsubstitute", "cost"} == numbers["seconds"].keys()
    assert numbers["rmse_px"]["points"]["after"] < numbers["rmse_px"]["points"]["before"]
    assert events[-1].iteration == numbers["iterations"] == len(result.report.history)


def test_nothing_to_adjust_and_unknown_options_are_refused():
    scene = holistic(10, seed=7).start
    with pytest.raises(InputError, match="nothing to adjust"):
        adjust(scene, AdjustOptions(points=False, lines=False))
    with pytest.raises(InputError, match="line_chart must be one of"):
        adjust(scene, AdjustOptions(line_chart="polar"))
    with pytest.raises(InputError, match="gauge must be"):
        adjust(scene, AdjustOptions(gauge="none"))
    with pytest.raises(InputError, match="linear_solver must be one of"):
        adjust(scene, AdjustOptions(linear_solver="magic"))
    with pytest.raises(InputError):
        adjust(scene, AdjustOptions(loss="magic"))


@pytest.mark.slow
def test_few_steps_where_points_lie_on_lines():
    """Eleven steps were needed before points took steps of their own: tight ties are curved."""
    start = holistic(1000, noise_px=1.0, seed=2, views="near").start
    result = adjust(start, AdjustOptions(loss="none", max_iterations=10))
    assert result.report.solve.converged


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: adjust("model"), r"scene must be a Scene; got str.*read_scene"),
        (lambda: AdjustOptions(point_sigma_px=0.0), "point_sigma_px must be a positive number"),
        (lambda: AdjustOptions(line_sigma_px=float("nan")), "line_sigma_px must be a positive number"),
    ],
)
def test_what_is_not_a_scene_or_a_noise_is_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_a_report_prints_its_main_figures():
    report = adjust(without_relations(holistic(8, seed=0).start), AdjustOptions(max_iterations=3)).report
    text = str(report).splitlines()
    assert text[0].startswith(f"{report.num_images} images, {report.num_points} points, {report.num_lines} lines")
    assert text[1].startswith("points: ") and text[2].startswith("lines: ")
    assert report.termination.sentence in text[3] and len(text) < 12


def test_a_focal_length_of_zero_is_refused_without_warnings():
    scene = holistic(6, seed=1).start
    params = scene.cameras.params.copy()
    params[0, 0] = 0.0
    with warnings.catch_warnings(), pytest.raises(ProblemError, match="positive focal lengths"):
        warnings.simplefilter("error")
        adjust(scene.replace(cameras=dataclasses.replace(scene.cameras, params=params)))


@pytest.mark.parametrize("loss", ["auto", "none"])
def test_without_a_step_nothing_moves(loss):
    """Lines that fit badly are started again between two stages, but not where the start alone is evaluated."""
    start = holistic(8, noise_px=0.5, seed=1).start
    result = adjust(start, AdjustOptions(loss=loss, max_iterations=0, check_lens=False))
    assert result.report.solve.final_cost == result.report.solve.initial_cost
    np.testing.assert_allclose(result.scene.lines.plucker, start.lines.plucker, atol=1e-12)
    np.testing.assert_array_equal(result.scene.points.xyz, start.points.xyz)


def _blas_threads() -> int:
    return max(library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas")


@pytest.mark.kernels
def test_linear_algebra_libraries_have_one_thread_all_the_time():
    """Outside of the solves too: their threads would spin while they wait, on cores that other threads need."""
    seen = []

    def factors(draft):
        seen.append(_blas_threads())
        return iter(())

    term = Term("asked while the problem is made", (), (), factors)
    options = AdjustOptions(loss="none", max_iterations=2, terms=(term,))
    with threadpool_limits(2, "blas"):
        adjust(holistic(6, seed=0).start, options)
    assert seen == [1]
