# SPDX-License-Identifier: BSD-3-Clause
"""The benchmark of lines: what is kept, its curve, and the picture."""

import importlib
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"


@pytest.fixture
def lines(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    for name in ("lines", "_line_curves", "_line_scenes", "_workshop", "detectors"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("lines")


def test_a_curve_runs_from_all_lines_to_the_sure_ones(lines):
    """Of three lines two lie on the edges, and the wrong one is doubtful."""
    edges = np.array([[[0.0, 0, 0], [1, 0, 0]], [[0, 1, 0], [1, 1, 0]]])
    ends = np.concatenate([edges, [[[0.0, 5, 0], [2, 5, 0]]]])
    source = lines.LineScene("made", None, [], edges, [0.01, 0.1])
    track = np.array([[0, 0, 0], [0, 1, 0], [1, 0, 1], [1, 1, 1], [1, 2, 1], [2, 0, 2], [2, 1, 2], [2, 2, 3]])
    found = lines.LineSet("groma, all", "all", ends, track, sure=np.array([0.9, 0.6, 0.2]))
    curve = {point["at_least"]: point for point in lines.curve_of(source, found)}
    assert curve[0.0]["num_lines"] == 3 and curve[0.5]["num_lines"] == 2 and curve[0.8]["num_lines"] == 1
    assert curve[0.0]["precision_count"][0] == pytest.approx(2 / 3)
    assert curve[0.0]["precision_length"][0] == pytest.approx(0.5)
    assert curve[0.5]["precision_count"] == [1.0, 1.0] and curve[0.5]["recall_length"] == [1.0, 1.0]
    assert curve[0.8]["recall_length"][0] == pytest.approx(0.5)
    assert max(curve) == 0.9
    theirs = lines.LineSet("LIMAP 2, refined", "all", ends, track)
    assert [(point["at_least"], point["num_lines"]) for point in lines.curve_of(source, theirs)] == [(3, 2)]


def test_lines_that_are_kept_keep_their_tracks(lines):
    track = np.array([[0, 4, 7], [1, 4, 8], [2, 5, 9], [2, 6, 1]])
    every = lines.LineSet("groma, all", "all", np.arange(18.0).reshape(3, 2, 3), track, sure=np.array([0.1, 0.7, 0.9]))
    kept = every.keep(every.sure >= 0.5)
    assert kept.ends.tolist() == every.ends[1:].tolist() and kept.sure.tolist() == [0.7, 0.9]
    assert kept.track.tolist() == [[0, 4, 8], [1, 5, 9], [1, 6, 1]]


def test_the_picture_has_a_curve_for_each_program(lines):
    point = {"at_least": 0.5, "num_lines": 3, "recall_length": [0.2, 0.5], "precision_count": [0.9, 1.0]}
    point["precision_length"] = [0.8, 0.9]
    rows = [{"contestant": name, "curve": [point, point]} for name in ("groma, all", "LIMAP 2.0.0, refined")]
    rows += [{"contestant": "groma"}, {"contestant": "groma, selective, all", "curve": [point]}]
    drawn = ET.fromstring(lines.drawing([{"scene": "a < b", "rows": rows}]))
    name = "{http://www.w3.org/2000/svg}"
    curves = [path for path in drawn.iter(f"{name}path") if path.get("d").count("L") and path.get("stroke")]
    assert len(curves) == 4 and {path.get("stroke-dasharray") for path in curves} == {"", "5 4"}
    assert any(text.text == "a < b" for text in drawn.iter(f"{name}text"))
    assert len([*drawn.iter(f"{name}circle")]) == 4


def test_scenes_are_listed_or_made_of_a_kind_and_a_seed(lines):
    assert all(
        lines.UNSEEN.fullmatch(name) for name in ("stairs-3103", "boxes-1", "room-2", "wings-3", "gable-4", "tower-5")
    )
    assert not any(lines.UNSEEN.fullmatch(name) for name in (*lines.SCENES, "stairs", "spire-3", "stairs-3-4"))


def test_the_cabinet_is_scored_for_the_table_of_detectors(lines):
    """Its start has no lines: none of twelve edges is found, and nothing fails."""
    detectors = importlib.import_module("detectors")
    start = detectors.read_scene(detectors.folder() / "model")
    row = detectors.compared(lines.LineScene("cabinet", start, []), start)
    assert row == {"lines": 0, "found": [0.0], "right": [0.0]}
