# SPDX-License-Identifier: BSD-3-Clause
"""Targets: what belongs to images. Sequences, photographs, depth maps, silhouettes, networks."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from _targets import GRAY, Made, encoded, npy, npz
from _targets_tables import EUROC, KITTI, TUM

from groma.evaluation.silhouettes import read_silhouettes
from groma.io.depth_maps import DepthMaps
from groma.io.sequences import open_sequence
from groma.mapping.photographs import read_gray
from groma.viz.pictures import read_picture


def made(home: Path) -> Iterator[Made]:
    """Yield all targets of this module."""
    yield from _sequences()
    yield from _images()
    yield from _depth_maps()


CAMERA = b"525 525 15.5 11.5\n"
YAML = b"""%%YAML:1.0
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [1, 0, 0, %s,
         0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
rate_hz: 20
resolution: [32, 24]
camera_model: pinhole
intrinsics: [30, 30, 16, 12] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.1, 0.01, 0.0, 0.0]
"""


def _frames(folder: Path) -> object:
    sequence = open_sequence(folder)
    return [frame.gray.shape for frame in sequence]


def _sequences() -> Iterator[Made]:
    png, depth = encoded(".png"), encoded(".png", np.full((24, 32), 5000, np.uint16))
    times = [b"%d.25" % row for row in range(3)]
    tum = {
        f"{name}.txt": b"# list\n" + b"".join(b"%s %s/%s.png\n" % (t, name.encode(), t) for t in times)
        for name in ("rgb", "depth")
    }
    tum |= {"groundtruth.txt": TUM, "camera.txt": CAMERA}
    tum |= {f"{name}/{t.decode()}.png": data for name, data in (("rgb", png), ("depth", depth)) for t in times}
    yield "tum_rgbd", tum, _frames
    joined = b"".join(b"%s rgb/%s.png %s depth/%s.png\n" % (t, t, t, t) for t in times)
    yield "tum_associations", tum | {"associations.txt": joined}, _frames
    calib = b"".join(b"P%d: 30 0 16 %d 0 30 12 0 0 0 1 0\n" % (k, -15 * k) for k in range(4))
    kitti = {f"image_{k}/{row:06d}.png": png for k in (0, 1) for row in range(3)}
    yield (
        "kitti",
        kitti | {"calib.txt": calib, "times.txt": b"0\n0.1\n0.2\n", "poses.txt": b"".join(KITTI.splitlines(True)[:3])},
        _frames,
    )
    stamps = [140363657976 * 10**7 + row * 5 * 10**7 for row in range(3)]
    euroc: dict[str, bytes] = {}
    for k, shift in ((0, b"0"), (1, b"0.1")):
        euroc |= {f"mav0/cam{k}/data/{t}.png": png for t in stamps}
        euroc |= {
            f"mav0/cam{k}/sensor.yaml": YAML % shift,
            f"mav0/cam{k}/data.csv": b"#t\n" + b"".join(b"%d,%d.png\r\n" % (t, t) for t in stamps),
        }
    yield "euroc", euroc | {"mav0/state_groundtruth_estimate0/data.csv": EUROC}, _frames
    seven = {f"frame-{row:06d}.color.png": png for row in range(3)}
    seven |= {f"frame-{row:06d}.depth.png": depth for row in range(3)}
    seven |= {f"frame-{row:06d}.pose.txt": b"1 0 0 0\n0 1 0 0\n0 0 1 %d\n0 0 0 1\n" % row for row in range(3)}
    yield "seven_scenes", seven | {"camera-intrinsics.txt": b"30 0 16\n0 30 12\n0 0 1\n"}, _frames
    folder = {f"{row}.png": png for row in range(3)} | {"times.txt": b"0\n1\n2\n", "groundtruth.txt": TUM}
    yield "images", folder | {"cameras.txt": b"1 OPENCV 32 24 30 30 16 12 0.1 0 0 0\n"}, _frames
    for name, text in (
        ("fisheye", b"OPENCV_FISHEYE 32 24 30 30 16 12 0.1 0 0 0\n"),
        ("matrix", b"30 0 16\n0 30 12\n0 0 1\n"),
    ):
        yield f"camera_{name}", {"0.png": png, "camera.txt": text}, _frames


def _images() -> Iterator[Made]:
    endings = (".png", ".jpg", ".bmp", ".webp", ".tif", ".pgm")
    for ending in endings:
        yield f"image_{ending[1:]}", {f"a{ending}": encoded(ending)}, _photo(f"a{ending}")
    for ending, image in ((".png", GRAY.astype(np.uint16) * 200), (".tif", GRAY.astype(np.float32))):
        yield f"image_deep_{ending[1:]}", {f"a{ending}": encoded(ending, image)}, _photo(f"a{ending}")


def _photo(name: str) -> Callable[[Path], object]:
    return lambda folder: (read_picture(folder / name, 20), read_gray(folder / name).shape)


def _depth_maps() -> Iterator[Made]:
    """Yield folders of depth maps in every form, read with and without a scale."""
    height, width = GRAY.shape
    near = np.linspace(0.5, 4.0, height * width, dtype=np.float32).reshape(height, width)
    forms = {
        "png": encoded(".png", (1000 * near).astype(np.uint16)),
        "npy": npy(near),
        "npz": npz(depth=near, confidence=near > 1.0),
    }
    for ending, content in forms.items():
        for name, maps in (("", DepthMaps), ("_scaled", functools.partial(DepthMaps, scale=1000.0, relative=True))):
            files = {f"{row}.{ending}": content for row in range(2)}
            yield f"depth_{ending}{name}", files, functools.partial(_depths, maps)
    yield "silhouettes", {f"{row}.png": encoded(".png") for row in range(2)}, _silhouettes


def _depths(maps: Callable[[Path], DepthMaps], folder: Path) -> object:
    given = maps(folder)
    files = [file for file in given.files(["0.jpg", "1.jpg"]) if file is not None]
    found = [(given.read(file, GRAY.shape[::-1]), file) for file in files]
    return [given.holds_millimetres(*one) for one in found]


def _silhouettes(folder: Path) -> object:
    return read_silhouettes(folder, ("0.jpg", "1.jpg"))
