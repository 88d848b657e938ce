# SPDX-License-Identifier: BSD-3-Clause
"""Images read row by row: poses and motions against exact truth, with points and lines; what is told; the archive."""

import json
from dataclasses import replace

import numpy as np
import pytest
from _rolling import disturbed, photographs, rolling_scene, video

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.parts.cut import write_parts
from groma.adjustment.rolling_shutter import adjust_rolling_shutter, motions_of, with_rolling_shutter
from groma.adjustment.terms import readout
from groma.cli.main import run
from groma.errors import FileFormatError, InputError
from groma.evaluation import evaluate_poses
from groma.gates import NORMAL
from groma.io import read_scene, write_scene
from groma.scene import CameraMotions, PointDepths, Similarity, synthetic

NOISE = AdjustOptions(point_sigma_px=0.3, line_sigma_px=0.3)


def errors(scene, truth):
    """Root mean square error of centres, and mean error of rotations in degrees."""
    found = evaluate_poses(scene, truth)
    return found.center_rmse, found.rotation_deg_mean


def motion_errors(scene, motions):
    """Root mean square errors of shifts and of turns (degrees)."""
    off = scene.camera_motions.motion - motions
    return np.sqrt(np.mean(off[:, :3] ** 2)), np.degrees(np.sqrt(np.mean(off[:, 3:] ** 2)))


@pytest.mark.parametrize("along", ["rows", "columns"])
def test_photographs_read_row_by_row(along):
    poses, motions = photographs()
    truth = rolling_scene(poses, motions, by_columns=along == "columns")
    start = disturbed(truth)
    plain = errors(adjust(start, NOISE).scene, truth)
    found = adjust_rolling_shutter(with_rolling_shutter(start, along), NOISE)
    centre, angle = errors(found.result.scene, truth)
    assert centre < 0.2 * plain[0] and angle < 0.2 * plain[1]
    shift, turn = motion_errors(found.result.scene, motions)
    assert shift < 0.5 * 0.03 and turn < 0.15  # of 0.03 and 1 degree
    # How well motions are known beforehand is found; they are no sequence, and nothing is said against them.
    assert found.motions.sigma[0] == pytest.approx(0.03, rel=0.4)
    assert np.degrees(found.motions.sigma[1]) == pytest.approx(1.0, rel=0.3)
    assert found.motions.share == 0.0 and found.motions.warnings() == ()
    assert found.motions.explained is not None and found.motions.explained > 0.8
    assert found.result.report.sigma0 == pytest.approx(1.0, rel=0.1)


def test_lines_alone_tell_motions_that_points_leave():
    poses, motions = photographs()
    truth = rolling_scene(poses, motions, lines=150)
    known = with_rolling_shutter(truth)
    held = AdjustOptions(points=False, point_sigma_px=0.3, line_sigma_px=0.3)
    found = adjust_rolling_shutter(known, held)
    assert motion_errors(found.result.scene, motions)[1] < 0.3
    bearings = adjust_rolling_shutter(known, AdjustOptions(**{**vars(held), "line_residual": "bearing"}))
    assert motion_errors(bearings.result.scene, motions)[1] < 0.3
    with pytest.raises(InputError, match="'normal' knows no rolling shutter"):
        adjust(known, AdjustOptions(line_residual="normal"))


def test_a_video_is_a_sequence_and_its_rows_are_parallel():
    poses, motions = video()
    truth = rolling_scene(poses, motions)
    found = adjust_rolling_shutter(with_rolling_shutter(disturbed(truth)), NOISE)
    assert found.motions.share == pytest.approx(0.6, abs=0.05)
    centre, angle = errors(found.result.scene, truth)
    assert centre < 0.006 and angle < 0.06  # 0.10 and 0.7 degrees at once
    assert motion_errors(found.result.scene, motions)[1] < 0.15
    (warning,) = found.motions.warnings()
    assert "read along nearly the same direction" in warning and "the path of the camera" in warning
    assert "reading one takes 0.61 of the time to the next" in found.motions.sentences()[1]


def test_noise_of_rows_does_not_bias_motions(monkeypatch):
    """Least squares has its minimum near the true motions, though rows are measured with the noise of pixels."""
    poses, motions = video()
    truth = with_rolling_shutter(rolling_scene(poses, motions, noise=1.0))
    truth = truth.replace(camera_motions=truth.camera_motions.replace(motion=motions, expected=motions))

    def bias():
        found = adjust(truth, AdjustOptions(loss="none")).scene
        return np.degrees(np.abs((found.camera_motions.motion[:, 3:] - motions[:, 3:]).mean(axis=0))).max()

    predicted = bias()
    monkeypatch.setattr(readout, "NORMAL", replace(NORMAL, mistake=0.0))
    assert bias() > 4.0 * predicted  # where a row counts as observed


