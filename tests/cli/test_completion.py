# SPDX-License-Identifier: BSD-3-Clause
"""Names: completed by the shell, suggested where one is nearly right; options that would do nothing are refused."""

import os
import subprocess
import sys

import pytest

from groma import cameras
from groma.cli.main import run
from groma.cli.shared import command
from groma.errors import did_you_mean


def completed(*words):
    """What the shell is told to offer for the last of the words."""
    environment = {**os.environ, "_GROMA_COMPLETE": "complete_bash", "COMP_WORDS": "\n".join(("groma", *words))}
    environment["COMP_CWORD"] = str(len(words))
    program = "from groma.cli.main import main; main()"
    arguments = [sys.executable, "-c", program]
    return subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=60).stdout.split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        (("ad",), ["adjust"]),
        (("evaluate", "tr"), ["trajectory"]),
        (("adjust", "x", "--loss", "h"), ["huber"]),
        (("adjust", "x", "--line-residual", "b"), ["bearing"]),
        (("map", "x", "--camera-model", "SIMPLE_R"), ["SIMPLE_RADIAL", "SIMPLE_RADIAL_FISHEYE"]),
        (("track", "x", "--no-col"), ["--no-color"]),
        (("adjust", "mod"), []),  # files are left to the shell
        (("adjust", "x", "--report", "p"), []),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, tuple) else "",
)
def test_the_shell_completes(words, offered):
    assert completed(*words) == offered


def test_what_is_completed_is_what_there_is():
    from groma.adjustment.assembly_options import LINE_CHARTS
    from groma.compilation.warmup import PARTS
    from groma.factors.losses import LOSSES
    from groma.features.registry import DETECTORS, MATCHERS
    from groma.io.colmap.sfm import MAPPERS
    from groma.localization.calibration import SOURCES
    from groma.solver.linear.choice import linear_solver_names

    for offered, known in (
        (command.LOSSES, ({*LOSSES} - {"trivial"}) | {"auto", "none"}),
        (command.LINEAR_SOLVERS, linear_solver_names()),
        (command.LINE_CHARTS, LINE_CHARTS),
        (command.CAMERA_MODELS, {model.name for model in cameras.models()} - {"BAL"}),
        (command.DETECTORS, DETECTORS.names()),
        (command.MATCHERS, MATCHERS.names()),
        (command.MAPPERS, MAPPERS),
        (command.CALIBRATIONS, SOURCES),
        (command.COMPILED, PARTS),
    ):
        assert {*offered} <= {*known}
        others = {name for name in {*known} - {*offered} if not name.startswith(("test", "TEST", "_"))}
        assert not others or len(others) < 4  # what other tests of this process registered


@pytest.mark.parametrize(
    ("name", "known", "end"),
    [
        ("hubber", ["huber", "cauchy"], " Did you mean 'huber'?"),
        ("simple-radial", ["PINHOLE", "SIMPLE_RADIAL"], " Did you mean 'SIMPLE_RADIAL'?"),
        ("xyz", ["huber", "cauchy"], ""),
    ],
)
def test_did_you_mean(name, known, end):
    assert did_you_mean(name, known) == end


@pytest.mark.parametrize(
    ("arguments", "suggested"),
    [
        (["adjst"], "'adjust'"),
        (["adjust", "x", "--lines-residual", "y"], "--line-residual"),
        (["adjust", "SCENE", "--line-residual", "bearng"], "'bearing'"),
        (["adjust", "SCENE", "--linear-solver", "spars"], "'sparse'"),
        (["adjust", "SCENE", "--loss", "cauchi"], "'cauchy'"),
        (["adjust", "SCENE", "--camera-model", "pinhol"], "'PINHOLE'"),
        (["adjust", "SCENE", "--gauge", "fre"], "'free'"),
        (["track", "SCENE", "-o", "OUT", "--kind", "rgb"], "'rgbd'"),
        (["map", "FOLDER", "-o", "OUT", "--line-detector", "lsdd"], "'lsd'"),
        (["map", "FOLDER", "-o", "OUT", "--mapper", "globl"], "'global'"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_near_names_are_suggested(arguments, suggested, tmp_path, capsys):
    assert run(["synth", "-o", str(tmp_path / "made"), "-n", "3", "--quiet"]) == 0
    places = {"SCENE": tmp_path / "made" / "start.npz", "FOLDER": tmp_path / "made", "OUT": tmp_path / "out"}
    assert run([str(places.get(word, word)) for word in arguments]) in (1, 2)
    said = capsys.readouterr().err
    assert suggested in said and "Traceback" not in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["adjust", "HERE", "--sigma0", "2"], "--sigma0 acts only with --covariance"),
        (["adjust", "HERE", "--covariance-gauge", "held"], "--covariance-gauge acts only with --covariance"),
        (["adjust", "HERE", "--keep", "always"], "--keep acts only on a folder of parts"),
        (["adjust", "HERE", "--refine-principal-point"], "--refine-principal-point acts only with --refine-intrinsics"),
        (["adjust", "HERE", "--mark-sigma", "2"], "--mark-sigma belongs to --control"),
        (["adjust", "PARTS", "-o", "OUT", "--protocol", "OUT"], "--protocol is for whole scenes"),
        (["adjust", "PARTS", "-o", "OUT", "--keep-suspects"], "--keep-suspects is for whole scenes"),
        (["map", "HERE", "-o", "OUT", "--model", "HERE", "--mapper", "global"], "--mapper acts only without --model"),
        (["localize", "HERE", "HERE", "-o", "OUT", "--no-lines", "--min-length", "20"], "--min-length acts only with"),
        (["track", "HERE", "-o", "OUT", "--camera-model", "PINHOLE"], "belong together"),
        (["track", "HERE", "-o", "OUT", "--camera", "x", "--camera-model", "PINHOLE", "--camera-params", "1,1,1,1"],
         "exclude each other"),
        (["align", "HERE", "HERE", "--crs", "utm"], "--crs belongs to --positions or --control"),
        (["localize", "HERE", "HERE", "-o", "OUT", "--calibration", "map", "--camera-model", "PINHOLE"],
         "--calibration acts only without --camera-model"),
        (["evaluate", "lines", "HERE", "--silhouettes", "HERE", "--align"], "--align acts only with a reference"),
        (["evaluate", "lines", "HERE", "--silhouettes", "HERE", "--threshold", "1"], "--threshold acts only with a"),
        (["evaluate", "trajectory", "TRACK", "TRACK", "--times", "TRACK"], "--times acts only on a REF without times"),
        (["selfcheck", "--runs", "3"], "--runs acts only with --nees"),
        (["view", "HERE", "--live", "--images", "HERE"], "--images acts only without --live"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)  # fmt: skip
def test_options_that_would_do_nothing_are_refused(arguments, words, tmp_path, capsys):
    places = {"HERE": tmp_path, "OUT": tmp_path / "out", "PARTS": tmp_path / "parts"}
    places["PARTS"].mkdir()
    (places["PARTS"] / "part-00000.npz").write_text("")
    places["TRACK"] = tmp_path / "track.txt"
    places["TRACK"].write_text("5 0 0 0 0 0 0 1\n")
    assert run([str(places.get(word, word)) for word in arguments]) == 1
    assert words in capsys.readouterr().err


def test_no_color_may_be_said_before_or_after_the_command(monkeypatch, tmp_path):
    for number, arguments in enumerate((["--no-color", "synth"], ["synth", "--no-color"])):
        monkeypatch.setenv("NO_COLOR", "")
        assert run([*arguments, "-n", "3", "-o", str(tmp_path / str(number))]) == 0
        assert os.environ["NO_COLOR"] == "1"
