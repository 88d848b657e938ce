# SPDX-License-Identifier: BSD-3-Clause
"""Commands with known directions and planes, poses with covariance, and held objects."""

import json

import numpy as np
import pytest
from _survey import ELSEWHERE, made

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.cli.main import run
from groma.geometry import quaternion, se3
from groma.io import read_scene, write_scene


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A scene in another frame, and files of what was measured of its truth; one direction is wrong."""
    truth, start = made()
    place, rng = tmp_path_factory.mktemp("measured"), np.random.default_rng(5)
    near = adjust(start, AdjustOptions(loss="none")).scene
    write_scene(near.transformed(ELSEWHERE), place / "scene.npz")
    write_scene(truth, place / "truth.npz")
    names, down = truth.images.names, np.tile([0.0, 0.0, -1.0], (8, 1))
    seen = quaternion.rotate(truth.cam_from_world[:, :4], down) + rng.normal(size=(8, 3)) * 0.005
    seen[3] += [0.2, 0.0, 0.0]
    rows = [f"{name} {x:.6f} {y:.6f} {z:.6f}" for name, (x, y, z) in zip(names, seen, strict=True)]
    (place / "imu.txt").write_text("\n".join(rows))
    heights = truth.cam_centers_in_world[:, 2] + rng.normal(size=8) * 0.01
    rows = [f"{name} z {height:.4f} 0.01" for name, height in zip(names, heights, strict=True)]
    (place / "levels.txt").write_text("\n".join(rows))
    world = se3.inverse(truth.cam_from_world)
    world[:, 4:] += rng.normal(size=(8, 3)) * 0.02
    rows = [f"{n} " + " ".join(f"{v:.6f}" for v in (*w[4:], *w[:4])) for n, w in zip(names, world, strict=True)]
    (place / "poses.txt").write_text("\n".join(rows))
    return place


def test_gravity_and_heights(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = f"adjust {folder}/scene.npz -o out.npz --directions {folder}/imu.txt --direction-sigma 0.3"
    words += f" --known-planes {folder}/levels.txt --protocol adjustment.txt --json out.json --report out.html"
    assert run(words.split()) == 0
    said = capsys.readouterr()
    assert "turned by" in said.out and "Taken out: known direction 00004.png" in said.err and " degrees (" in said.err
    scene, truth = read_scene("out.npz"), read_scene(folder / "truth.npz")
    off = scene.cam_centers_in_world[:, 2] - truth.cam_centers_in_world[:, 2]
    assert np.sqrt((off**2).mean()) < 0.02  # the heights scale it, too
    text = (tmp_path / "adjustment.txt").read_text()
    for title in ("Turn from known directions", "Distances from known planes", "known directions", "<- taken out"):
        assert title in text
    told = json.loads((tmp_path / "out.json").read_text())["survey"]
    assert set(told["variance_components"]) == {"known plane", "known direction"}
    # the archive holds them: adjusted again, nothing changes
    assert run(["adjust", "out.npz", "-o", "again.npz"]) == 0
    np.testing.assert_allclose(read_scene("again.npz").cam_centers_in_world, scene.cam_centers_in_world, atol=1e-3)


def test_poses_and_what_is_held(folder, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = f"adjust {folder}/scene.npz -o out.npz --poses {folder}/poses.txt --pose-sigma 0.02,0.3"
    assert run([*words.split(), "--protocol", "adjustment.txt"]) == 0
    assert "brought into" in capsys.readouterr().out
    scene, truth = read_scene("out.npz"), read_scene(folder / "truth.npz")
    assert np.sqrt(((scene.cam_centers_in_world - truth.cam_centers_in_world) ** 2).mean()) < 0.02
    assert "Poses of cameras" in (tmp_path / "adjustment.txt").read_text()
    words = "adjust out.npz -o held.npz --hold 00002.png,*7.png --protocol held.txt"
    assert run(words.split()) == 0
    after = read_scene("held.npz")
    assert np.array_equal(after.frames.rig_from_world[[1, 6]], scene.frames.rig_from_world[[1, 6]])
    assert "00002.png, 00007.png" in (tmp_path / "held.txt").read_text()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("--directions {folder}/imu.txt", "--direction-sigma 1 (degrees)"),
        ("--direction-sigma 1", "--direction-sigma belongs to --directions"),
        ("--directions {folder}/imu.txt --direction-sigma -1", "--direction-sigma must be a positive number; got -1"),
        ("--known-planes {folder}/imu.txt", "expected name nx ny nz w sigma"),
        ("--poses {folder}/poses.txt", "--pose-sigma 0.05,0.5"),
        ("--poses {folder}/poses.txt --pose-sigma 1", "must be two positive numbers"),
        ("--hold 99.png", "neither a control point nor an image"),
        ("--hold line:4", "there is no line 4 in the scene"),
        ("--hold ,", "--hold must be names with commas between them"),
    ],
)
def test_what_does_not_fit_is_one_line(folder, tmp_path, capsys, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    assert run(["adjust", f"{folder}/scene.npz", *options.format(folder=folder).split()]) == 1
    error = capsys.readouterr().err.strip().splitlines()
    assert words in error[-1] and len(error) == 1
