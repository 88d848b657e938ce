# SPDX-License-Identifier: BSD-3-Clause
"""Headlines: inliers and their rms, the noise that residuals show, what cameras are known to, what did not converge."""

import re

import numpy as np
import pytest
from typer.testing import CliRunner

import groma
from groma.adjustment.fit import inliers, noise_of
from groma.adjustment.uncertainty import position_sigma, uncertainty
from groma.cameras import model
from groma.cli.app import app
from groma.cli.shared.sentences import describe_pose_uncertainty
from groma.geometry import se3
from groma.io import write_scene
from groma.scene.synthetic import corridor


def test_inliers_of_known_residuals():
    """Nine tenths of noise and a tenth of outliers: the noise, its share and its rms, however far outliers lie."""
    rng = np.random.default_rng(0)
    sigma, count = 0.4, 40_000
    noise = np.sum(rng.normal(0, sigma, (count, 2)) ** 2, axis=1)
    for far in (20.0, 2000.0):
        after = np.where(rng.random(count) < 0.1, far**2, noise)
        found = inliers({"points": 4.0 * after}, {"points": after}, {"points": np.ones(count)})["points"]
        assert noise_of(after) == pytest.approx(sigma, rel=0.1)
        assert found["share"]["after"] == pytest.approx(0.9, abs=0.01)
        assert found["rmse_px"]["after"] == pytest.approx(sigma * np.sqrt(2), rel=0.03)
        assert found["rmse_px"]["before"] == pytest.approx(2 * found["rmse_px"]["after"])  # of the same observations
        assert found["share"]["before"] < found["share"]["after"]
    assert inliers(*3 * ({"points": np.zeros(3)},)) == {}


def spoiled(seed=2):
    scene, rng = corridor(40, seed=seed).start.points_only(), np.random.default_rng(seed)
    pixel = scene.point_observations.pixel.copy()
    wild = rng.random(len(pixel)) < 0.08
    pixel[wild] += rng.normal(0, 30, (int(wild.sum()), 2))
    return scene.replace(point_observations=scene.point_observations.replace(pixel=pixel))


def test_the_headline_falls_where_the_result_improves(tmp_path):
    """Outliers are left where they are, so that the rms of everything may grow; that of inliers says what happened."""
    scene = spoiled()
    report = groma.adjust(scene).report
    told = report.inliers["points"]
    left = 1.0 - report.solve.num_unknowns / report.solve.num_residuals  # of the variance, when unknowns are fitted
    assert told["rmse_px"]["after"] == pytest.approx(0.5 * np.sqrt(2 * left), rel=0.1)
    assert told["rmse_px"]["after"] < told["rmse_px"]["before"]
    assert 0.88 < told["share"]["after"] < 0.93 and told["share"]["before"] < told["share"]["after"]
    assert report.sigma0 == pytest.approx(0.5, rel=0.15)
    again = groma.adjust(groma.adjust(scene).scene).report.inliers["points"]
    assert again["rmse_px"]["before"] == pytest.approx(again["rmse_px"]["after"], rel=0.1)
    assert "rms of the inliers" in str(report) and report.to_dict()["inliers"] == report.inliers
    write_scene(scene, tmp_path / "scene.npz")
    said = CliRunner().invoke(app, ["adjust", str(tmp_path / "scene.npz")]).stdout
    assert re.search(r"rms of inliers +inliers", said) and re.search(r"points .* -> 9\d\.\d %", said)
    assert "Cameras: centres known to" in said
    assert "outliers included" not in said


def exactly_seen(scene):
    """The scene with its points observed without noise."""
    table = scene.point_observations
    in_camera = se3.transform_points(scene.cam_from_world[table.image_idx], scene.points.xyz[table.point_idx])
    pixel = model(scene.cameras.models[0]).project(scene.cameras.params_of(0), in_camera)
    return scene.replace(point_observations=table.replace(pixel=pixel))


def test_cameras_are_known_as_well_as_they_come_out():
    """Ten draws of the noise scatter as the standard deviations say, which are scaled by the noise that is seen."""
    truth, rng, errors, told = corridor(10, seed=1).truth.points_only(), np.random.default_rng(0), [], []
    for _ in range(10):
        noisy = exactly_seen(truth)
        pixel = noisy.point_observations.pixel
        pixel = pixel + rng.normal(0, 0.5, pixel.shape)
        noisy = noisy.replace(point_observations=noisy.point_observations.replace(pixel=pixel))
        result = groma.adjust(noisy, groma.AdjustOptions(loss="none"))
        errors.append(groma.evaluate_poses(result.scene, truth).center_rmse)
        told.append(result.pose_uncertainty())
        full = uncertainty(result.scene, problem=result.problem, sigma0=result.report.sigma0)
        assert told[-1]["center"]["median"] == pytest.approx(np.median(position_sigma(full.centers)), rel=1e-6)
    predicted = np.mean([numbers["center"]["median"] for numbers in told])
    assert 0.5 < np.mean(errors) / predicted < 2.0
    assert told[-1]["calibration"] == "all"
    assert describe_pose_uncertainty(told[-1])[0].endswith("; the calibration counts as exact")
    estimated = groma.AdjustOptions(loss="none", refine_intrinsics=True, refine_principal_point=False)
    lens = groma.adjust(noisy, estimated).pose_uncertainty()
    assert lens is not None and lens["calibration"] == "part"  # principal points are held
    assert "what is held of the calibration" in describe_pose_uncertainty(lens)[0]
    whole = groma.adjust(noisy, groma.AdjustOptions(loss="none", refine_intrinsics=True)).pose_uncertainty()
    assert whole is not None and whole["calibration"] == "none"
    assert describe_pose_uncertainty(whole)[0].endswith("; errors of the estimated calibration are in them")
    held = groma.adjust(truth, groma.AdjustOptions(refine_poses=False))
    assert held.pose_uncertainty() is None


def test_cameras_that_are_not_determined_are_told():
    """Two halves that share no point: nothing says where one is as seen from the other."""
    scene = exactly_seen(corridor(10, seed=1).truth.points_only())
    table = scene.point_observations
    halves = (table.image_idx < 5) == (table.point_idx % 2 == 0)
    result = groma.adjust(scene.replace(point_observations=table.take(halves)), groma.AdjustOptions(loss="none"))
    numbers = result.pose_uncertainty()
    assert numbers is not None and numbers["center"] == {"median": None, "largest": None, "undetermined": 10}
    assert "rank deficient" in numbers["why_not"] and "The diagnosis (--diagnosis; in Python" in numbers["why_not"]
    told = describe_pose_uncertainty(numbers)
    assert told == [f"Cameras: how well they are known cannot be told. {numbers['why_not']}"]
    assert describe_pose_uncertainty(None) == []


def test_what_did_not_converge_says_so(tmp_path):
    scene = spoiled()
    short = groma.adjust(scene, groma.AdjustOptions(max_iterations=2))
    assert not short.report.solve.converged
    assert any(text.startswith("Not converged after 2 steps.") for text in short.report.warnings)
    assert any(text.startswith("Not converged") for text in short.summary()["warnings"])
    assert not any("onverged" in text for text in groma.adjust(scene).report.warnings)
    start_alone = groma.adjust(scene, groma.AdjustOptions(max_iterations=0))
    assert not any("onverged" in text for text in start_alone.report.warnings)
    write_scene(scene, tmp_path / "scene.npz")
    found = CliRunner().invoke(app, ["adjust", str(tmp_path / "scene.npz"), "--max-iterations", "2"])
    assert found.exit_code == 0 and "warning: Not converged after 2 steps." in found.stderr
