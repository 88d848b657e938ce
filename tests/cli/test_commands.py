# SPDX-License-Identifier: BSD-3-Clause
"""Every command on tiny data: what it writes, what it says, what it refuses, and that nothing is left behind."""

import json
import os

import _comparison as compare
import cv2
import numpy as np
import pytest

from groma._counted import counted
from groma._kernels import cache as kernel_cache
from groma.cli.main import run
from groma.cli.shared.sentences import spent
from groma.compilation.time import Compilation, compilation_time
from groma.io import read_scene, write_scene

pytestmark = pytest.mark.kernels


@pytest.mark.compiled
def test_adjust(scenes, here, capsys):
    assert run(["adjust", str(scenes / "points.npz"), "-o", "out.npz", "--json", "r.json", "--report", "p.html"]) == 0
    said = capsys.readouterr()
    assert "rms of inliers" in said.out and "Wrote out.npz" in said.out
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


def test_page_of_an_adjustment_shows_the_photographs(scenes, here):
    """They are found where ``groma view`` finds them: here in the folder that ``summary.json`` names."""
    scene = read_scene(scenes / "points.npz")
    (here / "photos").mkdir()
    for name in scene.images.names:
        cv2.imwrite(str(here / "photos" / f"{name}.png"), np.full((60, 80), 90, np.uint8))
    names = tuple(f"{name}.png" for name in scene.images.names)
    write_scene(scene.replace(images=scene.images.replace(names=names)), here / "map")
    for photographs, number in (("../photos", len(names)), ("elsewhere", 0)):
        (here / "map" / "summary.json").write_text(json.dumps({"images": photographs}))
        assert run(["adjust", "map", "--max-iterations", "1", "--report", "p.html", "--force", "--quiet"]) == 0
        assert (here / "p.html").read_text().count("data:image/jpeg") == number


def test_the_photographs_of_a_project_are_its_images(scenes, here, capsys):
    """Masks and depths beside them are none; a picture in the folder, or a model of its names, says otherwise."""
    (here / "site" / "sparse").mkdir(parents=True)
    for kind in ("images", "masks", "depth"):
        (here / "site" / kind).mkdir(parents=True)
        for number in range(2):
            cv2.imwrite(str(here / "site" / kind / f"{number}.png"), np.full((60, 80), 90 + number, np.uint8))
    assert run(["map", "site", "-o", "out"]) == 1
    said = capsys.readouterr()
    assert f"Photographs: {os.path.join('site', 'images')};" in said.out and "holds 2 images" in said.err
    assert "is not used" not in said.out
    scene = read_scene(scenes / "points.npz")
    write_scene(scene, here / "site" / "sparse" / "0")
    assert run(["map", "site", "-o", "out"]) == 1
    assert "The model in site is not used; --model site would save" in capsys.readouterr().out
    assert run(["map", "site", "--model", "site", "-o", "out"]) == 1
    assert "is not used" not in capsys.readouterr().out
    names = ("images/0.png", *scene.images.names[1:])
    write_scene(scene.replace(images=scene.images.replace(names=names)), here / "model.npz")
    assert run(["map", "site", "--model", "model.npz", "-o", "out"]) == 1
    assert "Photographs:" not in capsys.readouterr().out
    cv2.imwrite("site/0.png", np.full((60, 80), 30, np.uint8))
    assert run(["map", "site", "-o", "out", "--min-length", "20"]) == 1
    assert "Photographs:" not in capsys.readouterr().out


