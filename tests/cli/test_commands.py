# SPDX-License-Identifier: BSD-3-Clause
"""Every command on tiny data: what it writes, what it says, what it refuses, and that nothing is left behind."""

import json
import os

import numpy as np
import pytest

from groma.cli.main import run
from groma.io import read_scene, write_scene
from groma.scene import compare, synthetic

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    """A folder with truth.npz, start.npz (points, lines, planes) and points.npz (the same start, points alone)."""
    folder = tmp_path_factory.mktemp("scenes")
    made = synthetic.holistic(6, seed=3)
    write_scene(made.truth, folder / "truth.npz")
    write_scene(made.start, folder / "start.npz")
    write_scene(made.start.points_only(), folder / "points.npz")
    return folder


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_adjust(scenes, here, capsys):
    assert run(["adjust", str(scenes / "points.npz"), "-o", "out.npz", "--json", "r.json", "--report", "p.html"]) == 0
    said = capsys.readouterr()
    assert "points error" in said.out and "Wrote out.npz" in said.out
    assert "\r" not in said.err  # progress is for terminals
    report = json.loads((here / "r.json").read_text())
    start = read_scene(scenes / "points.npz")
    assert report["num_images"] == start.num_images
    assert report["num_points"] == start.num_points
    assert report["num_observations"] == start.num_observations
    assert report["num_lines"] == report["num_planes"] == 0
    assert report["final_cost"] < report["initial_cost"]
    assert report["rmse_px"]["points"]["after"] < report["rmse_px"]["points"]["before"]
    assert report["iterations"] > 0 and report["termination"]
    stages = {"total", "setup", "linearize", "schur", "solve", "backsubstitute", "cost"}
    assert stages <= set(report["seconds"])
    assert read_scene(here / "out.npz").num_points == start.num_points
    assert sorted(os.listdir(here)) == ["out.npz", "p.html", "r.json"]


def test_adjust_does_not_change_its_input(scenes, here):
    before = (scenes / "start.npz").read_bytes()
    assert run(["adjust", str(scenes / "start.npz"), "-o", "out.npz", "--max-iterations", "1"]) == 0
    assert (scenes / "start.npz").read_bytes() == before


@pytest.mark.parametrize(
    ("flags", "zero"),
    [(["--no-points"], "num_points"), (["--no-lines"], "num_lines"), (["--no-planes"], "num_planes")],
    ids=str,
)
def test_kinds_can_be_left_out(scenes, here, flags, zero, capsys):
    assert run(["adjust", str(scenes / "start.npz"), *flags, "--max-iterations", "1", "--json", "-"]) == 0
    report = json.loads(capsys.readouterr().out)  # nothing but the report on standard output
    kinds = {"num_points", "num_lines", "num_planes"}
    assert report[zero] == 0
    assert all(report[kind] > 0 for kind in kinds - {zero})


def test_no_step_changes_nothing(scenes, here):
    assert run(["adjust", str(scenes / "points.npz"), "-o", "same.npz", "--max-iterations", "0", "--quiet"]) == 0
    assert compare.near(read_scene(here / "same.npz"), read_scene(scenes / "points.npz"), 1e-12)


def test_adjust_to_colmap_and_back(scenes, here):
    assert run(["adjust", str(scenes / "points.npz"), "-o", "model", "--max-iterations", "2", "--quiet"]) == 0
    assert read_scene(here / "model").num_points == read_scene(scenes / "points.npz").num_points


def test_quiet_says_nothing(scenes, here, capsys):
    assert run(["adjust", str(scenes / "points.npz"), "-o", "q.npz", "--quiet", "--max-iterations", "1"]) == 0
    said = capsys.readouterr()
    assert said.out == "" and said.err == ""


def test_verbose_says_stages(scenes, here, capsys):
    assert run(["adjust", str(scenes / "points.npz"), "--verbose", "--max-iterations", "1"]) == 0
    said = capsys.readouterr().out
    assert "stages:" in said and "No -o given" in said


