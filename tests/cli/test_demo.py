# SPDX-License-Identifier: BSD-3-Clause
"""``groma demo`` and ``groma selfcheck``, as a newcomer runs them; the data that the package brings along."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from groma.cli.main import run
from groma.evaluation import cabinet as _cabinet
from groma.factors import contract, registered
from groma.io import read_scene
from groma.scene import Lines, Similarity

FEW = range(17, 29)


def test_packaged_data_are_complete_small_and_attributed():
    folder = _cabinet.folder()
    start, reference = read_scene(folder / "model"), read_scene(folder / "motion_capture")
    names = sorted(path.name for path in (folder / "images").iterdir())
    assert names == sorted(start.images.names) == sorted(reference.images.names)
    assert (len(names), start.num_points, start.num_point_observations) == (58, 1200, 4684)
    assert (start.num_lines, start.num_planes, reference.num_points) == (0, 0, 0)
    data = folder.parent
    assert sum(path.stat().st_size for path in data.rglob("*") if path.is_file()) < 3_000_000
    words = (data / "ATTRIBUTION.md").read_text(encoding="utf-8")
    assert all(word in words for word in ("CC BY 4.0", "TUM RGB-D", "Sturm", "cabinet/", "problem-16-22106-pre"))
    start_scores = _cabinet.evaluate_poses(start, reference)
    assert 0.02 < start_scores.center_rmse < 0.05


def _box(half_size):
    """End points of the twelve edges of a box in the place of the cabinet."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    pairs = [(i, j) for i in range(8) for j in range(i) if np.sum(corners[i] != corners[j]) == 1]
    turn = np.array(
        [
            [np.cos(_cabinet.HEADING), -np.sin(_cabinet.HEADING), 0],
            [np.sin(_cabinet.HEADING), np.cos(_cabinet.HEADING), 0],
            [0, 0, 1],
        ]
    )
    places = (corners * half_size) @ turn.T + _cabinet.CENTER
    return np.array([[places[i], places[j]] for i, j in pairs])


def test_cabinet_is_measured_right():
    scene = read_scene(_cabinet.folder() / "motion_capture")
    same = Similarity()
    larger = _cabinet.HALF_SIZE + np.array([0.01, -0.02, 0.005])
    scores = _cabinet.score_cabinet(scene.replace(lines=Lines.through(_box(larger))), same)
    assert (scores["num_edges"], scores["num_lines"]) == (12, 12)
    np.testing.assert_allclose(scores["size"], 2 * larger, atol=1e-9)
    # Four edges each at hypot(0.02, 0.005), hypot(0.01, 0.005) and hypot(0.01, 0.02): the first is the median.
    assert scores["distance"] == pytest.approx(np.hypot(0.02, 0.005), abs=1e-9)
    # Lines elsewhere, across, or too short belong to no edge; a side without lines leaves the size unknown.
    box = _box(_cabinet.HALF_SIZE)
    short = box.mean(1, keepdims=True) + 0.1 * (box - box.mean(1, keepdims=True))
    for wrong in (box + 0.3, short):
        scores = _cabinet.score_cabinet(scene.replace(lines=Lines.through(wrong)), same)
        assert scores["num_edges"] == 0 and np.isnan(scores["size"]).all() and np.isnan(scores["distance"])
    said = _cabinet.sentences(
        {
            "poses": {"before": {"center_rmse": 0.02}, "after": {"center_rmse": 0.01}},
            "cabinet": scores,
            "right_angles_deg": [],
        }
    )
    assert "20.0 mm -> 10.0 mm" in said[1] and "? x ? x ? m" in said[2]


@pytest.fixture
def few_images(tmp_path, monkeypatch):
    """The demo on twelve of its images: the same work in less time."""
    from groma.io import write_scene

    place, whole = tmp_path / "cabinet", _cabinet.folder()
    (place / "images").mkdir(parents=True)
    for scene in ("model", "motion_capture"):
        full = read_scene(whole / scene)
        rows = [row for row, name in enumerate(full.images.names) if int(name[:4]) in FEW]
        write_scene(full.subset(rows), place / scene, format="colmap")
    for number in FEW:
        shutil.copy(whole / "images" / f"{number:04d}.jpg", place / "images")
    monkeypatch.setattr(_cabinet, "folder", lambda: Path(place))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "groma_demo"


def test_demo_on_few_images(few_images, capsys):
    few_images.mkdir()
    (few_images / "scene.npz").write_bytes(b"of an earlier run")
    assert run(["demo", "-o", str(few_images)]) == 1  # a folder that is named is not replaced unasked
    assert "--force" in capsys.readouterr().err
    assert run(["demo"]) == 0
    said = capsys.readouterr().out
    assert f"Open {few_images / 'report.html'}" in said and "motion capture (rms)" in said
    assert {"report.html", "scene.npz", "lines.obj", "summary.json", "images.bin"} <= set(os.listdir(few_images))
    assert not few_images.with_name("groma_demo.work").exists()
    numbers = json.loads((few_images / "summary.json").read_text())
    scene = read_scene(few_images / "scene.npz")
    assert (numbers["num_images"], numbers["num_lines"]) == (len(FEW), scene.num_lines)
    assert scene.num_lines >= 10 and numbers["cabinet"]["num_edges"] >= 3
    (few_images / "notes.txt").write_text("of the user")
    assert run(["demo"]) == 1
    assert "notes.txt" in capsys.readouterr().err


@pytest.mark.slow
def test_demo(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(["demo", "--quiet"]) == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""
    numbers = json.loads((tmp_path / "groma_demo" / "summary.json").read_text())
    assert (numbers["num_images"], numbers["num_points"]) == (58, 1200)
    # Two lines or more for each of the twelve edges, whose sides are of different brightness.
    assert numbers["num_lines"] >= 24 and numbers["num_planes"] >= 1 and numbers["num_directions"] >= 1
    # Motion capture has errors of its own, 1 to 2 cm, so the gain that can be shown is limited.
    assert numbers["poses"]["after"]["center_rmse"] < 0.9 * numbers["poses"]["before"]["center_rmse"]
    assert numbers["cabinet"]["num_edges"] >= 11
    np.testing.assert_allclose(numbers["cabinet"]["size"], numbers["cabinet"]["size_measured"], atol=0.03)


@pytest.fixture
def two_factors(monkeypatch):
    """A registry of two factors, and all cameras; tests/factors/test_selfcheck.py checks every factor."""
    monkeypatch.setattr(
        contract, "_REGISTRY", {name: registered()[name] for name in ("position_prior", "point_on_plane")}
    )


def test_selfcheck(two_factors, capsys):
    assert run(["selfcheck", "--json", "-"]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert report["passed"] and len({row["factor"] for row in report["rows"]}) >= 15
    assert "0 failed" in said.err


@pytest.mark.shared
def test_selfcheck_against_reference_values(two_factors, shared_golden, capsys):
    assert run(["selfcheck", "--golden", str(shared_golden)]) == 0
    assert "golden" in capsys.readouterr().out
