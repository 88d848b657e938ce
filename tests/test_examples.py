# SPDX-License-Identifier: BSD-3-Clause
"""Every example runs to its end, in an empty folder and again; the first one is the code of the README."""

import runpy
from pathlib import Path

import pytest

from groma.factors import contract

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


@pytest.mark.parametrize("path", EXAMPLES, ids=[path.stem for path in EXAMPLES])
def test_example_runs(path, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(contract, "_REGISTRY", dict(contract._REGISTRY))  # forget factors of its own
    for _ in range(2):
        runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out


def test_the_readme_shows_the_first_example():
    code = EXAMPLES[0].read_text(encoding="utf-8").split("# --- example\n")[1]
    assert code in (ROOT / "README.md").read_text(encoding="utf-8")