@pytest.mark.compiled
@pytest.mark.parametrize("form", ["bearing", "normal"])
def test_adjust_by_other_residuals_of_lines(scenes, here, form):
    arguments = ["adjust", str(scenes / "start.npz"), "--no-planes", "--gauge", "first_camera", "--json", "r.json"]
    arguments += ["--loss", "none", "--force"]
    assert run([*arguments, "-o", "usual.npz"]) == 0
    assert run([*arguments, "-o", "other.npz", "--line-residual", form]) == 0
    usual, other = (read_scene(f"{name}.npz").cam_centers_in_world for name in ("usual", "other"))
    assert not np.array_equal(usual, other)
    np.testing.assert_allclose(usual, other, atol=0.05)


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
        ["adjust", "GOOD", "-o", "out.xyz"],
        ["adjust", "GOOD", "-o", "out.txt"],
        ["adjust", "GOOD", "-o", "taken.npz"],
        ["adjust", "GOOD", "-o", "a", "--report", "a"],
        ["adjust", "GOOD", "--report", "p.html", "--json", "./p.html"],
        ["adjust", "GOOD", "--contributions", "--truth", "missing"],
        ["adjust", "GOOD", "--json", "taken.npz"],
        ["adjust", "GOOD", "--report", "taken.npz"],
        ["adjust", "GOOD", "--loss", "magic"],
        ["adjust", "GOOD", "--loss", "huber", "--loss-scale", "-1"],
        ["adjust", "GOOD", "--line-chart", "magic"],
        ["adjust", "POINTS", "--line-chart", "magic"],
        ["adjust", "GOOD", "--gauge", "magic"],
        ["adjust", "GOOD", "--no-points", "--no-lines"],
        ["adjust", "GOOD", "--covariance", "taken.npz"],
        ["adjust", "GOOD", "--covariance", "c.txt"],
        ["adjust", "GOOD", "--covariance", "c.npz", "--sigma0", "0"],
        ["convert", "GOOD", "taken.npz"],
        ["convert", "missing", "out.npz"],
        ["convert", "parent", "out.npz"],
        ["report", "missing", "-o", "out.html"],
        ["report", "GOOD", "-o", "folder", "--force"],
        ["view", "missing", "--no-browser"],
        ["evaluate", "poses", "GOOD", "missing"],
        ["evaluate", "planes", "GOOD", "GOOD", "--threshold", "1"],
        ["evaluate", "trajectory", "noise.npz", "noise.npz"],
        ["map", "walk.MP4", "-o", "out"],
        ["map", "folder", "-o", "out"],
        ["map", "folder", "-o", "out", "--model", "missing"],
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
    (here / "parent" / "model").mkdir(parents=True)
    (here / "parent" / "model" / "cameras.txt").touch()
    (here / "walk.MP4").touch()
    before = sorted(os.listdir(here))
    files = {"GOOD": str(scenes / "start.npz"), "POINTS": str(scenes / "points.npz")}
    assert run([files.get(word, word) for word in arguments]) == 1
    said = capsys.readouterr().err
    assert said.startswith("groma: ") and said.count("\n") == 1, said
    assert sorted(os.listdir(here)) == before
    assert (here / "taken.npz").read_text() == "precious"


@pytest.mark.parametrize("name", ["out.xyz", "out.txt"])
def test_a_target_that_cannot_hold_the_result_is_refused_before_the_work(scenes, here, name, monkeypatch):
    """The work takes hours in large scenes, and its result would be lost."""
    monkeypatch.setattr("groma.adjustment.adjust.adjust", lambda *_: pytest.fail("was adjusted"))
    assert run(["adjust", str(scenes / "start.npz"), "-o", name]) == 1
    assert os.listdir(here) == []


def test_a_folder_of_archives_says_so(scenes, here, capsys):
    assert run(["report", str(scenes)]) == 1
    assert "points.npz" in capsys.readouterr().err


def test_planes_that_match_nothing_have_no_errors(scenes, here, capsys):
    assert run(["evaluate", "planes", str(scenes / "points.npz"), str(scenes / "truth.npz")]) == 0
    said = capsys.readouterr()
    assert "recall 0.0 %" in said.out and "nan" not in said.out
    assert "holds no planes" in said.err


