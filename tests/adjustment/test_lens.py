# SPDX-License-Identifier: BSD-3-Clause
"""Lens distortion that cameras lack: noticed and named where it is, and only there; cameras in another model."""

from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

import groma
from groma.adjustment.misfit.lens import LensGates, radial_field, unmodelled_distortion
from groma.cameras import in_model, model
from groma.cli.app import app
from groma.errors import InputError
from groma.io import read_scene, write_scene
from groma.scene import Scene
from groma.scene.synthetic import corridor

POINTS = groma.AdjustOptions(lines=False, planes=False, check_lens=False)


def through_lens(scene: Scene, k1: float) -> Scene:
    """The scene as cameras with a radial distortion would have seen it; the cameras know nothing of it."""
    table, opencv, pinhole = scene.point_observations, model("OPENCV"), model("PINHOLE")
    params = scene.cameras.params_of(0)
    bent = in_model(params, pinhole, opencv)
    bent[opencv.parameter_names.index("k1")] = k1
    pixel = opencv.project(bent, pinhole.unproject(params, table.pixel))
    seen = np.isfinite(pixel).all(axis=1)
    return scene.replace(point_observations=table.replace(pixel=pixel).take(np.flatnonzero(seen)))


@pytest.fixture(scope="module")
def scene():
    return corridor(24, seed=3).start.points_only()


@pytest.mark.parametrize("k1", [-0.1, -0.02, 0.05])
def test_a_lens_is_noticed_and_its_remedy_works(scene, k1):
    bent = through_lens(scene, k1)
    plain = groma.adjust(bent)
    said = [text for text in plain.report.warnings if "lens distortion" in text]
    assert len(said) == 1 and "(PINHOLE)" in said[0] and "--camera-model OPENCV" in said[0]
    cured = groma.adjust(bent, groma.AdjustOptions(camera_model="OPENCV"))
    assert not any("lens distortion" in text for text in cured.report.warnings)
    assert cured.scene.cameras.models == ("OPENCV",)
    assert cured.scene.cameras.params_of(0)[4] == pytest.approx(k1, abs=0.004)
    assert cured.report.inliers["points"]["rmse_px"]["after"] < 0.8 * plain.report.inliers["points"]["rmse_px"]["after"]


@pytest.mark.parametrize("seed", range(6))
def test_noise_and_outliers_are_not_taken_for_a_lens(seed):
    """Six scenes with a share of wild observations; the first test alone has no false alarm at its probability."""
    scene, rng = corridor(10, seed=seed).start.points_only(), np.random.default_rng(seed)
    pixel = scene.point_observations.pixel.copy()
    wild = rng.random(len(pixel)) < 0.05
    pixel[wild] += rng.normal(0, 40, (int(wild.sum()), 2))
    spoiled = scene.replace(point_observations=scene.point_observations.replace(pixel=pixel))
    problem = groma.adjust(spoiled, POINTS).problem
    assert not radial_field(problem.factors[0], problem)
    assert unmodelled_distortion(problem) is None


def test_a_lens_too_weak_to_matter_is_not_told(scene):
    """Some thousand observations tell a distortion far below their noise; its share of the variance decides."""
    assert unmodelled_distortion(groma.adjust(through_lens(scene, -0.001), POINTS).problem) is None


def test_a_calibration_that_is_held_wrongly_is_to_be_refined(scene):
    bent = through_lens(scene, -0.05)
    held = bent.replace(cameras=bent.cameras.with_model("OPENCV"))
    assert any("--refine-intrinsics" in text for text in groma.adjust(held).report.warnings)
    freed = groma.adjust(held, groma.AdjustOptions(refine_intrinsics=True))
    assert not any("lens" in text for text in freed.report.warnings)


def test_a_part_of_the_points_tells_a_lens_as_well(scene):
    some = LensGates(max_observations=2_000)
    assert scene.num_point_observations > 3 * some.max_observations
    bent, plain = (groma.adjust(s, POINTS).problem for s in (through_lens(scene, -0.05), scene))
    assert "--camera-model OPENCV" in unmodelled_distortion(bent, gates=some).sentence
    assert unmodelled_distortion(plain, gates=replace(some, false_alarm=0.999)) is None


def test_lines_do_not_hide_a_lens():
    """Segments are turned into rays before a solve: with another model, points settle the lens before."""
    scene = corridor(16, seed=5).start
    result = groma.adjust(through_lens(scene, -0.06), groma.AdjustOptions(planes=False))
    assert any("lens distortion" in text for text in result.report.warnings)
    straight = groma.adjust(scene, groma.AdjustOptions(planes=False, camera_model="OPENCV"))
    assert np.abs(straight.scene.cameras.params_of(0)[4:]).max() < 0.01
    assert straight.report.inliers["lines"]["rmse_px"]["after"] < 1.0


@pytest.mark.parametrize(
    ("old", "new"),
    [("SIMPLE_PINHOLE", "PINHOLE"), ("PINHOLE", "OPENCV"), ("SIMPLE_RADIAL", "RADIAL"), ("RADIAL", "OPENCV"),
     ("OPENCV", "FULL_OPENCV"), ("SIMPLE_RADIAL", "OPENCV")],
)  # fmt: skip
def test_wider_models_see_the_same_pixels(old, new):
    rng, first, second = np.random.default_rng(0), model(old), model(new)
    params = np.zeros(first.num_parameters)
    params[list(first.focal_indices)] = 900.0
    params[list(first.principal_point_indices)] = [600.0, 400.0]
    params[list(first.extra_indices)] = rng.normal(0, 0.02, len(first.extra_indices))
    rays = rng.normal(0, 0.3, (50, 3)) + np.array([0, 0, 1.5])
    changed = in_model(params, first, second)
    np.testing.assert_allclose(second.project(changed, rays), first.project(params, rays), atol=1e-9)


def test_models_that_cannot_hold_a_camera_are_refused():
    params = np.array([900.0, 600.0, 400.0, -0.1])
    for new in ("PINHOLE", "OPENCV_FISHEYE", "SIMPLE_PINHOLE"):
        with pytest.raises(InputError, match=f"SIMPLE_RADIAL cannot be a {new}: its pixels would move by up to"):
            in_model(params, model("SIMPLE_RADIAL"), model(new))
    assert len(in_model(np.array([900.0, 900.0, 600.0, 400.0]), model("PINHOLE"), model("SIMPLE_PINHOLE"))) == 3
    with pytest.raises(InputError, match="cannot be a SIMPLE_PINHOLE"):
        in_model(np.array([900.0, 910.0, 600.0, 400.0]), model("PINHOLE"), model("SIMPLE_PINHOLE"))


def test_the_command_names_and_takes_the_remedy(tmp_path, scene):
    write_scene(through_lens(scene, -0.05), tmp_path / "bent.npz")
    words = ["adjust", str(tmp_path / "bent.npz"), "--no-diagnosis"]
    plain = CliRunner().invoke(app, words)
    assert plain.exit_code == 0 and "--camera-model OPENCV" in plain.stderr
    cured = CliRunner().invoke(app, [*words, "--camera-model", "OPENCV", "-o", str(tmp_path / "out.npz")])
    assert cured.exit_code == 0 and "lens" not in cured.stderr
    assert read_scene(tmp_path / "out.npz").cameras.models == ("OPENCV",)
    refused = CliRunner().invoke(app, [*words, "--camera-model", "OPENCV_FISHEYE"])
    assert refused.exit_code == 1 and "cannot be a OPENCV_FISHEYE" in refused.stderr
