# SPDX-License-Identifier: BSD-3-Clause
"""Scenes as LIMAP 2 writes them are adjusted as they are, and LIMAP reads the result: with groups and without, with
members, lines and groups that are not there or have no place, other camera models, names with folders and blanks.

It runs where LIMAP can be imported, or where the environment variable GROMA_LIMAP_PYTHON names a Python that can.
"""

import json
import subprocess
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest
from _limap import LIMAP_PYTHON

from groma.cli.main import run
from groma.evaluation import evaluate_poses
from groma.io import read_scene, write_colmap
from groma.scene.synthetic.scenes import holistic

pytestmark = pytest.mark.skipif(not LIMAP_PYTHON, reason="needs pylimap 2.0 (or GROMA_LIMAP_PYTHON)")

#: Reads a model, changes it by a program, writes it; or says what is in it if there is none.
BRIDGE = """
import json, sys
import numpy as np, pycolmap
from limap.geometry import GroupType, Line3d
from limap.scene import AssociatedFeature3d, Group3d, HolisticReconstruction
pycolmap.logging.minloglevel = 3
source, target, form, change = sys.argv[1:]
model = HolisticReconstruction()
model.read(source)
s = model.structure_recon
def group(kind, params, points=(), lines=()):
    made = Group3d(kind, params)
    for number in points: made.add_point(AssociatedFeature3d(number))
    for number in lines: made.add_line(AssociatedFeature3d(number))
    return made
exec(change)
if target:
    (model.write_text if form == "text" else model.write_binary)(target)
print(json.dumps(dict(
    valid=model.check_validity(), images=len(s.structures2d), lines=len(s.lines3D), edges=s.wireframe.count_edges(),
    groups={str(i): [len(g.points), len(g.lines)] for i, g in s.groups3D.items()},
)))
"""

CHANGES = {
    "as it is": "",
    "no groups": "for i in list(s.groups3D): s.delete_group3D(i)\ns.wireframe.clear()",
    "wireframe alone": "for i in list(s.groups3D): s.delete_group3D(i)",
    "no wireframe": "s.wireframe.clear()",
    "a line of no place": "for i, p in ((9001, np.nan), (9002, 1.0)): "
    "s.add_line3D(i, Line3d(np.full(3, p), np.ones(3)))",
    "members that are not there": "s.add_group3D(900, group(GroupType.PLANE, [0, 0, 1, -0.5], [123456], [77777]))",
    "groups of nothing": "s.add_group3D(900, group(GroupType.PLANE, [0, 0, 1, -0.5]))\n"
    "s.add_group3D(901, group(GroupType.VP, [0, 0, 1]))",
    "a plane of two points": "two = sorted(model.point_recon.points3D)[:2]\n"
    "s.add_group3D(900, group(GroupType.PLANE, [0, 0, 1, -0.5], two))",
    "lines deleted": "for i in sorted(s.lines3D)[:5]: s.delete_line3D(i)",
}


def bridge(source, target="", form="binary", change=""):
    words = [LIMAP_PYTHON, "-c", BRIDGE, str(source), str(target), form, change]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def instance(folder, seed, camera="PINHOLE"):
    """Write a scene, and return its truth."""
    made = holistic(12, seed=seed, noise_px=0.5)
    names = tuple(f"set {k % 2}/sub dir/DSC {k:04d} é.JPG" for k in range(12))
    start, truth = (scene.replace(images=replace(scene.images, names=names)) for scene in (made.start, made.truth))
    f, _, cx, cy = start.cameras.params[0]
    params = {"PINHOLE": [f, f, cx, cy], "SIMPLE_PINHOLE": [f, cx, cy], "OPENCV": [f, f, cx, cy, 0, 0, 0, 0]}[camera]
    cameras = replace(start.cameras, models=(camera,), params=(np.array(params, float),))
    write_colmap(start.replace(cameras=cameras), folder, "binary")
    return truth


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("change", CHANGES)
def test_instances_of_limap_are_adjusted(tmp_path, change, form):
    truth = instance(tmp_path / "groma", seed=len(change))
    (tmp_path / "limap").mkdir()
    before = bridge(tmp_path / "groma", tmp_path / "limap", form, CHANGES[change])
    lost = 2 if change == "a line of no place" else 0
    with pytest.warns(UserWarning, match="2 of .* lines in .* were left out") if lost else nullcontext():
        command = ["adjust", str(tmp_path / "limap"), "-o", str(tmp_path / "out"), "--json", str(tmp_path / "r.json")]
        assert run(command) == 0
    assert json.loads((tmp_path / "r.json").read_text())["termination"] != "failed"
    out = read_scene(tmp_path / "out")
    assert out.images.names == truth.images.names
    assert evaluate_poses(out, truth).center_rmse < 0.02
    after = bridge(tmp_path / "out")
    assert after["valid"] and after["images"] == 12
    assert after["lines"] == before["lines"] - lost
    assert after["edges"] <= before["edges"]
    assert after["groups"].keys() == before["groups"].keys()
    for number, (points, lines) in after["groups"].items():
        assert points <= before["groups"][number][0] and lines <= before["groups"][number][1]


@pytest.mark.parametrize("camera", ["SIMPLE_PINHOLE", "OPENCV"])
def test_camera_models(tmp_path, camera):
    truth = instance(tmp_path / "groma", 3, camera)
    (tmp_path / "limap").mkdir()
    bridge(tmp_path / "groma", tmp_path / "limap")
    assert run(["adjust", str(tmp_path / "limap"), "-o", str(tmp_path / "out")]) == 0
    out = read_scene(tmp_path / "out")
    assert out.cameras.models == (camera,)
    assert evaluate_poses(out, truth).center_rmse < 0.02
