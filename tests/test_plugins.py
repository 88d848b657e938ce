# SPDX-License-Identifier: BSD-3-Clause
"""The outside package in ``examples/plugins``: installed, every part of it keeps its contract and does its work.

Everything runs in processes of its own, which know the package by its installation only.
"""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from _facade import facade

from groma.io import read_scene, write_scene
from groma.scene.synthetic.scenes import holistic

PACKAGE = Path(__file__).resolve().parents[1] / "examples" / "plugins"


def install(target):
    """Install the package into a folder: by pip where its build backend is there, else as pip would."""
    source = target.parent / "source"
    shutil.copytree(PACKAGE, source)
    if importlib.util.find_spec("hatchling") is not None:
        options = ["--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--disable-pip-version-check"]
        command = [sys.executable, "-m", "pip", "install", *options, "--target", str(target), str(source)]
        subprocess.run(command, check=True, capture_output=True, timeout=300)
        return
    shutil.copytree(source / "src", target)
    project = tomllib.loads((source / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    describe(target, project["name"], project["version"], project["entry-points"])


def describe(target, name, version, groups):
    """Write what an installer writes about a package."""
    folder = target / f"{name.replace('-', '_')}-{version}.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", encoding="utf-8")
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in groups.items()]
    (folder / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    target = tmp_path_factory.mktemp("plugin") / "site"
    install(target)
    return target


@pytest.fixture
def python(installed, tmp_path):
    """Run Python with the package installed; return what it said on both streams."""

    def start(*arguments, also=(), expected=0):
        paths = [str(installed), *map(str, also), os.environ.get("PYTHONPATH", "")]
        finished = subprocess.run(
            [sys.executable, *map(str, arguments)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join(path for path in paths if path)},
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=500,
        )
        assert finished.returncode == expected, finished.stderr
        return finished.stdout, finished.stderr

    return start


CONFORMANCE = """
import numpy as np
import groma.testing as checks
from groma.plugins import load_plugins
assert load_plugins() == ("example",)
from groma import cameras, factors
from groma.features.registry import DETECTORS, MATCHERS, RETRIEVAL
from groma.geometry.charts import charts_of
from groma.scene import Lines, Scene

rng = np.random.default_rng(0)
checks.check_camera(cameras.model("EQUISOLID"), np.array([300.0, 320.0, 240.0]), rng, half_angle=2.5)
checks.check_factor(factors.registered()["gravity"])
checks.check_loss(factors.loss("welsch", 1.7))
checks.check_manifold(charts_of("line")["centimetres"])
checks.check_detector(DETECTORS.make("hough", min_length=20.0, max_segments=0))
checks.check_matcher(MATCHERS.make("nearest"))
checks.check_retrieval(RETRIEVAL.make("thumbnails"))
lines = Lines.through(rng.normal(size=(5, 2, 3)))
checks.check_format("segments", Scene(lines=lines), ["lines"])
"""


def test_nothing_is_imported_before_it_is_asked_for(python):
    said, _ = python("-c", "import groma, groma.features.registry as r, sys\nprint(r.DETECTORS.names(), *sys.modules)")
    assert said.startswith("['hough', 'lsd', 'onnx:FILE']")
    assert "groma_plugin_example" not in said


ADJUST = """
import groma
from groma.geometry import quaternion, se3
from groma.geometry.charts.pose_charts import PoseLeft
from groma.scene import Cameras, PointObservations, Points
from groma.scene.synthetic.scenes import holistic

# Points seen through a lens that groma does not have; the focal length starts 2 % off.
truth = holistic(8, seed=0).truth
model, params = cameras.model("EQUISOLID"), np.array([700.0, 512.0, 384.0])
seen = truth.point_observations
points = se3.transform_points(truth.cam_from_world[seen.image_idx], truth.points.xyz[seen.point_idx])
pixels = model.project(params, points)
one = np.ones(1, int)
lens = Cameras(one, ("EQUISOLID",), (params * [0.98, 1.0, 1.0])[None], 1024 * one, 768 * one)
scene = Scene.from_images(
    lens, list(truth.images.names), np.zeros(8, int), truth.cam_from_world,
    points=Points.at(truth.points.xyz + 0.01),
    point_observations=PointObservations.numbered(seen.image_idx, seen.point_idx, pixels),
)
options = groma.AdjustOptions(loss="welsch", loss_scale=20.0, refine_intrinsics=True, max_iterations=100)
result = groma.adjust(scene, options)
assert result.report.rmse_px["points"]["after"] < 1e-3, result.report.rmse_px
np.testing.assert_allclose(result.scene.cameras.params_of(0), params, rtol=1e-4)
groma.write_scene(result.scene, "lens.npz")
assert groma.read_scene("lens.npz").cameras.models == ("EQUISOLID",)

# Down, as an accelerometer measures it, turns a pose upright and leaves its heading alone.
from groma_plugin_example.gravity import Gravity

tilted = se3.exp(np.array([[0.0, 0.0, 0.0, 0.3, -0.2, 0.4]]))
upright = quaternion.to_matrix(se3.exp(np.array([[0.0, 0.0, 0.0, 0.1, 0.2, 0.0]]))[0, :4])
factor = Gravity(pose=groma.Ref("poses", np.zeros(1, int)), data=(upright @ [0.0, 0.0, -1.0])[None])
solution = groma.solve(groma.Problem({"poses": groma.Variables(PoseLeft(), tilted)}, [factor]))
down = quaternion.to_matrix(solution["poses"][0, :4]) @ [0.0, 0.0, -1.0]
np.testing.assert_allclose(down, factor.data[0], atol=1e-6)
"""


def test_every_part_keeps_its_contract_and_takes_part_in_adjustments(python):
    """Of the latter: camera, loss and factor. In one process, which imports everything once."""
    python("-c", CONFORMANCE + ADJUST)


#: Commands, one after the other; each is followed by its exit code on standard error.
COMMANDS = """
import json, sys
from groma.cli.main import run
for words in json.loads(sys.argv[1]):
    print("END", run(words), file=sys.stderr)
"""


def test_parts_by_name_on_the_command_line(python, tmp_path):
    """Loss, chart, solver and format; detector and matcher, by which photographs are mapped."""
    write_scene(holistic(8, seed=0).start, tmp_path / "start.npz")
    options = ["--loss", "welsch", "--loss-scale", "6", "--line-chart", "centimetres", "--no-diagnosis"]
    options += ["--linear-solver", "eigenvalues", "--json", "report.json"]
    (tmp_path / "bad.segments").write_text("# segments: x1 y1 z1 x2 y2 z2\n1 2 three\n", encoding="utf-8")
    commands = [["adjust", "start.npz", "-o", "end.npz", *options], ["convert", "end.npz", "end.segments"]]
    commands += [["convert", "end.segments", "lines.npz"], ["convert", "bad.segments", "no.npz"]]
    commands += [["convert", "end.npz", "no.thing"]]
    write_scene(facade(tmp_path / "photos", 4), tmp_path / "model.npz")
    options = ["--model", "model.npz", "--no-planes", "--no-diagnosis", "--line-matcher", "nearest"]
    commands += [["map", "photos", "-o", "out", *options, "--line-detector", "hough"]]
    commands += [["map", "photos", "-o", "no", *options, "--line-detector", "huff"]]
    _, said = python("-c", COMMANDS, json.dumps(commands))
    *_, damaged, unknown, _, misspelt, last = said.split("END ")
    assert [part[0] for part in said.split("END ")[1:]] == ["0", "0", "0", "1", "1", "0", "1"] and last == "1\n"
    assert json.loads((tmp_path / "report.json").read_text())["linear_solver"] == "eigenvalues"
    whole, lines = read_scene(tmp_path / "end.npz"), read_scene(tmp_path / "lines.npz")
    np.testing.assert_array_equal(lines.lines.segments, whole.lines.segments)
    assert "not a usable file of segments" in damaged
    assert ".segments for segments as text" in unknown
    assert read_scene(tmp_path / "out" / "scene.npz").num_lines > 0
    assert "There is no segment detector named 'huff'; choose one of hough, lsd, onnx:FILE." in misspelt


BROKEN = "import groma\nraise RuntimeError('made for\\nanother version')\n"


def test_a_broken_plugin_is_one_line_and_harms_nothing(python, tmp_path):
    site = tmp_path / "site"
    groups = {"groma.plugins": {"lab": "broken_lab"}, "groma.detectors": {"lab": "broken_lab:Detector"}}
    describe(site, "broken-lab", "2.0", groups)
    (site / "broken_lab.py").write_text(BROKEN, encoding="utf-8")
    write_scene(holistic(4, seed=0).start, tmp_path / "start.npz")
    _, complaint = python("-m", "groma.cli.main", "convert", "start.npz", "copy.npz", "--quiet", also=[site])
    assert complaint == ""
    _, complaint = python("-m", "groma.cli.main", "convert", "start.npz", "again.npz", also=[site])
    lines = [line for line in complaint.splitlines() if line.startswith("warning")]
    assert lines == [
        "warning: the plugin 'lab' of the package broken-lab cannot be loaded and is left out: RuntimeError: made for "
        "another version. Update or uninstall it."
    ]
    (tmp_path / "photos").mkdir()
    program = "from groma.features.registry import DETECTORS\nDETECTORS.make('lab', min_length=9.0, max_segments=0)"
    _, complaint = python("-c", program, also=[site], expected=1)
    assert "The segment detector 'lab' of the package broken-lab cannot be used: RuntimeError: made for" in complaint
