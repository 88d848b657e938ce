# SPDX-License-Identifier: BSD-3-Clause
"""Commands with measurements of other instruments: what they write and say, and the one line of what does not fit."""

import json

import cv2
import numpy as np
import pytest
from _survey import ELSEWHERE, SIGMA, control, made, positions

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.survey.attach import Survey
from groma.cli.main import run
from groma.io import read_scene, write_scene
from groma.io.survey import CoordinateSystem, Places
from groma.mapping import map as mapping
from groma.mapping.map import MapResult, map_images
from groma.mapping.options import MapOptions
from groma.scene.local_frame import usual_frame

UTM = np.array([4e5, 5.4e6, 200.0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene in another frame, positions and control points in UTM: one position is wrong, two points check."""
    truth, _ = made()
    place, rng = tmp_path_factory.mktemp("survey"), np.random.default_rng(5)
    write_scene(truth.transformed(ELSEWHERE), place / "scene.npz")
    write_scene(truth, place / "truth.npz")
    xyz = positions(truth, rng).xyz + UTM
    xyz[2, 1] += 1.0
    rows = [f"{name} {x:.4f} {y:.4f} {z:.4f} {SIGMA}" for name, (x, y, z) in zip(truth.images.names, xyz, strict=True)]
    (place / "positions.txt").write_text("\n".join(rows))
    points, marks, _ = control(truth, rng)
    rows = ["EPSG:32633"]
    for image, point, (u, v) in zip(marks.image_idx, marks.point_idx, marks.pixel, strict=True):
        x, y, z = points.measured[point] + UTM
        rows.append(
            f"{x:.4f} {y:.4f} {z:.4f} {u - 0.5:.3f} {v - 0.5:.3f} {truth.images.names[image]} {points.names[point]}"
        )
    (place / "gcp_list.txt").write_text("\n".join(rows))
    (place / "bars.csv").write_text(f"p0,p1,{np.linalg.norm(points.measured[1] - points.measured[0]):.4f},0.02\n")
    return place


def test_adjust_with_everything(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    geo = (folder / "positions.txt").read_text()
    (tmp_path / "geo.txt").write_text(
        "EPSG:32633\n" + "\n".join(" ".join([*row.split()[:4], "0.02"]) for row in geo.splitlines())
    )
    words = (
        f"adjust {folder}/scene.npz -o out.npz --positions geo.txt --control {folder}/gcp_list.txt --control-sigma 0.02"
    )
    words += f" --check p4,p5 --mark-sigma 0.5 --distances {folder}/bars.csv --protocol adjustment.txt"
    words += " --json out.json --report out.html"
    assert run(words.split()) == 0
    said = capsys.readouterr()
    assert "brought into UTM zone 33 north (EPSG:32633)" in said.out and "Check point p4: off by" in said.out
    assert (
        "Taken out: camera position 00003.png y disagrees with photographs and other measurements by 0.98" in said.err
    )
    scene, truth = read_scene("out.npz"), read_scene(folder / "truth.npz")
    off = scene.cam_centers_in_world - truth.cam_centers_in_world - UTM
    assert np.sqrt((off**2).mean()) < 0.8 * SIGMA
    assert {"camera positions", "control points", "marks", "distances"} <= scene.num_measurements.keys()
    told = json.loads((tmp_path / "out.json").read_text())["survey"]
    assert told["suspects"][0] == "camera position 00003.png y" and told["frame"]["system"] == "EPSG:32633"
    assert len(told["check_points"]) == 2 and set(told["variance_components"]) == {
        "camera position",
        "control point",
        "mark",
        "distance",
    }
    text = (tmp_path / "adjustment.txt").read_text()
    for words in ("Variance components", "Test for gross errors", "Distances", "Check points", "<- taken out", "MDE"):
        assert words in text
    page = (tmp_path / "out.html").read_text()
    assert "Residuals of measurements" in page and "Check points" in page
    # the archive holds the measurements: adjusted again, nothing changes
    assert run(["adjust", "out.npz", "-o", "again.npz"]) == 0
    assert "camera positions" in capsys.readouterr().out
    np.testing.assert_allclose(read_scene("again.npz").cam_centers_in_world, scene.cam_centers_in_world, atol=1e-3)


def test_accuracies_that_are_too_good_are_told(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rows = [line.split()[:4] for line in (folder / "positions.txt").read_text().splitlines()]
    (tmp_path / "good.txt").write_text("\n".join(" ".join([*row, "0.001"]) for row in rows))
    assert run(["adjust", f"{folder}/scene.npz", "-o", "out.npz", "--positions", "good.txt", "--json", "r.json"]) == 0
    told = json.loads((tmp_path / "r.json").read_text())["survey"]
    assert told["variance_components"]["camera position"] > 4.0
    error = capsys.readouterr().err
    assert "camera positions are" in error and "times as large" in error and "Suspect" not in error


def test_suspects_may_be_kept(folder, tmp_path, capsys, monkeypatch):
    """What the test would take out goes on weighing, in a first adjustment and in a later one."""
    monkeypatch.chdir(tmp_path)
    words = f"adjust {folder}/scene.npz --positions {folder}/positions.txt"
    assert run([*words.split(), "-o", "out.npz"]) == 0
    assert "keep it with --keep-suspects" in capsys.readouterr().err
    assert run([*words.split(), "-o", "kept.npz", "--keep-suspects"]) == 0
    said = capsys.readouterr().err
    assert "Suspect: camera position 00003.png y disagrees" in said and "Taken out" not in said
    assert run(["adjust", "out.npz", "-o", "later.npz", "--keep-suspects"]) == 0
    rejected = [read_scene(name).camera_positions.rejected.sum() for name in ("out.npz", "kept.npz", "later.npz")]
    assert rejected == [1, 0, 0]
    assert run(["adjust", f"{folder}/scene.npz", "--keep-suspects"]) == 1
    assert "--keep-suspects is of measurements; there are none" in capsys.readouterr().err


def test_align(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    truth = read_scene(folder / "truth.npz")
    assert run(["align", f"{folder}/scene.npz", f"{folder}/truth.npz", "-o", "out.npz"]) == 0
    assert "8 of 8 places used" in capsys.readouterr().out
    np.testing.assert_allclose(read_scene("out.npz").points.xyz, truth.points.xyz, atol=1e-9)
    words = f"align {folder}/scene.npz --control {folder}/gcp_list.txt -o ground.npz --json out.json"
    assert run(words.split()) == 0
    off = read_scene("ground.npz").cam_centers_in_world - truth.cam_centers_in_world - UTM
    assert np.abs(off).max() < 0.5
    assert json.loads((tmp_path / "out.json").read_text())["num_used"] == 6
    assert run(["align", f"{folder}/scene.npz"]) == 1
    assert "either a REFERENCE scene" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--positions missing.txt", "Cannot read missing.txt"),
        ("--position-sigma 1", "--position-sigma belongs to --positions"),
        ("--check p1", "--check belongs to --control"),
        ("--positions exif", "needs the folder"),
        ("--positions {folder}/positions.txt --position-sigma a", "one to three positive numbers"),
        ("--positions {folder}/positions.txt --crs utm", "does not say its coordinate"),
        ("--control {folder}/gcp_list.txt", "--control-sigma 0.02"),
        ("--control {folder}/positions.txt", "line 1: expected a coordinate system"),
        ("--distances {folder}/bars.csv", "'p0' is neither a control point nor an image"),
        ("--protocol out.txt", "--protocol is of measurements"),
    ],
)
def test_what_does_not_fit_is_one_line(folder, tmp_path, capsys, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    assert run(["adjust", f"{folder}/scene.npz", *options.format(folder=folder).split()]) == 1
    error = capsys.readouterr().err.strip().splitlines()
    assert words in error[-1] and len(error) == 1


@pytest.mark.parametrize(
    ("options", "scale", "words"),
    [
        ("--control {folder}/gcp_list.txt", 1, "--control-sigma 0.02"),
        ("--control {folder}/gcp_list.txt --control-sigma 0.02", 2, "marks lie outside their images"),
        ("--control {folder}/gcp_list.txt --control-sigma 0.02 --check q1", 1, "no control point"),
        ("--positions {folder}/positions.txt --position-sigma 1 --crs utm", 1, "does not say its coordinate"),
    ],
)
def test_what_does_not_fit_the_photographs_is_refused_before_cameras_are_placed(
    folder, tmp_path, capsys, monkeypatch, options, scale, words
):
    def never(*_):
        raise AssertionError("cameras were placed")

    monkeypatch.setattr(mapping, "start_of", never)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "images").mkdir()
    for number, name in enumerate(made()[0].images.names):
        cv2.imwrite(str(tmp_path / "images" / name), np.full((768 // scale, 1024 // scale), number, np.uint8))
    assert run(["map", "images", "-o", "out", *options.format(folder=folder).split()]) == 1
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("kept", [False, True])
def test_a_map_is_in_the_frame_of_its_measurements(tmp_path, monkeypatch, kept):
    """What is between the points and the end is looked at without photographs. One position is wrong."""
    truth, start = made()
    near = adjust(start, AdjustOptions(loss="none"))
    rng, seen = np.random.default_rng(5), []
    xyz = positions(truth, rng).xyz + UTM
    xyz[2, 1] += 1.0
    given = Places(truth.images.names, xyz, np.full(xyz.shape, SIGMA), CoordinateSystem(), "positions.csv")

    def mapped(points, *others):
        seen.append(points)
        return MapResult(points, points, points, points, near.report, AdjustOptions(point_sigma_px=0.5), {}, "", {}, ())

    monkeypatch.setattr(mapping, "map_segments", mapped)
    for name in truth.images.names:
        cv2.imwrite(str(tmp_path / name), np.zeros((768, 1024), np.uint8))
    options = MapOptions(keep_suspects=kept)
    found = map_images(tmp_path, tmp_path / "work", start.transformed(ELSEWHERE), options, survey=Survey(given))
    assert usual_frame(seen[0]) is None and len(seen[0].camera_positions) == 8
    assert seen[0].camera_positions.rejected.sum() == (0 if kept else 1)
    off = found.scene.cam_centers_in_world - truth.cam_centers_in_world - UTM
    assert np.abs(off).max() < 3 * SIGMA and np.abs(found.start.cam_centers_in_world[0] - UTM).max() < 100
    np.testing.assert_allclose(found.scene.camera_positions.xyz, xyz, atol=1e-6)
    told = found.summary()["survey"]
    assert len(told["measurements"]) == 24 and told["frame"]["description"].startswith("the coordinates of the file")
    found.write(tmp_path / "out")
    assert "Positions of cameras" in (tmp_path / "out" / "adjustment.txt").read_text()
