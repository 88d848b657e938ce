# SPDX-License-Identifier: BSD-3-Clause
"""What is attacked: for every reader and format a folder of small good files, and what is done with them.

A target's folder is made once. Its ``read`` is called after one of its files has been changed; it returns what it has
read, or raises an error of groma.
"""

from __future__ import annotations

import bz2
import io
import json
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "io"))

import test_bundler
import test_nvm
import test_openmvg
import test_opensfm
import test_survey_files
import test_transforms
from _models import rig_scene
from _mutations import gzip_stored
from _views import views

from groma.adjustment.survey.attach import with_survey
from groma.adjustment.survey.given import Survey
from groma.features.external import read_matches
from groma.io import read_g2o, read_scene, read_trajectory, structures_of, write_archive, write_colmap, write_scene
from groma.io.reference import holds_scene, read_line3dpp, read_reference
from groma.io.sequences import open_sequence
from groma.io.survey import (
    read_control,
    read_directions,
    read_distances,
    read_exif_positions,
    read_known_planes,
    read_measured_poses,
    read_positions,
)  # fmt: skip
from groma.mapping.checkpoint_files import LINE_MAP, SEGMENTS
from groma.mapping.photographs import read_gray
from groma.scene import Scene, synthetic
from groma.viz.pictures import read_picture
from groma.viz.report.page import PageContents, write_report
from groma.viz.report.saved import saved_report
from groma.viz.viewer.live import read_frames

BAL = (Path(__file__).parents[1] / "data" / "bal" / "dubrovnik-3-7-pre.txt").read_bytes()
GRAY = np.random.default_rng(0).integers(0, 255, (24, 32)).astype(np.uint8)


@dataclass(frozen=True)
class Target:
    """A reader, and the names of the files in its folder that are attacked."""

    name: str
    folder: Path
    files: tuple[str, ...]
    read: Callable[[Path], object]


def targets(home: Path) -> list[Target]:
    """Make all targets in a folder."""
    made = []
    for name, files, read in _all(home):
        folder = home / name
        for file, content in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(content)
        made.append(Target(name, folder, tuple(files), read))
    return made


_Made = tuple[str, dict[str, bytes], Callable[[Path], object]]


def _all(home: Path) -> Iterator[_Made]:
    yield from _scenes(home)
    yield from _texts()
    yield from _arrays()
    yield from _sequences()
    yield from _images()
    yield from _interchange()
    yield from _surveys()


def _one(read: Callable[[Path], object], name: str) -> Callable[[Path], object]:
    return lambda folder: read(folder / name)


def _scenes(home: Path) -> Iterator[_Made]:
    work = home / "work"
    work.mkdir()
    small = synthetic.holistic(4, seed=1).start
    for form in ("binary", "text"):
        write_colmap(rig_scene(), work / form, form=form)
        files = {path.relative_to(work / form).as_posix(): path.read_bytes() for path in (work / form).rglob("*.*")}
        yield f"colmap_{form}", files, _model
        yield f"structures_{form}", {n: c for n, c in files.items() if "structures" in n} | _bare(files), _model
    for name, scene in (("archive", rig_scene()), ("archive_solved", small)):
        write_archive(scene, work / f"{name}.npz")
        yield name, {"scene.npz": (work / f"{name}.npz").read_bytes()}, _one(read_scene, "scene.npz")
    for name, content in (("bal.txt", BAL), ("bal.bz2", bz2.compress(BAL)), ("bal.gz", gzip_stored(BAL))):
        yield name.replace(".", "_"), {name: content}, _one(read_scene, name)
    shutil.rmtree(work)


def _bare(files: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in files.items() if name.startswith(("cameras", "images", "points3D"))}


def _model(folder: Path) -> Scene:
    scene = read_scene(folder)
    structures_of(folder)
    return scene


