# SPDX-License-Identifier: BSD-3-Clause
"""Results that summarise, diagnose and write themselves; ``groma adjust`` and ``groma convert`` as library calls."""

import json

import numpy as np
import pytest

import groma
from groma.cli.main import run
from groma.errors import InputError, OutputError
from groma.io.geometry import Geometry
from groma.scene import synthetic

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def scene():
    return synthetic.holistic(6, seed=3).start


@pytest.mark.compiled
def test_a_summary_is_what_the_command_writes(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    groma.write_scene(scene, "start.npz")
    command = ["adjust", "start.npz", "--covariance", "command.npz", "--contributions", "--json", "report.json"]
    assert run([*command, "--max-iterations", "5", "--quiet"]) == 0
    options = groma.AdjustOptions(max_iterations=5)
    result = groma.adjust(scene, options)
    ours = result.summary(result.diagnose(), groma.contributions(scene, options))
    uncertainty = result.uncertainty()
    groma.write_covariances("call.npz", result.scene, uncertainty)
    theirs = json.loads((tmp_path / "report.json").read_text())
    assert [*ours, "uncertainty"] == list(theirs)
    assert ours["diagnosis"].pop("seconds") and theirs["diagnosis"].pop("seconds")
    for name in ("final_cost", "rmse_px", "diagnosis", "warnings", "iterations"):
        assert json.loads(json.dumps(ours[name])) == theirs[name]
    assert [entry["rmse_px"] for entry in ours["contributions"]] == [
        entry["rmse_px"] for entry in theirs["contributions"]
    ]
    with np.load("call.npz") as called, np.load("command.npz") as commanded:
        assert set(called.files) == set(commanded.files)
        for name in called.files:
            np.testing.assert_array_equal(called[name], commanded[name])
    with pytest.raises(OutputError, match="exists already"):
        groma.write_covariances("call.npz", result.scene, uncertainty)
    with pytest.raises(InputError, match=r"\.npz or \.json; got call\.txt"):
        groma.write_covariances("call.txt", result.scene, uncertainty)


@pytest.mark.compiled
def test_a_result_speaks_of_the_problem_that_was_solved(scene):
    """Twice the noise, twice the standard deviation; the function on the scene alone would not know."""
    sigma = []
    for noise in (1.0, 2.0):
        result = groma.adjust(
            scene.points_only(), groma.AdjustOptions(loss="none", point_sigma_px=noise, max_iterations=20)
        )
        sigma.append(np.sqrt(np.trace(result.uncertainty("inner").points[0])))
        assert result.diagnose().sentences
    assert sigma[1] == pytest.approx(2 * sigma[0], rel=1e-4)


def test_without_diagnosis_and_contributions_a_summary_is_the_report(scene):
    result = groma.adjust(scene, groma.AdjustOptions(max_iterations=1))
    summary = result.summary()
    assert summary["diagnosis"] is None and "contributions" not in summary
    assert {name: summary[name] for name in result.report.to_dict()} == result.report.to_dict()


def test_convert_keeps_what_is_there(scene, tmp_path):
    groma.write_scene(scene, tmp_path / "scene.npz")
    read = groma.convert(tmp_path / "scene.npz", tmp_path / "model")
    assert groma.read_scene(tmp_path / "model").num_lines == read.num_lines == scene.num_lines
    with pytest.raises(OutputError):
        groma.convert(tmp_path / "scene.npz", tmp_path / "model")
    groma.convert(tmp_path / "scene.npz", tmp_path / "model", force=True)


def test_lines_are_compared_with_scenes_and_with_geometry(scene):
    truth = synthetic.holistic(6, seed=3).truth
    edges = Geometry(segments=truth.lines.segments)
    assert groma.evaluate_lines(scene, truth).to_dict() == groma.evaluate_lines(scene, edges).to_dict()
    with pytest.raises(InputError, match="geometry alone has none"):
        groma.evaluate_lines(scene, edges, align=True)
