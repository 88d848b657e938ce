# SPDX-License-Identifier: BSD-3-Clause
"""A track in the map of an earlier one: it finds itself there, stays in that world, and adds to the map."""

import json
from dataclasses import replace

import _room
import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from groma.cli.app import app
from groma.errors import InputError
from groma.geometry import se3
from groma.io import read_scene
from groma.io.trajectories import read_tum
from groma.tracking import Tracker, TrackOptions
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.map.saved_map import map_of_scene
from groma.tracking.result import map_to_scene
from groma.tracking.saved import read_saved_map

POSES = _room.poses(22)
FIRST, SECOND = slice(0, 12), slice(10, 22)
OPTIONS = TrackOptions(threaded=False)


@pytest.fixture(scope="module")
def halves():
    return [_room.frames("rgbd", POSES[part], seed=k) for k, part in enumerate((FIRST, SECOND))]


@pytest.fixture(scope="module")
def earlier(halves):
    """The scene of a track of the first half, and the frames of its images."""
    tracker = Tracker(_room.camera(), OPTIONS)
    for frame in halves[0]:
        tracker.process(frame)
    scene = tracker.finish().scene
    frames = {frame.name: frame for frame in halves[0]}
    return scene, {name: frames[name] for name in scene.images.names}


def _saved(earlier, options=OPTIONS):
    return map_of_scene(*earlier, TrackCamera.of(_room.camera()), options)


def _in_the_world_of_the_map(trajectory, truth):
    """Distances of camera centres from the truth; the world of the map is that of its first camera."""
    rows = np.round(trajectory.timestamps * 30).astype(int)
    true = se3.inverse(se3.compose(truth[rows], se3.inverse(np.tile(POSES[:1], (len(rows), 1)))))
    return np.linalg.norm(trajectory.world_from_cam[:, 4:] - true[:, 4:], axis=1)


def test_a_map_is_what_it_was(earlier):
    scene = earlier[0]
    again = map_to_scene(_saved(earlier), TrackCamera.of(_room.camera()))
    assert again.images.names == scene.images.names
    np.testing.assert_allclose(again.cam_from_world, scene.cam_from_world)
    np.testing.assert_allclose(again.points.xyz, scene.points.xyz)
    np.testing.assert_allclose(again.lines.plucker, scene.lines.plucker)
    np.testing.assert_allclose(again.planes.hesse, scene.planes.hesse)
    assert len(again.point_observations) == len(scene.point_observations)
    np.testing.assert_allclose(np.sort(again.point_depths.depth), np.sort(scene.point_depths.depth))
    np.testing.assert_allclose(again.line_depths.inverse_depth, scene.line_depths.inverse_depth)
    np.testing.assert_allclose(again.plane_observations.plane_in_cam, scene.plane_observations.plane_in_cam)
    np.testing.assert_array_equal(again.relations.line_on_plane, scene.relations.line_on_plane)


def test_a_track_goes_on_in_the_world_of_the_map(earlier, halves):
    tracker = Tracker(_room.camera(), OPTIONS, saved=_saved(earlier))
    frames = [tracker.process(frame) for frame in halves[1]]
    assert frames[0].status == "found" and {frame.status for frame in frames[1:]} == {"tracked"}
    result = tracker.finish()
    assert len(result.trajectory) == len(frames)
    # Time stamps of both halves begin at zero; none is mistaken for one of the map.
    assert _in_the_world_of_the_map(result.trajectory, POSES[SECOND]).max() < 0.01
    assert result.scene.num_images > earlier[0].num_images
    assert set(earlier[0].images.names) & set(result.scene.images.names)


def test_one_camera_gets_the_scale_of_the_map(earlier, halves):
    tracker = Tracker(_room.camera(), OPTIONS, saved=_saved(earlier))
    for frame in halves[1]:
        tracker.process(replace(frame, depth=None))
    result = tracker.finish()
    assert len(result.trajectory) == len(halves[1])
    assert _in_the_world_of_the_map(result.trajectory, POSES[SECOND]).max() < 0.02


