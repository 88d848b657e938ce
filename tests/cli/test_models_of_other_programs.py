# SPDX-License-Identifier: BSD-3-Clause
"""Commands take the files of other programs, and their folders, wherever they take COLMAP models."""

import importlib
import json
import sys
from pathlib import Path

import pytest

from groma.cli.main import run
from groma.io import read_scene

sys.path.insert(0, str(Path(__file__).parents[1] / "io"))
_views = importlib.import_module("_views")
_openmvg = importlib.import_module("test_openmvg")
_transforms = importlib.import_module("test_transforms")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with ``mvg/sfm_data.json`` and, poses alone, ``nerf/transforms.json``."""
    monkeypatch.chdir(tmp_path)
    for folder in ("mvg", "nerf"):
        Path(folder).mkdir()
    true = _views.views(5, 40)
    _openmvg.write(tmp_path / "mvg", _openmvg.document(true, "pinhole", []))
    _transforms.write(tmp_path / "nerf", {**_transforms.LENS, "frames": _transforms.frames(true)})
    return tmp_path


@pytest.mark.parametrize("source", ["mvg", "mvg/sfm_data.json"])
def test_they_are_adjusted(here, source, capsys):
    assert run(["adjust", source, "-o", "out", "--json", "r.json"]) == 0
    assert json.loads(Path("r.json").read_text())["rmse_px"]["points"]["after"] < 1e-6
    assert read_scene("out").num_images == 5


def test_they_are_converted(here, capsys):
    assert run(["convert", "mvg", "transforms.json"]) == 0
    assert "5 images, 40 points\n" in capsys.readouterr().out  # observations have no place there
    assert run(["convert", "transforms.json", "out.npz"]) == 0
    assert read_scene("out.npz").num_points == 40
    assert run(["convert", "nerf", "out"]) == 0
    assert read_scene("out").num_images == 5


def test_images_that_are_missing_beside_others_are_said(here, capsys):
    names = read_scene("nerf").images.names
    assert run(["convert", "nerf", "none.npz"]) == 0
    assert capsys.readouterr().err == ""  # a model alone
    for name in names[:3]:
        (Path("nerf") / name).parent.mkdir(parents=True, exist_ok=True)
        (Path("nerf") / name).write_bytes(b"")
    assert run(["convert", "nerf", "some", "--json", "r.json"]) == 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "2 of the 5 images" in said and names[3] in said and names[2] not in said
    assert json.loads(Path("r.json").read_text())["warnings"][0] in said
    for name in names[3:]:
        (Path("nerf") / name).write_bytes(b"")
    assert run(["convert", "nerf", "all.npz"]) == 0
    assert capsys.readouterr().err == ""


def test_a_model_without_image_sizes_is_said(here, capsys):
    """Bundler's files have none; with the photographs beside them they are known."""
    lens, pose = "500 0 0\n", "1 0 0\n0 1 0\n0 0 1\n0 0 0\n"
    Path("bundle.out").write_text("# Bundle file v0.3\n2 0\n" + 2 * (lens + pose))
    Path("list.txt").write_text("a.jpg\nb.jpg\n")
    assert run(["convert", "bundle.out", "sized.npz"]) == 0
    assert capsys.readouterr().err == ""
    assert run(["convert", "bundle.out", "model"]) == 0
    assert "2 cameras have no known size" in capsys.readouterr().err


def test_points_that_no_image_sees_are_said(here, capsys):
    """OpenSfM's observations are in a file of their own, which is not always there."""
    lens = {"projection_type": "perspective", "width": 640, "height": 480, "focal": 0.9, "k1": 0.0, "k2": 0.0}
    shot = {"camera": "one", "rotation": [0.0, 0.0, 0.0], "translation": [0.0, 0.0, 0.0]}
    points = {"1": {"coordinates": [0.0, 0.0, 5.0]}, "2": {"coordinates": [1.0, 0.0, 5.0]}}
    document = [{"cameras": {"one": lens}, "shots": {"a.jpg": shot}, "points": points}]
    Path("reconstruction.json").write_text(json.dumps(document))
    assert run(["convert", "reconstruction.json", "out.npz"]) == 0
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "which images see its 2 points" in said and "tracks.csv" in said
    assert run(["convert", "reconstruction.json", "transforms.json"]) == 0  # no place for them
    assert capsys.readouterr().err == ""
    Path("tracks.csv").write_text("a.jpg\t1\t0\t0.0\t0.0\n")
    assert run(["convert", "reconstruction.json", "seen.npz"]) == 0
    assert capsys.readouterr().err == ""
    assert run(["convert", "mvg", "all.npz"]) == 0
    assert capsys.readouterr().err == ""


def test_poses_alone_are_no_model_for_a_map(here, capsys):
    Path("images").mkdir()
    assert run(["map", "images", "--model", "nerf", "-o", "out"]) == 1
    assert capsys.readouterr().err.count("\n") == 1
    assert run(["adjust", "nerf", "-o", "out"]) == 1
    said = capsys.readouterr().err
    assert "nothing to adjust" in said and "no observations of points or lines. groma map PHOTOGRAPHS --poses" in said


def test_damage_is_one_line(here, capsys):
    text = Path("mvg/sfm_data.json").read_text()
    Path("mvg/sfm_data.json").write_text(text[: len(text) // 2])
    assert run(["convert", "mvg", "out.npz"]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and "sfm_data.json is not JSON from line" in said