def test_images_at_once_have_no_motions():
    poses, motions = photographs()
    still = rolling_scene(poses, 0.0 * motions)
    found = adjust_rolling_shutter(with_rolling_shutter(still), NOISE)
    # What was found is noise, is told alone, and does not touch the scene.
    assert np.abs(found.motions.motion[:, :3]).max() < 0.01
    assert np.degrees(np.abs(found.motions.motion[:, 3:])).max() < 0.1
    assert found.motions.explained is not None and found.motions.explained < 0.05
    (warning,) = found.motions.warnings()
    assert found.motions.left_out and "The images show next to no rolling shutter" in warning
    assert found.motions.sentences() == () and found.motions.to_dict()["left_out"]
    assert not len(found.result.scene.camera_motions)
    np.testing.assert_array_equal(found.result.scene.cam_from_world, adjust(still, NOISE).scene.cam_from_world)


def test_motions_are_kept_moved_and_cut(tmp_path):
    poses, motions = photographs()
    scene = with_rolling_shutter(rolling_scene(poses, motions), "columns")
    scene = scene.replace(camera_motions=scene.camera_motions.replace(motion=motions))
    write_scene(scene, tmp_path / "scene.npz")
    read = read_scene(tmp_path / "scene.npz").camera_motions
    for name in ("image_idx", "motion", "expected", "sigma", "axis"):
        np.testing.assert_array_equal(getattr(read, name), getattr(scene.camera_motions, name))
    larger = scene.transformed(Similarity(scale=2.0)).camera_motions
    np.testing.assert_allclose(larger.motion, motions * [2, 2, 2, 1, 1, 1])
    np.testing.assert_allclose(larger.sigma[:, 0], 2.0 * scene.camera_motions.sigma[:, 0])
    fewer = scene.keep(points=np.arange(scene.num_points) < 50).camera_motions
    np.testing.assert_array_equal(fewer.motion, motions)
    with pytest.raises(InputError, match="not adjusted in parts"):
        write_parts(scene, tmp_path / "parts")


def test_a_later_format_is_refused(tmp_path):
    poses, motions = photographs()
    write_scene(with_rolling_shutter(rolling_scene(poses, motions)), tmp_path / "scene.npz")
    content = dict(np.load(tmp_path / "scene.npz"))
    np.savez(tmp_path / "later.npz", **{**content, "version": np.array(99)})
    with pytest.raises(FileFormatError, match="version 99"):
        read_scene(tmp_path / "later.npz")
    np.savez(tmp_path / "wrong.npz", **{**content, "camera_motions.motion": np.zeros((12, 5))})
    with pytest.raises(FileFormatError, match=r"camera_motions\.motion must have shape"):
        read_scene(tmp_path / "wrong.npz")


def test_what_cannot_be_is_refused():
    scene = synthetic.holistic(4).start
    nowhere = scene.replace(cameras=scene.cameras.replace(width=[0], height=[0]))
    with pytest.raises(InputError, match="needs the size of the images"):
        with_rolling_shutter(nowhere)
    seen = PointDepths([0], [0], [1.0], [0.1])
    with pytest.raises(InputError, match="Depths, stereo pairs and measured planes"):
        with_rolling_shutter(scene.replace(point_depths=seen))
    with pytest.raises(InputError, match="reads along rows or columns; got 'diagonal'"):
        with_rolling_shutter(scene, "diagonal")
    with pytest.raises(InputError, match="axis must be 0 or 1"):
        CameraMotions([0], np.zeros((1, 6)), np.zeros((1, 6)), np.ones((1, 6)), [2])


def test_the_command_estimates_motions(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    poses, motions = photographs()
    truth = rolling_scene(poses, motions)
    write_scene(disturbed(truth), tmp_path / "start.npz")
    assert run(["adjust", "start.npz", "--rolling-shutter", "rows", "-o", "out.npz", "--json", "out.json"]) == 0
    assert "Rolling shutter of 12 images: while one is read the camera moves by" in capsys.readouterr().out
    numbers = json.loads((tmp_path / "out.json").read_text())["rolling_shutter"]
    assert numbers["turn_deg"]["median"] == pytest.approx(
        np.degrees(np.median(np.linalg.norm(motions[:, 3:], axis=1))), rel=0.1
    )
    found = read_scene(tmp_path / "out.npz")
    assert motion_errors(found, motions)[1] < 0.2
    # The motions are part of the scene: a later adjustment uses them unasked.
    assert run(["adjust", "out.npz", "-o", "again.npz"]) == 0
    assert "Rolling shutter of 12 images" in capsys.readouterr().out
    again = read_scene(tmp_path / "again.npz")
    assert np.abs(again.camera_motions.motion - found.camera_motions.motion).max() < 0.005
    assert run(["adjust", "start.npz", "--rolling-shutter", "up"]) == 1
    assert "rows or columns; got 'up'" in capsys.readouterr().err


def test_motions_of_held_cameras_stay():
    poses, motions = photographs()
    scene = with_rolling_shutter(rolling_scene(poses, motions))
    found = adjust(scene, AdjustOptions(refine_poses=False))
    assert not found.scene.camera_motions.motion.any()
    assert motions_of(found.scene, found.problem).redundancy.shape == (12, 6)
