# SPDX-License-Identifier: BSD-3-Clause
"""Targets: measurements of other instruments, poses of photographs, rigs."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import test_survey_files
from _models import rig_scene
from _targets import Made, one
from _targets_tables import EUROC, G2O_3D, KITTI, TUM

from groma.adjustment.survey.attach import with_survey
from groma.adjustment.survey.given import Survey
from groma.geometry import quaternion, se3
from groma.io import write_archive, write_scene
from groma.io.colmap.rigs import by_frames, check_rigs, read_rigs
from groma.io.measured_poses import holds_covariances, read_camera_poses
from groma.io.survey import (
    read_control,
    read_directions,
    read_distances,
    read_exif_positions,
    read_known_planes,
    read_measured_poses,
    read_positions,
)  # fmt: skip
from groma.io.trajectories import read_times
from groma.scene import Scene, synthetic


def made(home: Path) -> Iterator[Made]:
    """Yield all targets of this module."""
    yield from _surveys()
    yield from _measured_poses()
    yield from _poses(home)
    yield from _rigs()


@functools.cache
def _scene() -> Scene:
    return synthetic.holistic(4, seed=1).truth.points_only()


@functools.cache
def _files() -> dict[str, bytes]:
    """Return files of measurements of the scene, by name."""
    scene = _scene()
    names, xyz = scene.images.names, scene.points.xyz
    centers = zip(names, scene.cam_centers_in_world, strict=True)
    listed = "\n".join(f"{name} {x:.4f} {y:.4f} {z:.4f} 0.1" for name, (x, y, z) in centers)
    down = -quaternion.to_matrix(scene.cam_from_world[:, :4])[:, :, 2]
    row = scene.point_observations
    marks = [
        f"{x:.3f} {y:.3f} {z:.3f} {u:.2f} {v:.2f} {names[image]} p{point}"
        for image, point, (u, v) in zip(row.image_idx, row.point_idx, row.pixel, strict=True)
        if point < 5 for x, y, z in [xyz[point]]
    ]  # fmt: skip
    texts = {
        "positions.csv": "name x y z sigma\n" + listed,
        "geo.txt": "EPSG:32633\n" + listed,
        "gcp_list.txt": "local\n" + "\n".join(marks),
        "gcp.json": json.dumps({"points": _ground_control(scene)}),
        "bars.csv": f"p0 p1 1.5 0.01\n{names[0]},{names[1]},2.0",
        "down.txt": "\n".join(f"{name} {x:.4f} {y:.4f} {z:.4f}" for name, (x, y, z) in zip(names, down, strict=True))
        + "\np0 vertical 2",
        "levels.txt": f"p0 z 1.5\n{names[0]} 0 0 1 -2 0.1",
        "poses.txt": "\n".join(
            f"{name} {x:.4f} {y:.4f} {z:.4f} {i:.6f} {j:.6f} {k:.6f} {w:.6f} 0.1 1"
            for name, (i, j, k, w, x, y, z) in zip(names, se3.inverse(scene.cam_from_world), strict=True)
        ),
    }
    return {name: text.encode() for name, text in texts.items()}


def _ground_control(scene: Scene) -> list[dict[str, object]]:
    """Return control points as OpenSfM lists them."""
    row, xyz = scene.point_observations, scene.points.xyz
    width, height = scene.cameras.width[0], scene.cameras.height[0]
    points: list[dict[str, object]] = []
    for point in range(5):
        rows = np.flatnonzero(row.point_idx == point)
        shots = [scene.images.names[image] for image in row.image_idx[rows]]
        places = ((row.pixel[rows] - [width / 2, height / 2]) / max(width, height)).tolist()
        x, y, z = xyz[point]
        at = {"latitude": 52.5 + y / 111_270, "longitude": 13.4 + x / 67_880, "altitude": z}
        seen = [{"shot_id": shot, "projection": place} for shot, place in zip(shots, places, strict=True)]
        points.append({"id": str(point), "position": at, "observations": seen})
    return points


def _attached(folder: Path, hold: tuple[str, ...] = (), **files: str) -> Scene:
    """Read files and attach what they hold to the scene."""
    given = {kind: _SURVEYS[kind](folder / name) for kind, name in files.items()}
    survey = Survey(
        **given, position_sigma=(1.0,), control_sigma=(1.0,), distance_sigma=1.0, plane_sigma=0.1,
        direction_sigma_deg=1.0, pose_sigma=(0.1, 1.0), hold=hold,
    )  # fmt: skip
    return with_survey(_scene(), survey).scene


def surveyed(folder: Path) -> Scene:
    """Return the scene with measurements of every kind, by way of files in a folder."""
    for name, content in _files().items():
        (folder / name).write_bytes(content)
    everything = {"control": "gcp_list.txt", "distances": "bars.csv", "directions": "down.txt"}
    everything |= {"planes": "levels.txt", "poses": "poses.txt", "positions": "positions.csv"}
    scene = _attached(folder, ("p1", "point:7"), **everything)
    for name in _files():
        (folder / name).unlink()
    return scene


def _surveys() -> Iterator[Made]:
    """Yield files of measurements, attached to a scene where they can be read."""
    kinds = {
        "positions": {"positions": "positions.csv"},
        "geo": {"positions": "geo.txt"},
        "control": {"control": "gcp_list.txt", "distances": "bars.csv"},
        "ground control": {"control": "gcp.json"},
        "directions": {"control": "gcp_list.txt", "directions": "down.txt"},
        "planes": {"control": "gcp_list.txt", "planes": "levels.txt"},
        "poses": {"control": "gcp_list.txt", "poses": "poses.txt"},
    }
    for kind, files in kinds.items():
        yield kind, {name: _files()[name] for name in files.values()}, functools.partial(_attached, **files)
    photo = test_survey_files.jpeg_with_position("<", 52.5, 13.4, 99.0)
    yield "exif", {"a.jpg": photo}, lambda folder: read_exif_positions(folder, ["a.jpg"])


_SURVEYS = {
    "positions": read_positions, "control": read_control, "distances": read_distances, "directions": read_directions,
    "planes": read_known_planes, "poses": read_measured_poses,
}  # fmt: skip


def _measured_poses() -> Iterator[Made]:
    """Yield poses by name with a covariance in each of its forms."""
    rows = {
        "sigmas": "0.1 1",
        "upper": " ".join("1" if j == i else "0.1" for i in range(6) for j in range(i, 6)),
        "full": " ".join("1" if j == i else "0.1" for i in range(6) for j in range(6)),
    }
    for form, noise in rows.items():
        text = "\n".join(f"{row}.png {row} {row % 2} 0 0 0.6 0 0.8 {noise}" for row in range(4))
        yield f"poses_{form}", {"poses.txt": b"name x y z qx qy qz qw\n" + text.encode()}, _read_measured


def _read_measured(folder: Path) -> object:
    return holds_covariances(folder / "poses.txt"), read_measured_poses(folder / "poses.txt")


def _poses(home: Path) -> Iterator[Made]:
    """Yield every kind of file that poses of photographs are taken from."""
    work = home / "work"
    work.mkdir()
    scene = synthetic.holistic(4, seed=1).start.points_only()
    write_scene(scene, work / "transforms.json")
    write_archive(rig_scene(), work / "scene.npz")
    photographs = [f"{row}.png" for row in range(6)]
    seconds = [name.replace(".png", ".500.png") for name in photographs]
    nanoseconds = [f"140363657976{row}000000.png" for row in range(6)]
    bare = "\n".join(f"{row}.png {row} 0 0 0 0 0 1" for row in range(6)).encode()
    kinds = {
        "tum": (TUM, "a.txt", seconds),
        "kitti": (KITTI, "a.txt", photographs),
        "euroc": (EUROC, "a.csv", nanoseconds),
        "g2o": (G2O_3D, "a.g2o", photographs[:2]),
        "names": (bare, "a.txt", photographs),
        "transforms": ((work / "transforms.json").read_bytes(), "transforms.json", list(scene.images.names)),
        "archive": ((work / "scene.npz").read_bytes(), "scene.npz", ["a/1.png", "mono_é.png"]),
    }
    for kind, (content, file, names) in kinds.items():
        read = functools.partial(read_camera_poses, images=names)
        yield f"poses_{kind}", {file: content}, one(read, file)
    yield "times", {"times.txt": b"0\n0.1\n0.2\n"}, one(read_times, "times.txt")
    shutil.rmtree(work)


def _rigs() -> Iterator[Made]:
    right = {
        "image_prefix": "right/", "cam_from_rig_rotation": [0.0, 0.0, 1.0, 0.0],
        "cam_from_rig_translation": [0.0, 0.1, -0.2], "camera_model_name": "SIMPLE_PINHOLE",
        "camera_params": [500.0, 320.0, 240.0],
    }  # fmt: skip
    document = [{"cameras": [{"image_prefix": "left/", "ref_sensor": True}, right]}]
    yield "rigs", {"rig_config.json": json.dumps(document, indent=1).encode()}, _read_rigs


def _read_rigs(folder: Path) -> object:
    rigs, names = read_rigs(folder / "rig_config.json"), ["left/1.png", "right/1.png", "left/2.png", "right/2.png"]
    return by_frames(rigs, names), check_rigs(rigs, names)
