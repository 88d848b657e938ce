# SPDX-License-Identifier: BSD-3-Clause
"""``benchmarks/code_size.py`` counts what it says, on a house of two small files."""

import importlib
import subprocess
from pathlib import Path

import pytest

FOLDER = Path(__file__).resolve().parents[1] / "benchmarks"
GROMA = '''"""A house."""

__all__ = ["a", "b"]
'''
ROOM = '''"""A room."""
from groma.other._hidden import name
from groma._own import name

NEAR, FAR = 0.25, (3, -4.5)
NAMES = ("a",)


@dataclass
class ThingOptions:
    """Options."""

    #: A comment.
    size: float = 7.5
    name: str = "x"


class ThingGates:
    far: float = gate(3.0, "px", "far", "chosen on nothing")


def public(a, b, c, d, e, f, g, h, i, j):
    """Of two

    lines.
    """
    while a > 0.3:
        damping = 10.0 * damping
    return 0.7 * b


@loop
def _kernel(a, b, c, d, e, f, g, h, i, j):
    return -1.0
'''


@pytest.fixture
def code_size(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    return importlib.import_module("code_size")


def test_a_small_house(code_size, tmp_path):
    for name, text in (
        ("__init__", GROMA),
        ("room/__init__", '"""Room."""\n'),
        ("room/thing", ROOM),
        ("other/__init__", ""),
    ):
        path = tmp_path / "src" / "groma" / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    table = code_size.counts(tmp_path)
    assert table["files"] == 4 and table["functions"] == 2
    assert table["lines"] == len((GROMA + ROOM).splitlines()) + 1
    assert table["source lines"] == 1 + 4 + 4 + 2 + 4 + 3
    assert (table["largest room"], table["longest module"], table["longest function"]) == (2, len(ROOM.splitlines()), 4)
    assert table["repeated lines"] == 0
    assert table["private imports"] == 1 and table["optimiser loops"] == 1
    assert (table["many arguments"], table["many arguments, kernels"]) == (1, 1)
    # 0.25, 3, 4.5; 7.5; of the functions 0.3, 10.0 and 0.7; the gate stands apart
    assert [table[f"numbers, {kind}"] for kind in ("named", "defaults", "floats", "integers")] == [3, 1, 3, 0]
    assert (table["numbers without an origin"], table["gates with origin"]) == (7, 1)
    assert (table["public names, groma.__all__"], table["public names, all modules"]) == (2, 3)


def test_lines_that_stand_twice(code_size, tmp_path):
    """To the letter, in runs of six; imports and brackets are left out, and runs that overlap are not two."""
    body = "def f():\n" + "".join(f"    x = {k}\n" for k in range(8))
    house = {"first": f"from a import (\n    b,\n)\n{body}", "same": "x = 1\n" * 12}
    (tmp_path / "src" / "groma").mkdir(parents=True)
    for files, repeated in (
        (house, 6),
        ({"second": body}, 6 + 9),
        ({"third": body.replace("def f", "def g")}, 6 + 9 + 8),
        ({"fourth": body.replace("x = 4", "x = a")}, 6 + 9 + 8),
    ):
        for name, text in files.items():
            (tmp_path / "src" / "groma" / f"{name}.py").write_text(text)
        assert code_size.repeated_lines(code_size.modules_of(tmp_path)) == repeated


def test_a_commit_is_counted(code_size, tmp_path):
    room = tmp_path / "src" / "groma"
    room.mkdir(parents=True)
    (room / "__init__.py").write_text(GROMA)
    for words in (["init"], ["add", "."], ["-c", "user.name=a", "-c", "user.email=b", "commit", "-m", "c"]):
        subprocess.run(["git", "-C", str(tmp_path), *words], check=True, capture_output=True)
    (room / "thing.py").write_text(ROOM)
    before, after = code_size.counts_of("HEAD", tmp_path), code_size.counts(tmp_path)
    assert before.keys() == after.keys() and (before["files"], after["files"]) == (1, 2)


def test_what_a_commit_had_is_told_apart_from_what_is_new(code_size, tmp_path):
    def write(text):
        (tmp_path / "src" / "groma").mkdir(parents=True, exist_ok=True)
        (tmp_path / "src" / "groma" / "room.py").write_text(text)

    same = "def {}(a):\n    b = a + 1\n    return b * a\n"
    write(same.format("near") + same.format("far") + "def lost():\n    return None\n")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "one"]):
        subprocess.run([*git, *command], check=True)
    moved = same.format("_near").replace("    return", "    c = b\n    return")
    write(moved + same.format("remote") + "class New:\n    size = 1\n    weight = 2\n")
    rooms = code_size.kept_lines("HEAD", tmp_path)
    assert rooms == {"groma": {"then": 6, "now": 7, "new": 3}, "gone": {"then": 2}}