@pytest.mark.parametrize(
    "arguments",
    [
        ["adjust", "missing.txt", "-o", "out.npz"],
        ["adjust", "empty.txt", "-o", "out.npz"],
        ["adjust", "noise.npz", "-o", "out.npz"],
        ["adjust", "folder", "-o", "out"],
        ["adjust", "GOOD", "-o", "no/such/folder/out.npz"],
        ["adjust", "GOOD", "-o", "out.xyz"],
        ["adjust", "GOOD", "-o", "taken.npz"],
        ["adjust", "GOOD", "--json", "taken.npz"],
        ["adjust", "GOOD", "--report", "taken.npz"],
        ["adjust", "GOOD", "--loss", "magic"],
        ["adjust", "GOOD", "--loss", "huber", "--loss-scale", "-1"],
        ["adjust", "GOOD", "--line-chart", "magic"],
        ["adjust", "GOOD", "--gauge", "magic"],
        ["adjust", "GOOD", "--no-points", "--no-lines"],
        ["convert", "GOOD", "taken.npz"],
        ["convert", "missing", "out.npz"],
        ["report", "missing", "-o", "out.html"],
        ["evaluate", "poses", "GOOD", "missing"],
        ["synth", "-o", "taken.npz"],
        ["selfcheck", "--golden", "missing"],
    ],
    ids=" ".join,
)
def test_bad_input_is_one_line(scenes, here, arguments, capsys):
    (here / "empty.txt").write_text("")
    (here / "noise.npz").write_bytes(np.random.default_rng(0).bytes(500))
    (here / "taken.npz").write_text("precious")
    (here / "folder").mkdir()
    before = sorted(os.listdir(here))
    assert run([str(scenes / "start.npz") if word == "GOOD" else word for word in arguments]) == 1
    said = capsys.readouterr().err
    assert said.startswith("groma: ") and said.count("\n") == 1, said
    assert sorted(os.listdir(here)) == before
    assert (here / "taken.npz").read_text() == "precious"


def test_force_replaces(scenes, here):
    (here / "taken.npz").write_text("old")
    assert run(["convert", str(scenes / "points.npz"), "taken.npz", "--force", "--quiet"]) == 0
    assert read_scene(here / "taken.npz").num_points > 0


@pytest.mark.parametrize("name", ["copy.npz", "model"])
def test_convert(scenes, here, name, capsys):
    assert run(["convert", str(scenes / "points.npz"), name, "--json", "-"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["num_points"] == read_scene(here / name).num_points


def test_evaluate_poses(scenes, here, capsys):
    arguments = ["evaluate", "poses", str(scenes / "start.npz"), str(scenes / "truth.npz")]
    assert run([*arguments, "--json", "r.json"]) == 0
    assert "camera centres" in capsys.readouterr().out
    scores = json.loads((here / "r.json").read_text())
    assert scores["num_images"] == 6
    assert 0 < scores["center_rmse"] < 0.5
    assert 0 < scores["rotation_deg_mean"] <= scores["rotation_deg_max"] < 10
    assert all(0 <= value <= 1 for value in scores["auc"].values())


def test_evaluate_poses_of_the_same_scene(scenes, here, capsys):
    assert run(["evaluate", "poses", *[str(scenes / "truth.npz")] * 2, "--json", "-"]) == 0
    scores = json.loads(capsys.readouterr().out)
    # Alignment and comparison of a scene of size 10 with itself: rounding.
    assert scores["center_rmse"] < 1e-9 and scores["rotation_deg_max"] < 1e-5


def test_synth_is_repeatable(here, capsys):
    for name in ("a", "b"):
        assert run(["synth", "-o", name, "--cameras", "5", "--seed", "7", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out.split("}\n")[0] + "}")["num_images"] == 5
    for name in ("truth.npz", "start.npz"):
        assert compare.equal(read_scene(here / "a" / name), read_scene(here / "b" / name))


def test_report(scenes, here):
    assert run(["report", str(scenes / "truth.npz"), "--before", str(scenes / "start.npz"), "-o", "p.html"]) == 0
    assert "<!doctype html>" in (here / "p.html").read_text()