def test_the_time_to_load_compiled_code_stands_apart(scenes, here, capsys):
    assert run(["adjust", str(scenes / "points.npz"), "--max-iterations", "2", "--json", "r.json"]) == 0
    seconds = json.loads((here / "r.json").read_text())["seconds"]
    assert 0.0 <= seconds["compilation"] <= seconds["total"]
    assert f"2 steps in {max(seconds['total'] - seconds['compilation'], 0.0):.2f} s" in capsys.readouterr().out


def test_compilation_is_measured():
    numba = pytest.importorskip("numba")
    if numba.config.DISABLE_JIT:
        pytest.skip("nothing is compiled")
    with compilation_time() as nothing:
        pass
    with compilation_time() as something:
        numba.njit(lambda x: x + 1.0)(1.0)
    assert nothing == Compilation(0.0, False) and something.seconds > 0.0
    assert spent(1.5, 1.25, compiled=False) == "0.25 s, and 1.25 s to load compiled code"
    assert spent(1.5, 1.25, compiled=True) == "0.25 s, and 1.25 s to compile"
    assert spent(1.5, 0.0, compiled=False) == "1.50 s"
    assert spent(0.9, 1.25, compiled=True) == "1.25 s, nearly all to compile"


def test_compiling_is_told_from_loading(monkeypatch):
    for name, told in (("loaded", False), ("compiled", True), ("unsaved", True)):
        with compilation_time() as compilation:
            monkeypatch.setattr(kernel_cache.counts, name, getattr(kernel_cache.counts, name) + 1)
        assert compilation.compiled == told


def test_counts_are_words():
    assert [counted(count, "images") for count in (0, 1, 22106)] == ["0 images", "1 image", "22,106 images"]


def test_poses_of_one_image_are_no_comparison(scenes, here, capsys):
    write_scene(read_scene(scenes / "truth.npz").subset([0]), here / "one.npz")
    assert run(["evaluate", "poses", "one.npz", str(scenes / "truth.npz")]) == 0
    told = capsys.readouterr()
    assert "1 image in both" in told.out and "whatever their poses" in told.err


def test_force_replaces(scenes, here):
    (here / "taken.npz").write_text("old")
    assert run(["convert", str(scenes / "points.npz"), "taken.npz", "--force", "--quiet"]) == 0
    assert read_scene(here / "taken.npz").num_points > 0


@pytest.mark.parametrize("name", ["copy.npz", "model"])
def test_convert(scenes, here, name, capsys):
    assert run(["convert", str(scenes / "points.npz"), name, "--json", "-"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    assert numbers["num_points"] == read_scene(here / name).num_points


def test_what_a_file_of_cameras_and_points_has_no_place_for_is_said(scenes, here, capsys):
    lines = read_scene(scenes / "start.npz").num_lines
    assert run(["convert", str(scenes / "start.npz"), "transforms.json"]) == 0
    assert f"poses and points; it has no place for {lines} lines and 1 plane." in capsys.readouterr().err
    assert run(["convert", str(scenes / "points.npz"), "other.json"]) == 0
    assert "no place" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "cameras"),
    [
        ("out.ply", ""),
        ("out.obj", ""),
        ("out.dxf", "6 images, "),
        ("out.glb", "6 images, "),
        ("out.gltf", "6 images, "),
    ],
)
def test_geometry_holds_no_observations(scenes, here, capsys, name, cameras):
    scene = read_scene(scenes / "start.npz")
    assert run(["convert", str(scenes / "start.npz"), name]) == 0
    said = capsys.readouterr().out
    assert said == f"Wrote {name}: {cameras}{scene.num_points} points, {scene.num_lines} lines, 1 plane\n"


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


def test_an_exchanged_map_is_named(tmp_path, capsys):
    (tmp_path / "map.npz").touch()
    assert run(["localize", str(tmp_path), str(tmp_path / "map.npz"), "-o", str(tmp_path / "out")]) == 1
    assert f"groma localize {tmp_path / 'map.npz'} {tmp_path} -o" in capsys.readouterr().err
