# SPDX-License-Identifier: BSD-3-Clause
"""Targets: scenes of groma, COLMAP, Bundle Adjustment in the Large, and of other programs."""

from __future__ import annotations

import bz2
import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import test_bundler
import test_meshroom
import test_metashape
import test_nvm
import test_openmvg
import test_opensfm
import test_splats
import test_transforms
from _models import rig_scene
from _mutations import gzip_stored
from _targets import Made, encoded, one
from _targets_tables import PLY
from _views import views

from groma.io import read_scene, structures_of, write_archive, write_colmap, write_scene
from groma.scene import Scene, synthetic

BAL = (Path(__file__).parents[1] / "data" / "bal" / "dubrovnik-3-7-pre.txt").read_bytes()


def made(home: Path) -> Iterator[Made]:
    """Yield all targets of this module."""
    yield from _scenes(home)
    yield from _interchange()


def _scenes(home: Path) -> Iterator[Made]:
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
        yield name, {"scene.npz": (work / f"{name}.npz").read_bytes()}, one(read_scene, "scene.npz")
    for name, content in (("bal.txt", BAL), ("bal.bz2", bz2.compress(BAL)), ("bal.gz", gzip_stored(BAL))):
        yield name.replace(".", "_"), {name: content}, one(read_scene, name)
    shutil.rmtree(work)


def _bare(files: dict[str, bytes]) -> dict[str, bytes]:
    return {name: content for name, content in files.items() if name.startswith(("cameras", "images", "points3D"))}


def _model(folder: Path) -> Scene:
    scene = read_scene(folder)
    structures_of(folder)
    return scene


def _interchange() -> Iterator[Made]:
    """Yield files of other programs, written by the tests of their formats: small ones, most of whose text matters."""
    true = views(4, 5)
    names = "".join(f"{row}.png\n" for row in range(4)).encode()
    photographs = {f"{row}.png": encoded(".png") for row in range(4)}
    bundle = test_bundler.bundle(true).encode()
    yield "bundler", {"bundle.out": bundle, "list.txt": names}, read_scene
    yield "bundler_images", {"bundle.out": bundle, "list.txt": names, **photographs}, read_scene
    for name, coefficient in (("nvm", 0.0), ("nvm_lens", 0.05)):
        yield name, {"a.nvm": test_nvm.nvm(true, coefficient).encode()}, one(read_scene, "a.nvm")
    for kind in ("pinhole_brown_t2", "fisheye", "spherical"):
        values = test_openmvg.KINDS[kind][1] if kind != "spherical" else []
        document = json.dumps(test_openmvg.document(true, kind, values), indent=1).encode()
        yield f"openmvg_{kind}", {"sfm_data.json": document}, read_scene
    for kind, version in (("pinhole_brown_t2", "1.0.0"), ("fisheye", "1.2.6")):
        document = json.dumps(test_meshroom.document(true, kind, test_openmvg.KINDS[kind][1], version), indent=1)
        yield f"meshroom_{kind}", {"cameras.sfm": document.encode()}, one(read_scene, "cameras.sfm")
    for kind in ("pinhole_brown_t2", "fisheye"):
        said = test_metashape.LENSES[kind][0], "fisheye" if kind == "fisheye" else "frame", 'PROJCS["UTM"]'
        document = test_metashape.document(true.rotation, true.center, *said)
        yield f"metashape_{kind}", {"a.xml": document.encode()}, one(read_scene, "a.xml")
    for kind in ("perspective", "brown", "fisheye_opencv"):
        said, _ = test_opensfm.CAMERAS[kind]
        model = test_opensfm.reconstruction(true, kind, said)
        model["reference_lla"] = {"latitude": 52.5, "longitude": 13.4, "altitude": 30.0}
        files = {
            "reconstruction.json": json.dumps([model, model], indent=1).encode(),
            "tracks.csv": test_opensfm.tracks(true, kind, said, 2).encode(),
        }
        yield f"opensfm_{kind}", files, read_scene
    splats = json.dumps(test_splats.document(true), indent=1).encode()
    yield "splats", {"cameras.json": splats}, one(read_scene, "cameras.json")
    frames = test_transforms.frames(true)
    lens = {**test_transforms.LENS, **test_transforms.BENT, "camera_model": "OPENCV", "aabb_scale": 16}
    for name, said in (("transforms", lens), ("transforms_angle", {"camera_angle_x": 0.7})):
        document = json.dumps({**said, "ply_file_path": "a.ply", "frames": frames}, indent=1).encode()
        images = {f"images/{name}": content for name, content in photographs.items()}
        yield name, {"transforms.json": document, "a.ply": PLY, **images}, _transforms


def _transforms(folder: Path) -> Scene:
    """Read, and write where the cameras can be."""
    scene = read_scene(folder)
    write_scene(scene, folder / "again.json", force=True)
    return scene
