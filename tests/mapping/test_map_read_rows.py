# SPDX-License-Identifier: BSD-3-Clause
"""Photographs rendered row by row while the camera moves: mapped with their motions, and without."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from _facade import FOCAL, HEIGHT, WALLS, WIDTH, facade

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.rolling_shutter import NOT_ROLLING, with_rolling_shutter
from groma.cameras import model
from groma.cli.main import run
from groma.errors import InputError
from groma.evaluation import evaluate_poses
from groma.features.segments import Segments
from groma.geometry import quaternion
from groma.io import read_scene
from groma.mapping.map import MapResult, map_images
from groma.mapping.options import MapOptions
from groma.mapping.read_rows import as_measured, mapped_as_measured, read_by_rows, taken_at_once

COUNT = 5


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    """Photographs of a house corner, the truth, and the motions."""
    folder = tmp_path_factory.mktemp("rows") / "images"
    rng = np.random.default_rng(3)
    motions = np.hstack([rng.normal(0.0, 0.04, (COUNT, 3)), rng.normal(0.0, np.radians(1.0), (COUNT, 3))])
    return folder, facade(folder, COUNT, motions=motions), motions


def off_walls(scene):
    """Distances of the ends of lines from the nearest wall."""
    ends = scene.lines.segments
    normals = [np.cross(wall[1], wall[2]) / np.linalg.norm(np.cross(wall[1], wall[2])) for wall in WALLS]
    away = [np.abs((ends - wall[0]) @ normal).max(axis=1) for wall, normal in zip(WALLS, normals, strict=True)]
    return np.min(away, axis=0)


def test_photographs_alone_tell_poses_and_motions(rendered, tmp_path, monkeypatch, capsys):
    folder, truth, motions = rendered
    monkeypatch.chdir(tmp_path)
    known = ["--camera-model", "SIMPLE_PINHOLE", "--camera-params", f"{FOCAL},{WIDTH / 2},{HEIGHT / 2}", "--no-planes"]
    assert run(["map", str(folder), "-o", "out", "--rolling-shutter", "rows", "--no-diagnosis", *known]) == 0
    said = capsys.readouterr()
    assert f"Rolling shutter of {COUNT} images" in said.out and "read along nearly the same direction" in said.err
    found = read_scene(tmp_path / "out" / "scene.npz")
    assert evaluate_poses(found, truth).center_rmse < 0.01  # 0.1 and more without --rolling-shutter
    assert found.num_lines > 80
    numbers = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert numbers["inliers"]["lines"]["rmse_px"]["after"] < 0.2
    shown = np.degrees(np.linalg.norm(motions[:, 3:], axis=1))
    assert numbers["rolling_shutter"]["turn_deg"]["median"] == pytest.approx(np.median(shown), rel=0.3)
    # What is written is what was measured, not what would have been seen at once.
    assert len(found.camera_motions) == COUNT and found.camera_motions.motion.any()


def test_a_map_of_known_points_lies_on_the_walls(rendered, tmp_path):
    folder, truth, _ = rendered
    told = MapOptions(threads=1, find_planes=False)
    still = map_images(folder, tmp_path / "still", truth, told)
    found = map_images(folder, tmp_path / "rows", with_rolling_shutter(truth), told)  # the scene says it
    away, without = off_walls(found.scene), off_walls(still.scene)
    assert np.median(away) < 0.5 * np.median(without)
    # Lines of a map without motions may fit each other; on the walls they are not.
    near = np.median(away)
    assert len(away) > len(without) and (away <= near).sum() > 2 * (without <= near).sum()
    # Words and numbers are of one problem.
    assert all(sentence in found.explanation for sentence in found.motions().sentences())
    assert set(found.motions().warnings()) <= set(found.warnings)


def test_what_was_measured_comes_back(rendered):
    _, truth, motions = rendered
    scene = with_rolling_shutter(truth)
    scene = scene.replace(camera_motions=scene.camera_motions.replace(motion=motions))
    rng = np.random.default_rng(0)
    places = rng.uniform([0, 0, 0, 0], [WIDTH, HEIGHT, WIDTH, HEIGHT], (COUNT, 20, 4))
    segments = [Segments(ends, np.full(20, 0.3), np.ones(20)) for ends in places]
    once = taken_at_once(scene, segments)
    # Points are then seen where a camera at rest sees them.
    table, params = once.scene.point_observations, scene.cameras.params[0]
    poses = scene.cam_from_world[table.image_idx]
    inside = quaternion.rotate(poses[:, :4], scene.points.xyz[table.point_idx]) + poses[:, 4:]
    away = table.pixel - model("SIMPLE_PINHOLE").project(params, inside)
    before = truth.point_observations.pixel - model("SIMPLE_PINHOLE").project(params, inside)
    assert np.sqrt(np.mean(away**2)) < 0.25 < 1.0 < np.sqrt(np.mean(before**2))
    assert len(once.scene.camera_motions) == 0
    back = as_measured(once.scene, once)
    np.testing.assert_array_equal(back.point_observations.pixel, truth.point_observations.pixel)
    np.testing.assert_array_equal(back.camera_motions.motion, motions)
    assert not np.allclose(once.segments[0].ends, segments[0].ends)
    still = taken_at_once(truth, segments)
    assert still.scene is truth and still.segments[0] is segments[0]


def test_motions_that_were_left_out_are_told_where_they_were_asked_for(rendered):
    _, truth, _ = rendered
    still = taken_at_once(truth, [])
    asked = SimpleNamespace(options=MapOptions(rolling_shutter="rows"))
    adjusted = adjust(truth, AdjustOptions(max_iterations=0))
    plain = MapResult(truth, truth, truth, truth, adjusted.report, AdjustOptions(), {}, "", {}, ())
    assert mapped_as_measured(plain, still, asked).warnings == (NOT_ROLLING,)
    assert mapped_as_measured(plain, still, SimpleNamespace(options=MapOptions())) is plain


def test_what_images_cannot_do_is_refused(rendered, tmp_path):
    folder, truth, _ = rendered
    for options, said in (
        (MapOptions(rolling_shutter="up"), "rows or columns; got 'up'"),
        (MapOptions(rolling_shutter="rows", refine_points=True), "Points cannot be measured again"),
        (MapOptions(rolling_shutter="rows", matcher="flow"), "nor segments matched"),
    ):
        with pytest.raises(InputError, match=said):
            map_images(folder, tmp_path / "work", truth, options)
    with pytest.raises(InputError, match="Depths do not support a rolling shutter"):
        read_by_rows(truth, MapOptions(rolling_shutter="rows"), depth=object())
