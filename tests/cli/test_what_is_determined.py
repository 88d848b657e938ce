# SPDX-License-Identifier: BSD-3-Clause
"""What ``groma adjust`` says about the certainty of its result: diagnosis, covariances, standard deviations."""

import base64
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import groma
from groma.adjustment.adjust import AdjustOptions
from groma.adjustment.report import why_steps_ran_out
from groma.cli.main import run
from groma.errors import ProblemError
from groma.io import read_scene, write_scene
from groma.scene import Relations

pytestmark = pytest.mark.kernels


@pytest.mark.compiled
def test_adjust_says_what_the_data_determine(scenes, here, capsys):
    arguments = ["adjust", str(scenes / "start.npz"), "--report", "p.html", "--json", "r.json", "--verbose"]
    assert run(arguments) == 0
    said = capsys.readouterr().out
    found = json.loads((here / "r.json").read_text())["diagnosis"]
    assert found["sentences"] and all(sentence in said for sentence in found["sentences"])
    assert "points" in found["observability"]
    page = (here / "p.html").read_text()
    assert "What the data determine" in page and "Relations" in page
    assert "point on plane:" in said and "rejected" in said


def test_problems_are_said_and_notes_are_not(scenes, here, capsys):
    """One point that is seen once: a problem, said without --verbose; --no-diagnosis says nothing."""
    scene = read_scene(scenes / "points.npz")
    seen = scene.point_observations
    once = np.flatnonzero(seen.point_idx == 0)[1:]
    keep = np.setdiff1d(np.arange(len(seen)), once)
    write_scene(scene.replace(point_observations=seen.take(keep)), here / "once.npz")
    assert run(["adjust", "once.npz", "--max-iterations", "2", "--json", "r.json"]) == 0
    said = capsys.readouterr().out
    findings = json.loads((here / "r.json").read_text())["diagnosis"]["findings"]
    assert any(finding["kind"] == "point_seen_once" for finding in findings)
    assert {finding["severity"] for finding in findings} > {"problem"}
    for finding in findings:
        assert (finding["sentence"] in said) == (finding["severity"] == "problem")
    assert run(["adjust", "once.npz", "--max-iterations", "2", "--no-diagnosis", "--json", "r.json", "-f"]) == 0
    assert json.loads((here / "r.json").read_text())["diagnosis"] is None
    assert "seen once" not in capsys.readouterr().out


def test_a_map_is_diagnosed_at_its_own_noise(scenes):
    """Twice the noise, twice as weak."""
    from groma.mapping.result import MapResult

    scene = read_scene(scenes / "truth.npz").replace(relations=Relations())  # these have a noise of their own
    weakness = []
    for sigma in (20.0, 10.0):
        told = AdjustOptions(point_sigma_px=sigma, line_sigma_px=sigma, loss_scale=6.0)
        report: Any = None  # of which nothing is asked
        result = MapResult(scene, scene, scene, scene, report, told, {}, "", {}, ())
        weakness.append(result.diagnose().weakness["points"])
    # The loss, which is twelve times as wide as the noise, takes hardly anything off residuals of half a pixel.
    np.testing.assert_allclose(weakness[0], 2 * weakness[1], rtol=1e-3)


def test_many_images_are_diagnosed_when_asked(scenes, here, capsys, monkeypatch):
    monkeypatch.setattr("groma.adjustment.diagnosis.MANY_IMAGES", 5)
    arguments = ["adjust", str(scenes / "points.npz"), "--max-iterations", "1", "-f", "--json", "r.json"]
    assert run([*arguments, "--verbose"]) == 0
    assert "--diagnosis asks for it" in capsys.readouterr().out
    assert json.loads((here / "r.json").read_text())["diagnosis"] is None
    assert run([*arguments, "--diagnosis"]) == 0
    assert json.loads((here / "r.json").read_text())["diagnosis"]["sentences"]


def test_a_diagnosis_that_fails_is_a_warning(scenes, here, capsys, monkeypatch):
    def fail(*_, **__):
        raise FloatingPointError("something odd")

    monkeypatch.setattr("groma.adjustment.diagnosis.diagnose_scene", fail)
    arguments = ["adjust", str(scenes / "points.npz"), "-o", "out.npz", "--max-iterations", "1", "--report", "p.html"]
    assert run(arguments) == 0
    assert "warning: The diagnosis failed: something odd" in capsys.readouterr().err
    assert read_scene(here / "out.npz").num_points > 0
    assert "What the data determine" not in (here / "p.html").read_text()