def test_what_is_not_in_the_map_gets_a_world_of_its_own(earlier, halves):
    tracker = Tracker(_room.camera(), OPTIONS, saved=_saved(earlier))
    frames = [
        replace(frame, gray=frame.gray[:, ::-1].copy(), depth=frame.depth[:, ::-1].copy(), timestamp=0.2 * k)
        for k, frame in enumerate(halves[1])
    ]
    statuses = [tracker.process(frame).status for frame in frames]
    assert set(statuses[:3]) == {"lost"} and set(statuses[3:]) == {"tracked"}
    result = tracker.finish()
    assert not np.isnan(result.keyframes).any()
    assert not set(result.submaps)


def test_another_camera_is_refused(earlier):
    other = replace(TrackCamera.of(_room.camera()), fx=300.0)
    with pytest.raises(InputError, match="another camera"):
        map_of_scene(*earlier, other, OPTIONS)


@pytest.fixture(scope="module")
def folders(tmp_path_factory, halves):
    """Both halves in the layout of TUM RGB-D, the same names in both."""
    out = []
    for half in halves:
        folder = tmp_path_factory.mktemp("half")
        lists = {"rgb": [], "depth": []}
        for k, frame in enumerate(half):
            for kind, image in {"rgb": frame.gray, "depth": np.round(frame.depth * 5000).astype(np.uint16)}.items():
                (folder / kind).mkdir(exist_ok=True)
                cv2.imwrite(str(folder / kind / f"{k:04d}.png"), image)
                lists[kind].append(f"{frame.timestamp:.6f} {kind}/{k:04d}.png\n")
        for kind, rows in lists.items():
            (folder / f"{kind}.txt").write_text("".join(rows))
        out.append(folder)
    return out


def test_the_command(folders, tmp_path):
    camera = f"{_room.FOCAL} {_room.FOCAL} {_room.WIDTH / 2 - 0.5} {_room.HEIGHT / 2 - 0.5}"

    def run(*arguments):
        return CliRunner().invoke(app, ["track", *map(str, arguments), "--camera", camera])

    first, second, third = (tmp_path / name for name in ("first", "second", "third"))
    mask = tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.repeat(np.uint8([[0]] * 9 + [[255]] * (_room.HEIGHT - 9)), _room.WIDTH, axis=1))
    assert run(folders[0], "--masks", mask, "-o", first).exit_code == 0
    # Whoever tracks in its map reads the frames with the mask that it had.
    assert not any(f.used[:9].any() for source in read_saved_map(first).sources for f in source.read().values())
    result = run(folders[1], "--map", first, "-o", second)
    assert result.exit_code == 0, result.output
    told = json.loads((second / "summary.json").read_text())
    assert told["map"] == {"path": str(first), "keyframes": read_scene(first / "scene.npz").num_images, "joined": True,
                           "found_at": 0.0}  # fmt: skip
    assert [source["path"] for source in told["sources"]] == [str(folder) for folder in folders]
    assert _in_the_world_of_the_map(read_tum(second / "trajectory.txt"), POSES[SECOND]).max() < 0.01
    # Its output is a map again, with images of both sequences.
    again = run(folders[0], "--map", second, "-o", third)
    assert again.exit_code == 0, again.output
    assert json.loads((third / "summary.json").read_text())["frames"]["found"] == 1

    told["sources"][0]["images"] = dict.fromkeys(told["sources"][0]["images"], "rgb/nowhere.png")
    (second / "summary.json").write_text(json.dumps(told))
    for map_, words in (
        (second, "keyframes of the map are not in"),
        (tmp_path / "nothing", "does not exist"),
        (folders[0], "no map to track in"),
    ):
        refused = run(folders[1], "--map", map_, "-o", tmp_path / "refused")
        assert refused.exit_code == 1 and words in " ".join(refused.output.split())
        assert "Traceback" not in refused.output and not (tmp_path / "refused").exists()


def test_a_map_that_tells_no_frames_is_refused(tmp_path):
    (tmp_path / "summary.json").write_text('{"sources": [{"path": 3}]}')
    with pytest.raises(InputError, match="no map to track in"):
        read_saved_map(tmp_path)


def test_a_map_of_photographs_is_refused_in_words_of_its_own(tmp_path):
    (tmp_path / "summary.json").write_text('{"num_images": 2, "images": "/photographs"}')
    with pytest.raises(InputError, match=r"a map of photographs, made by groma map.* Place frames in it: groma loc"):
        read_saved_map(tmp_path)