TUM = b"# time x y z q\n" + b"".join(b"%d.5 1 2 3 0 0.6 0 0.8\n" % row for row in range(6))
KITTI = b"".join(b"1 0 0 %d 0 1 0 0.5 0 0 1 2.5\n" % row for row in range(6))
EUROC = b"#time\n" + b"".join(b"140363657976%d000000,1,2,3,0.8,0,0.6,0,1,1,1\n" % row for row in range(6))
G2O_3D = b"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\nFIX 0\nPARAMS_SE3OFFSET 0 0\n" + (
    b"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + b"4 0 0 0 0 0 4 0 0 0 0 4 0 0 0 9 0 0 9 0 9\n"
)
G2O_2D = b"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nEDGE_SE2 0 1 1 0 0.1 4 0 0 4 0 9\n" + (
    b"EDGE_SE2 1 0 1 0 0.1 4 0 0 4 0 9\n"
)
LINE3D = b"0 0 0 1 0 0 2 a.png 1 2 3 4 b.png 5 6 7 8\n1 0 0 1 0 1 0\n"
OBJ = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\nf -1 -2 -3\nl 1 2 3\n"
PLY = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
element edge 1
property int vertex1
property int vertex2
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
0 1
"""


def _texts() -> Iterator[_Made]:
    for name, content in (("tum", TUM), ("kitti", KITTI), ("euroc", EUROC)):
        yield f"trajectory_{name}", {"a.txt": content}, _one(read_trajectory, "a.txt")
        yield f"trajectory_{name}_gz", {"a.gz": gzip_stored(content)}, _one(read_trajectory, "a.gz")
    for name, content in (("g2o_3d", G2O_3D), ("g2o_2d", G2O_2D), ("g2o_gz", gzip_stored(G2O_3D))):
        yield name, {"a.g2o": content}, _one(read_g2o, "a.g2o")
    body = (
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
        + b"\3"
        + np.array([0, 1, 2, 0, 1], "<i4").tobytes()
    )
    head = PLY[: PLY.index(b"end_header") + 11].replace(b"ascii", b"binary_little_endian")
    for name, content in (("ply", PLY), ("ply_binary", head + body), ("obj", OBJ), ("line3dpp", LINE3D)):
        file = {"ply_binary": "a.ply", "line3dpp": "a.txt"}.get(name, f"a.{name}")
        yield name, {file: content}, _one(read_reference, file)
    yield "line3dpp_lines", {"a.txt": LINE3D}, _one(read_line3dpp, "a.txt")
    yield "segments_txt", {"a.txt": b"0 0 0 1 0 0\n1 2 3 4 5 6\n"}, _one(read_reference, "a.txt")
    yield (
        "frames_txt",
        {"f.txt": b"".join(b"%d 1 2 3 0 0 0 1 0\n" % row for row in range(4))},
        _one(read_frames, "f.txt"),
    )
    yield "summary", {"summary.json": _summary()}, _page


def _summary() -> bytes:
    from groma.adjustment.adjust import AdjustOptions, adjust

    scene = synthetic.holistic(4, seed=1).start
    return json.dumps(adjust(scene, AdjustOptions(max_iterations=2)).summary()).encode()


PAGE_SCENE = synthetic.holistic(4, seed=1).start.points_only()


def _page(folder: Path) -> object:
    report = saved_report(folder)
    if report is not None:
        contents = PageContents(report.outcomes, report.explanation)
        write_report(folder / "page.html", None, PAGE_SCENE, report, contents=contents)
    return report


def _reference(folder: Path) -> object:
    return holds_scene(folder / "a.npz"), read_reference(folder / "a.npz")


def _npz(**arrays: object) -> bytes:
    stream = io.BytesIO()
    np.savez(stream, **{name.replace("__", "|"): np.asarray(value) for name, value in arrays.items()})
    return stream.getvalue()


def _arrays() -> Iterator[_Made]:
    rng = np.random.default_rng(1)
    corners, segments = rng.normal(size=(5, 3)), rng.normal(size=(4, 6))
    graphs = {
        "graph": _npz(points=corners, edges=[[0, 1], [2, 3]]),
        "mesh": _npz(vertices=corners, faces=[[0, 1, 2, 3]]),
        "lines": _npz(lines=segments),
        "cloud": _npz(points=corners),
    }
    for name, content in graphs.items():
        yield f"reference_{name}", {"a.npz": content}, _reference
    stream = io.BytesIO()
    np.save(stream, segments)
    yield "reference_npy", {"a.npy": stream.getvalue()}, _one(read_reference, "a.npy")
    matches = _npz(
        segments__a=rng.uniform(0, 9, (4, 4)), segments__b=rng.uniform(0, 9, (3, 4)),
        matches__a__b=[[0, 1], [3, 2]], scores__a__b=[0.5, 1.0],
    )  # fmt: skip
    yield "line_matches", {"m.npz": matches}, _one(read_matches, "m.npz")
    kept = _npz(counts=[1, 2], ends=rng.uniform(0, 9, (3, 4)), sigma=np.ones(3), strength=np.ones(3))
    yield "kept_segments", {"s.npz": kept}, _one(SEGMENTS.read, "s.npz")
    names = ("image_idx", "segment_idx", "line_idx", "residual", "num_images", "median_residual", "uncertainty")
    line_map = dict.fromkeys(names, np.zeros(1)) | {"lines": np.zeros((1, 6)), "segments": np.zeros((1, 2, 3))}
    line_map |= {
        "supporters": np.zeros((1, 2), np.int64),
        "rejection": np.zeros(1, np.int64),
        "depth_ratios": np.zeros((1, 2)),
    }
    line_map |= {f"{part}{end}": np.zeros(1, np.int64) for part in ("outcomes", "neighbors") for end in ("", ".counts")}
    yield "kept_line_map", {"l.npz": _npz(**line_map)}, _one(LINE_MAP.read, "l.npz")


def _encoded(ending: str, image: np.ndarray = GRAY) -> bytes:
    return bytes(cv2.imencode(ending, image)[1])


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


def _sequences() -> Iterator[_Made]:
    png, depth = _encoded(".png"), _encoded(".png", np.full((24, 32), 5000, np.uint16))
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


def _images() -> Iterator[_Made]:
    endings = (".png", ".jpg", ".bmp", ".webp", ".tif", ".pgm")
    for ending in endings:
        yield f"image_{ending[1:]}", {f"a{ending}": _encoded(ending)}, _photo(f"a{ending}")
    for ending, image in ((".png", GRAY.astype(np.uint16) * 200), (".tif", GRAY.astype(np.float32))):
        yield f"image_deep_{ending[1:]}", {f"a{ending}": _encoded(ending, image)}, _photo(f"a{ending}")


def _photo(name: str) -> Callable[[Path], object]:
    return lambda folder: (read_picture(folder / name, 20), read_gray(folder / name).shape)


def _interchange() -> Iterator[_Made]:
    """Yield files of other programs, written by the tests of their formats: small ones, most of whose text matters."""
    true = views(4, 5)
    names = "".join(f"{row}.png\n" for row in range(4)).encode()
    photographs = {f"{row}.png": _encoded(".png") for row in range(4)}
    bundle = test_bundler.bundle(true).encode()
    yield "bundler", {"bundle.out": bundle, "list.txt": names}, read_scene
    yield "bundler_images", {"bundle.out": bundle, "list.txt": names, **photographs}, read_scene
    for name, coefficient in (("nvm", 0.0), ("nvm_lens", 0.05)):
        yield name, {"a.nvm": test_nvm.nvm(true, coefficient).encode()}, _one(read_scene, "a.nvm")
    for kind in ("pinhole_brown_t2", "fisheye", "spherical"):
        values = test_openmvg.KINDS[kind][1] if kind != "spherical" else []
        document = json.dumps(test_openmvg.document(true, kind, values), indent=1).encode()
        yield f"openmvg_{kind}", {"sfm_data.json": document}, read_scene
    for kind in ("perspective", "brown", "fisheye_opencv"):
        said, _ = test_opensfm.CAMERAS[kind]
        one = test_opensfm.reconstruction(true, kind, said)
        one["reference_lla"] = {"latitude": 52.5, "longitude": 13.4, "altitude": 30.0}
        files = {
            "reconstruction.json": json.dumps([one, one], indent=1).encode(),
            "tracks.csv": test_opensfm.tracks(true, kind, said, 2).encode(),
        }
        yield f"opensfm_{kind}", files, read_scene
    frames = test_transforms.frames(true)
    lens = {**test_transforms.LENS, **test_transforms.BENT, "camera_model": "OPENCV", "aabb_scale": 16}
    for name, said in (("transforms", lens), ("transforms_angle", {"camera_angle_x": 0.7})):
        document = json.dumps({**said, "ply_file_path": "a.ply", "frames": frames}, indent=1).encode()
        images = {f"images/{name}": content for name, content in photographs.items()}
        yield name, {"transforms.json": document, "a.ply": PLY, **images}, _transforms


def _surveys() -> Iterator[_Made]:
    """Yield files of measurements, attached to a scene where they can be read."""
    scene = synthetic.holistic(4, seed=1).truth.points_only()
    centers = scene.cam_centers_in_world
    lines = [f"{n} {x:.4f} {y:.4f} {z:.4f} 0.1" for n, (x, y, z) in zip(scene.images.names, centers, strict=True)]
    listed, header = "\n".join(lines).encode(), b"name x y z sigma\n"
    row, xyz = scene.point_observations, scene.points.xyz
    marks = [
        f"{x:.3f} {y:.3f} {z:.3f} {u:.2f} {v:.2f} {scene.images.names[image]} p{point}"
        for image, point, (u, v) in zip(row.image_idx, row.point_idx, row.pixel, strict=True)
        if point < 5 for x, y, z in [xyz[point]]
    ]  # fmt: skip
    width, height = scene.cameras.width[0], scene.cameras.height[0]
    points = []
    for point in range(5):
        rows = np.flatnonzero(row.point_idx == point)
        shots = [scene.images.names[image] for image in row.image_idx[rows]]
        places = ((row.pixel[rows] - [width / 2, height / 2]) / max(width, height)).tolist()
        x, y, z = xyz[point]
        at = {"latitude": 52.5 + y / 111_270, "longitude": 13.4 + x / 67_880, "altitude": z}
        seen = [{"shot_id": shot, "projection": place} for shot, place in zip(shots, places, strict=True)]
        points.append({"id": str(point), "position": at, "observations": seen})

    def attached(**files: str) -> Callable[[Path], object]:
        def read(folder: Path) -> object:
            given = {kind: _SURVEYS[kind](folder / name) for kind, name in files.items()}
            survey = Survey(
                **given,
                position_sigma=(1.0,),
                control_sigma=(1.0,),
                distance_sigma=1.0,
                plane_sigma=0.1,
                direction_sigma_deg=1.0,
            )
            return with_survey(scene, survey).scene

        return read

    yield "positions", {"positions.csv": header + listed}, attached(positions="positions.csv")
    yield "geo", {"geo.txt": b"EPSG:32633\n" + listed}, attached(positions="geo.txt")
    gcp = ("local\n" + "\n".join(marks)).encode()
    bars = b"p0 p1 1.5 0.01\n" + f"{scene.images.names[0]},{scene.images.names[1]},2.0".encode()
    yield "control", {"gcp_list.txt": gcp, "bars.csv": bars}, attached(control="gcp_list.txt", distances="bars.csv")
    yield "ground control", {"gcp.json": json.dumps({"points": points}).encode()}, attached(control="gcp.json")
    names, down = scene.images.names, b"0.02 0.9 0.4"
    known = {
        "down.txt": b"\n".join(name.encode() + b" " + down for name in names),
        "levels.txt": b"p0 z 1.5\n" + f"{names[0]} 0 0 1 -2 0.1".encode(),
        "poses.txt": "\n".join(f"{name} {k} {k % 2} 0 0 0 0 1 0.1 1" for k, name in enumerate(names)).encode(),
    }
    for kind, (file, text) in zip(("directions", "planes", "poses"), known.items(), strict=True):
        yield kind, {"gcp_list.txt": gcp, file: text}, attached(control="gcp_list.txt", **{kind: file})
    photo = test_survey_files.jpeg_with_position("<", 52.5, 13.4, 99.0)
    yield "exif", {"a.jpg": photo}, lambda folder: read_exif_positions(folder, ["a.jpg"])


_SURVEYS = {
    "positions": read_positions, "control": read_control, "distances": read_distances, "directions": read_directions,
    "planes": read_known_planes, "poses": read_measured_poses,
}  # fmt: skip


def _transforms(folder: Path) -> Scene:
    """Read, and write where the cameras can be."""
    scene = read_scene(folder)
    write_scene(scene, folder / "again.json", force=True)
    return scene
