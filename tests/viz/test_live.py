# SPDX-License-Identifier: BSD-3-Clause
"""``groma view --live``: what the page says and draws before, while and after a track runs."""

import shutil

import numpy as np
import pytest
from _scene import exact_scene
from typer.testing import CliRunner

from groma.cli.app import app
from groma.io import write_scene
from groma.io.trajectories import Trajectory, write_tum
from groma.viz.viewer import live

ROW = "{} 0.1 0 {} 0 0 0 1 {}\n"


@pytest.fixture(scope="module")
def scene():
    return exact_scene()


def test_rows_of_frames(tmp_path):
    path = tmp_path / "frames.txt"
    # The last row is not complete; the map was begun anew after the first row.
    path.write_text(ROW.format(0.0, 0.0, 0) + ROW.format(0.1, 0.5, 1) + ROW.format(0.2, 0.7, 1) + "0.3 0.1")
    np.testing.assert_array_equal(live.read_frames(path), [[0, 0, 0, 1, 0.1, 0, 0.5], [0, 0, 0, 1, 0.1, 0, 0.7]])
    path.write_text("")
    assert live.read_frames(path).shape == (0, 7)


def test_a_track_from_waiting_to_finished(tmp_path, scene):
    output, work = tmp_path / "out", tmp_path / "out.work"
    with live.following(output, port=0) as view:
        view.refresh()
        assert view.state == live.WAITING
        work.mkdir()
        view.refresh()
        assert view.state == live.RUNNING
        assert view.scene is None
        (work / "frames.txt").write_text(ROW.format(0.0, 0.0, 0) + ROW.format(0.1, 0.5, 0))
        write_scene(scene, work / "scene.npz")
        assert view.refresh()
        assert view.num_frames == 2
        assert view.scene is not None
        assert view.scene.num_lines == scene.num_lines
        assert not view.refresh()
        (work / "scene.npz").write_bytes(b"being replaced")
        view.refresh()
        assert view.scene is not None
        assert view.scene.num_lines == scene.num_lines
        output.mkdir()
        write_scene(scene, output / "scene.npz")
        write_tum(Trajectory(np.arange(3.0), np.tile([0, 0, 0, 1.0, 0, 0, 0], (3, 1))), output / "trajectory.txt")
        shutil.rmtree(work)
        assert view.refresh()
        assert view.state == live.FINISHED
        assert view.num_frames == 3


def test_a_file_is_no_track(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"")
    result = CliRunner().invoke(app, ["view", "--live", str(tmp_path / "model.npz"), "--no-browser"])
    assert result.exit_code == 1
    assert "groma track -o" in " ".join(result.output.split())
