# SPDX-License-Identifier: BSD-3-Clause
"""``groma demo`` and ``groma selfcheck``, as a newcomer runs them."""

import json
import os

import pytest

from groma.cli.main import run
from groma.io import read_scene


def test_demo(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(["demo"]) == 0
    assert f"Open {tmp_path / 'groma_demo' / 'report.html'}" in capsys.readouterr().out
    folder = tmp_path / "groma_demo"
    assert sorted(os.listdir(folder)) == ["adjusted.npz", "report.html", "report.json"]
    numbers = json.loads((folder / "report.json").read_text())
    assert (numbers["num_images"], numbers["num_points"], numbers["num_observations"]) == (16, 22106, 83718)
    # The published start, and the published minimum 1.80339e4 to four digits.
    assert numbers["initial_cost"] == pytest.approx(4.185660e6, rel=1e-6)
    assert numbers["final_cost"] <= 1.80340e4 * 1.0001
    assert read_scene(folder / "adjusted.npz").num_points == 22106
    assert run(["demo"]) == 1
    assert "--force" in capsys.readouterr().err
    assert run(["demo", "--force", "--quiet"]) == 0
    said = capsys.readouterr()
    assert said.out == said.err == ""


def test_selfcheck(capsys):
    assert run(["selfcheck", "--json", "-"]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)
    assert report["passed"] and len({row["factor"] for row in report["rows"]}) >= 15
    assert "0 failed" in said.err


@pytest.mark.shared
def test_selfcheck_against_reference_values(shared_golden, capsys):
    assert run(["selfcheck", "--golden", str(shared_golden)]) == 0
    assert "golden" in capsys.readouterr().out