@pytest.mark.parametrize("gauge", ["inner", "held"])
def test_covariances_in_a_file(scenes, here, capsys, gauge):
    """Points alone are free: either gauge is possible, and angles and sizes are those of the library function."""
    arguments = ["adjust", str(scenes / "points.npz"), "--covariance-gauge", gauge, "--loss", "none", "-f"]
    assert run([*arguments, "--covariance", "c.npz", "-o", "out.npz", "--json", "r.json"]) == 0
    assert "Standard deviations" in capsys.readouterr().out
    scene = read_scene(here / "out.npz")
    with np.load(here / "c.npz", allow_pickle=False) as file:
        arrays = dict(file)
    assert str(arrays["gauge"]) == gauge
    assert arrays["image_names"].tolist() == list(scene.images.names)
    assert arrays["point_ids"].tolist() == scene.points.ids.tolist()
    expected = groma.uncertainty(scene, gauge=gauge)
    # The scene was written and read again; its last digits are not those of the problem.
    np.testing.assert_allclose(arrays["points"], expected.points, rtol=1e-6)
    np.testing.assert_allclose(arrays["centers"], expected.centers, rtol=1e-6, atol=1e-15)
    assert (np.abs(arrays["poses"][0]).max() == 0) == (gauge == "held")
    assert json.loads((here / "r.json").read_text())["uncertainty"]["gauge"] == gauge


@pytest.mark.compiled
def test_the_page_of_an_adjustment_knows_its_covariances(scenes, here):
    """As groma report --covariance puts them on a page; without --covariance there are none."""
    adjust = ["adjust", str(scenes / "points.npz"), "--quiet", "--max-iterations", "3"]
    assert run([*adjust, "-o", "out.npz", "--covariance", "c.npz", "--report", "with.html"]) == 0
    assert run([*adjust, "--report", "without.html"]) == 0
    assert run(["report", "out.npz", "--covariance", "c.npz", "-o", "later.html", "--quiet"]) == 0
    ours, none, later = (_data_of_page(here / f"{name}.html") for name in ("with", "without", "later"))
    assert none["covariances"] is None and ours["covariances"]["gauge"] == "inner"
    for kind in ("points", "centers"):
        values, expected = (np.frombuffer(base64.b64decode(one["covariances"][kind]), "<f4") for one in (ours, later))
        assert values.size and values.max() > 0
        np.testing.assert_allclose(values, expected, rtol=1e-5)


def _data_of_page(path):
    text = path.read_text(encoding="utf-8")
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def test_covariances_that_are_impossible_do_not_cost_the_result(scenes, here, capsys, monkeypatch):
    def fail(*_, **__):
        raise ProblemError("7 directions are not determined.")

    monkeypatch.setattr("groma.adjustment.uncertainty.uncertainty", fail)
    arguments = ["adjust", str(scenes / "points.npz"), "-o", "out.npz", "--covariance", "c.npz", "--json", "r.json"]
    assert run([*arguments, "--max-iterations", "1"]) == 1
    said = capsys.readouterr()
    assert "groma: 7 directions are not determined." in said.err and "Wrote out.npz" in said.out
    assert sorted(os.listdir(here)) == ["out.npz", "r.json"]


@pytest.mark.compiled
def test_standard_deviations_in_a_file(scenes, here):
    arguments = ["adjust", str(scenes / "start.npz"), "--quiet", "-f", "--covariance"]
    assert run([*arguments, "one.json"]) == 0 and run([*arguments, "two.json", "--sigma0", "2"]) == 0
    one, two = (json.loads((here / name).read_text()) for name in ("one.json", "two.json"))
    start = read_scene(scenes / "start.npz")
    assert one["gauge"] == "held"  # relations in lengths
    assert [image["name"] for image in one["images"]] == list(start.images.names)
    assert [point["id"] for point in one["points"]] == start.points.ids.tolist()
    assert len(one["lines"]) == start.num_lines and len(one["planes"]) == start.num_planes
    assert one["images"][0]["center"] == [0, 0, 0] and min(one["images"][1]["center"]) > 0
    assert two["points"][3]["position"] == pytest.approx([2 * value for value in one["points"][3]["position"]])
    assert two["lines"][2]["direction_deg"] == pytest.approx(2 * one["lines"][2]["direction_deg"])
    assert sorted(os.listdir(here)) == ["one.json", "two.json"]


def test_steps_that_run_out_along_what_is_open_say_so(here, capsys):
    """Three cameras with calibrations of their own and 19 observations: the steps follow a valley of calibrations."""
    source = str(Path(__file__).parents[1] / "data" / "bal" / "dubrovnik-3-7-pre.txt")
    assert run(["adjust", source, "--max-iterations", "30", "--json", "r.json", "--report", "p.html"]) == 0
    report = json.loads((here / "r.json").read_text())
    assert report["termination"] == "max_iterations"
    ran_out = [text for text in report["warnings"] if "ran out where cameras or calibrations are unobservable" in text]
    assert len(ran_out) == 1
    assert f"warning: {ran_out[0]}" in capsys.readouterr().err
    assert ran_out[0] in (here / "p.html").read_text()
    # Who asks for three steps gets three; and nothing is said where everything is determined.
    assert run(["adjust", source, "--max-iterations", "3", "--json", "-"]) == 0
    assert "ran out" not in str(json.loads(capsys.readouterr().out)["warnings"])
    slow = {
        "termination": "max_iterations",
        "history": report["history"],
        "diagnosis": {"num_unobservable_directions": 0},
    }
    assert why_steps_ran_out(slow) == []
    assert why_steps_ran_out(slow | {"diagnosis": {"num_unobservable_directions": 2}}) == ran_out
