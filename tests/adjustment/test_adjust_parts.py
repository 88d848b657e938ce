"""Adjustment in parts on disk: what a part holds, the same result as at once, and what is refused."""

import numpy as np
import pytest

import groma
from groma.adjustment.parts import adjust_parts, write_parts
from groma.adjustment.terms.principal_points import near_the_middle
from groma.errors import InputError, OutputError
from groma.evaluation import evaluate_poses
from groma.factors.losses import Cauchy, Huber
from groma.scene import synthetic
from groma.solver.options import SolverOptions

pytestmark = pytest.mark.kernels
#: The loop stops when the next step is foreseen not to matter; poses are compared to more digits than the cost needs.
OPTIONS = SolverOptions(function_tolerance=1e-12, threads=1)


@pytest.fixture
def scene():
    return synthetic.corridor("tiny").start


def test_parts_hold_every_landmark_once_with_its_observations(scene, tmp_path):
    paths = write_parts(scene, tmp_path / "parts", observations=150)
    parts = [groma.read_scene(path) for path in paths]
    assert len(parts) > 3
    assert all(part.images.names == scene.images.names for part in parts)
    assert max(part.num_observations for part in parts) < 150 + scene.num_images
    for name in ("points", "lines"):
        ids = np.concatenate([getattr(part, name).ids for part in parts])
        np.testing.assert_array_equal(np.sort(ids), np.sort(getattr(scene, name).ids))
    measured = {
        (scene.points.ids[point], image): tuple(pixel)
        for point, image, pixel in zip(
            scene.point_observations.point_idx, scene.point_observations.image_idx, scene.point_observations.pixel,
            strict=True,
        )
    }  # fmt: skip
    for part in parts:
        table = part.point_observations
        for point, image, pixel in zip(table.point_idx, table.image_idx, table.pixel, strict=True):
            assert measured.pop((part.points.ids[point], image)) == tuple(pixel)
    assert not measured


@pytest.mark.compiled
@pytest.mark.parametrize("lines", [False, True])
def test_result_is_that_of_the_whole_scene(scene, tmp_path, lines):
    scene = scene if lines else scene.points_only()
    paths = write_parts(scene, tmp_path / "parts", observations=150)
    result = adjust_parts(paths, tmp_path / "out", options=OPTIONS, planes=False)
    whole = groma.adjust(scene, groma.AdjustOptions(loss="none", planes=False, function_tolerance=1e-12))
    np.testing.assert_allclose(result.report.final_cost, whole.report.solve.final_cost, rtol=1e-6)
    for path, source in zip(result.paths, paths, strict=True):
        part, before = groma.read_scene(path), groma.read_scene(source)
        assert path.name == source.name
        # Some of the few lines are weak: the cost of the whole is the same to six digits over millimetres.
        assert evaluate_poses(part, whole.scene).center_max < (5e-3 if lines else 1e-5)
        np.testing.assert_array_equal(part.point_observations.pixel, before.point_observations.pixel)
        np.testing.assert_array_equal(part.cam_from_world, groma.read_scene(result.paths[0]).cam_from_world)
        assert (part.points.xyz != before.points.xyz).any() or part.num_points == 0


@pytest.mark.compiled
def test_a_robust_loss_is_used(scene, tmp_path):
    table = scene.point_observations
    pixel = table.pixel.copy()
    pixel[::40] += 50.0
    spoiled = scene.points_only().replace(point_observations=table.replace(pixel=pixel))
    paths = write_parts(spoiled, tmp_path / "parts", observations=200)
    result = adjust_parts(paths, tmp_path / "out", Cauchy(1.0), OPTIONS)
    whole = groma.adjust(spoiled, groma.AdjustOptions(loss="cauchy", function_tolerance=1e-10))
    np.testing.assert_allclose(result.report.final_cost, whole.report.solve.final_cost, rtol=1e-6)


@pytest.mark.compiled
def test_intrinsics_are_estimated_if_asked(scene, tmp_path):
    scene = scene.points_only()
    paths = write_parts(scene, tmp_path / "parts", observations=200)
    result = adjust_parts(paths, tmp_path / "out", options=OPTIONS, refine_intrinsics=True)
    whole = groma.adjust(
        scene,
        groma.AdjustOptions(
            loss="none", refine_intrinsics=True, refine_principal_point=False, function_tolerance=1e-10
        ),
    ).scene
    for path in result.paths:
        np.testing.assert_allclose(groma.read_scene(path).cameras.params, whole.cameras.params, rtol=1e-5)
    assert (whole.cameras.params[0, :2] != scene.cameras.params[0, :2]).all()


@pytest.mark.parametrize("refine", [False, True])
@pytest.mark.compiled
def test_a_calibration_that_was_not_given_is_held_and_that_is_said(scene, tmp_path, refine):
    paths = write_parts(near_the_middle(scene.points_only()), tmp_path / "parts", observations=200)
    result = adjust_parts(paths, tmp_path / "out", options=OPTIONS, refine_intrinsics=refine)
    said = [sentence for sentence in result.warnings if "was not given" in sentence]
    assert len(said) == 1 and ("--refine-intrinsics" in said[0]) == (not refine)


def test_refuses_what_does_not_belong_together(scene, tmp_path):
    paths = write_parts(scene, tmp_path / "parts", observations=300)
    other = write_parts(synthetic.corridor(13).start, tmp_path / "other")
    with pytest.raises(InputError, match="same file name"):
        adjust_parts([paths[0], other[0]], tmp_path / "x")
    with pytest.raises(InputError, match="other images or cameras"):
        adjust_parts([paths[0], other[0].rename(tmp_path / "other.npz")], tmp_path / "x")
    with pytest.raises(InputError, match="nothing to adjust"):
        empty = scene.points_only()
        empty = empty.replace(points=empty.points.take([]), point_observations=empty.point_observations.take([]))
        groma.write_scene(empty, tmp_path / "empty.npz")
        adjust_parts([tmp_path / "empty.npz"], tmp_path / "x")
    with pytest.raises(InputError, match="at least one observation"):
        write_parts(scene, tmp_path / "x", observations=0)


@pytest.mark.parametrize("loss", [None, Huber(1.0)])
def test_landmarks_alone_are_adjusted_in_parts(scene, tmp_path, loss):
    """With cameras held nothing is shared: what landmarks have left to gain still counts."""
    scene = scene.points_only()
    paths = write_parts(scene, tmp_path / "parts", observations=300)
    assert len(paths) > 1
    options = SolverOptions(function_tolerance=1e-9, max_iterations=300, threads=1)
    result = adjust_parts(paths, tmp_path / "out", loss=loss, options=options, refine_poses=False)
    told = groma.AdjustOptions(
        loss=loss.name if loss else "none", refine_poses=False, function_tolerance=1e-9, max_iterations=300
    )
    whole = groma.adjust(scene, told).report.solve
    assert whole.final_cost < 0.5 * whole.initial_cost
    assert result.report.final_cost == pytest.approx(whole.final_cost, rel=1e-6)


@pytest.mark.compiled
def test_results_are_not_overwritten_unasked(scene, tmp_path):
    paths = write_parts(scene, tmp_path / "parts", observations=300)
    adjust_parts(paths, tmp_path / "out", options=SolverOptions(max_iterations=1))
    with pytest.raises(OutputError):
        adjust_parts(paths, tmp_path / "out", options=SolverOptions(max_iterations=1))
