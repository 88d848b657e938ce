# SPDX-License-Identifier: BSD-3-Clause
"""BAL files: known costs at the start, round trips, what the format cannot hold, damaged and oversized files."""

import bz2
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from _comparison import near
from _models import rig_scene

from groma.errors import FileFormatError, InputError
from groma.geometry import quaternion
from groma.io import (
    read_archive,
    read_bal,
    read_colmap,
    read_scene,
    write_archive,
    write_bal,
    write_colmap,
    write_scene,
)
from groma.scene import Scene

BAL = Path(__file__).parents[1] / "data" / "bal"


def _pycolmap_came_first() -> bool:
    loaded = list(sys.modules)
    return "pycolmap" in loaded and loaded.index("pycolmap") < loaded.index("zlib")


def bal_cost(scene: Scene) -> float:
    """Half the sum of squared residuals by the BAL model, written out independently of the cameras."""
    seen = scene.point_observations
    pose = scene.cam_from_world[seen.image_idx]
    in_cam = quaternion.rotate(pose[:, :4], scene.points.xyz[seen.point_idx]) + pose[:, 4:]
    ray = in_cam[:, :2] / in_cam[:, 2:]
    square = (ray**2).sum(1)
    focal, k1, k2 = scene.cameras.params[scene.images.camera_idx[seen.image_idx]].T
    residual = (focal * (1 + k1 * square + k2 * square**2))[:, None] * ray - seen.pixel
    return 0.5 * float((residual**2).sum())


def test_bal_cameras_go_to_colmap_and_back(tmp_path):
    scene = read_bal(BAL / "dubrovnik-3-7-pre.txt")
    write_colmap(scene, tmp_path / "model")
    assert set(read_colmap(tmp_path / "model").cameras.models) == {"RADIAL"}
    write_bal(read_colmap(tmp_path / "model"), tmp_path / "back.txt")
    back = read_bal(tmp_path / "back.txt")
    assert bal_cost(back) == pytest.approx(bal_cost(scene), rel=1e-12)
    np.testing.assert_allclose(back.cameras.params, scene.cameras.params, rtol=1e-13)


@pytest.mark.parametrize(("name", "cost", "size"), [("pre", 2.764220e03, 19), ("18-pre", 2.753174e03, 18)])
def test_bal_start_cost(name, cost, size):
    # The costs were computed from the files by an independent program; seven digits are given.
    scene = read_bal(BAL / f"dubrovnik-3-7-{name}.txt")
    assert (scene.num_images, scene.num_points, scene.num_observations) == (3, 7, size)
    assert bal_cost(scene) == pytest.approx(cost, rel=2e-7)


@pytest.mark.parametrize("suffix", [".txt", ".bz2", ".gz"])
def test_bal_round_trip(tmp_path, suffix):
    scene = read_bal(BAL / "dubrovnik-3-7-pre.txt")
    path = tmp_path / f"problem{suffix}"
    if suffix == ".gz" and _pycolmap_came_first():
        pytest.skip("pycolmap was imported before zlib in this process")
    write_scene(scene, path)
    result = near(scene, read_scene(path), 1e-13)
    assert result, result.reason
    head = {".txt": b"3 7 19", ".bz2": b"BZh", ".gz": b"\x1f\x8b"}[suffix]
    assert path.read_bytes().startswith(head)


def test_bal_refuses_what_it_cannot_hold(tmp_path):
    with pytest.raises(InputError, match="points only"):
        write_bal(rig_scene(), tmp_path / "a.txt")
    with pytest.raises(InputError, match="one focal length"):
        write_bal(rig_scene().points_only(), tmp_path / "a.txt")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "three counts"),
        ("1 1", "three counts"),
        ("1 1 99999999999999 0", "promises"),
        ("1 1 1 0 0 1 2 " + "0 " * 11, "should hold 16 numbers"),
        ("1 1 1 0 5 1 2 " + "0 " * 12, "names point 5"),
        ("1 1 1 0.5 0 1 2 " + "0 " * 12, "names camera 0.5"),
        ("1 1 1 0 0 nan 2 " + "0 " * 12, "not finite"),
        ("1 1 1 0 0 1e999 2 " + "0 " * 12, "not finite"),
        ("1 1 1 0 0 1 2 x" + " 0" * 12, "BAL file"),
        ("-1 1 1 0 0 1 2", "three counts"),
    ],
)
def test_bal_messages(tmp_path, text, message):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=message):
        read_bal(path)


def test_bombs_are_refused(tmp_path):
    (tmp_path / "bomb.bz2").write_bytes(bz2.compress(b"1 1 1" + b" " * 34_000_000))
    with pytest.raises(FileFormatError, match="grows beyond"):
        read_scene(tmp_path / "bomb.bz2")
    write_archive(rig_scene(), tmp_path / "good.npz")
    with zipfile.ZipFile(tmp_path / "good.npz") as good, zipfile.ZipFile(tmp_path / "bomb.npz", "w") as bomb:
        for info in good.infolist():
            content = good.read(info)
            if info.filename == "points.xyz.npy":
                rows = 1_450_000
                content = content[:128].replace(b"(3, 3), }", b"(%d, 3), }" % rows)[:127] + b"\n" + bytes(24 * rows)
            bomb.writestr(info.filename, content)
    packed = tmp_path / "packed.npz"
    # The zip is made with bzip2, whose ratio has no small bound.
    with zipfile.ZipFile(tmp_path / "bomb.npz") as plain, zipfile.ZipFile(packed, "w", zipfile.ZIP_BZIP2) as out:
        for info in plain.infolist():
            out.writestr(info.filename, plain.read(info))
    with pytest.raises(FileFormatError, match="would unpack"):
        read_archive(packed)


@pytest.mark.shared
@pytest.mark.parametrize(
    ("name", "cost"), [("49-7776", 8.509125e05), ("21-11315", 4.413239e06), ("16-22106", 4.185660e06)]
)
def test_known_start_costs(shared_data, name, cost):
    scene = read_scene(shared_data / "bal" / f"problem-{name}-pre.txt.bz2")
    assert bal_cost(scene) == pytest.approx(cost, rel=2e-7)
