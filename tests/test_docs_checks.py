# SPDX-License-Identifier: BSD-3-Clause
"""What the pages say can be done: their commands exist with their options, and their Python runs.

The page of corrections: its programs run, with several seeds, and every row of its tables has a check that passes for
the right form and not for the printed one.
"""

import re
import runpy
import shlex
import sys
from functools import cache
from pathlib import Path

import numpy.typing as npt
import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGE = DOCS / "maths" / "corrections.md"
TEXT = PAGE.read_text(encoding="utf-8")
BLOCKS = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
#: First cells of the rows of all tables, without heads and rules.
ROWS = [row for row in re.findall(r"^\| ([^|]+?) \|", TEXT, re.MULTILINE) if row != "eq."]

#: Lines of code, and pieces of sentences in backquotes, that call the command line.
COMMANDS = [
    (path.relative_to(ROOT).as_posix(), found)
    for path in [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
    for line in path.read_text(encoding="utf-8").splitlines()
    for found in re.findall(r"`(groma [^`]*)`", line) + re.findall(r"^(?:    |\$ )(?:\$ )?(groma [^#|&]*)", line)
]


@cache
def whole_command():
    import typer.main

    from groma.cli.app import app

    return typer.main.get_command(app)


def options_of(words: list[str]) -> tuple[str, set[str]]:
    """Return the command that words begin with, and its options."""
    command, name = whole_command(), "groma"
    for word in words:
        if not hasattr(command, "commands") or word.startswith("-"):
            break
        # As in "groma evaluate poses|lines EST REF".
        name, command = f"{name} {word}", command.commands[word.split("|")[0]]
    return name, {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}


def test_array_types_have_short_names_in_the_reference(monkeypatch):
    pytest.importorskip("sphinx")
    pytest.importorskip("myst_parser")
    monkeypatch.setenv("NUMBA_CACHE_DIR", "")  # the settings change both, for themselves
    monkeypatch.setattr(sys, "path", list(sys.path))
    settings = runpy.run_path(str(DOCS / "conf.py"))
    assert "members" not in settings["autodoc_default_options"]  # it would overrule what a page says of a module
    short = settings["_short"]
    pixels = "ndarray[tuple[Any, ...], dtype[uint8]]"
    deferred = "~numpy.ndarray[tuple[~typing.Any, ...], ~numpy.dtype[~numpy.float64]]"
    assert short(f"(image: {pixels} | None) -> {deferred}") == "(image: NDArray[uint8] | None) -> FloatArray"
    assert short("list[TypeAliasForwardRef('IntArray')]") == "list[IntArray]"
    written = pytest.importorskip("sphinx.util.typing").stringify_annotation
    assert short(f"{written(npt.ArrayLike, 'smart')} | None") == "ArrayLike | None"
    assert short("dict[str, float]") == "dict[str, float]"


def test_there_are_commands_in_the_pages():
    assert len(COMMANDS) > 40
    assert len({page for page, _ in COMMANDS}) > 8


@pytest.mark.parametrize(("page", "line"), COMMANDS, ids=[f"{page}: {line}" for page, line in COMMANDS])
def test_commands_of_the_pages_exist(page, line):
    words = [word.strip("[],") for word in shlex.split(line.replace("\\|", "|"))][1:]
    if (words and words[0].isupper()) or words in ([], ["--help"]):
        return  # as in "groma COMMAND --help"
    name, known = options_of(words)
    for word in words:
        if word.startswith("-") and word not in ("-", "--help"):
            assert word.split("=")[0] in known, f"{name} has no {word}"


@pytest.fixture(scope="module")
def start():
    from groma.scene import synthetic

    return synthetic.holistic(10, seed=1).start


@pytest.mark.parametrize("page", ["python.md", "uncertainty.md", "large-scenes.md", "evidence/uncertainty.md"])
def test_python_of_the_pages_runs(page, start, tmp_path, monkeypatch, capsys):
    """In a folder with a model, and with a scene at hand."""
    import groma

    monkeypatch.chdir(tmp_path)
    groma.write_scene(start, "model")
    namespace: dict = {"scene": start}
    blocks = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(encoding="utf-8"), re.DOTALL)
    for number, block in enumerate(blocks):
        exec(compile(block, f"{page}, block {number}", "exec"), namespace)
    assert blocks and capsys.readouterr().out


def run(seed: int) -> list[str]:
    """Run the programs of the page, one after the other in one namespace, and return what they checked."""
    namespace: dict = {}
    for number, block in enumerate(BLOCKS):
        block = block.replace("default_rng(0)", f"default_rng({seed})")
        exec(compile(block, f"{PAGE.name}, block {number}", "exec"), namespace)
    return namespace["checked"]


def test_every_row_is_checked_and_every_check_has_a_row():
    names = [name for row in ROWS for name in row.split(", ")]
    assert len(ROWS) >= 55
    assert set(run(0)) == set(names)


@pytest.mark.parametrize("seed", range(1, 13))
def test_corrections_hold(seed):
    run(seed)


@pytest.mark.parametrize(("right", "wrong"), [(1.0, 1.0), (2.0, 3.0)], ids=["both right", "both wrong"])
def test_a_check_can_fail(right, wrong):
    namespace: dict = {}
    exec(BLOCKS[0], namespace)
    namespace["check"]("a row", 1.0, 1.0, 2.0)
    with pytest.raises(AssertionError, match="a row"):
        namespace["check"]("a row", 1.0, right, wrong)


def _links(page):
    """The pages that a page leads to, by links and by its table of contents, from the folder of the pages."""
    text = page.read_text(encoding="utf-8")
    named = re.findall(r"\]\(([^)#:]+)[^)]*\)", text)
    for block in re.findall(r"```\{toctree\}\n(.*?)```", text, re.DOTALL):
        named += [line.strip() for line in block.splitlines() if line.strip() and not line.startswith(":")]
    found = set()
    for name in named:
        place = page.parent / name
        endings = [place.with_name(place.name + ending) for ending in ("", ".md", ".rst")]
        found |= {other.resolve() for other in endings if other.is_file()}
    return found


def test_ten_tasks_are_three_clicks_away():
    rows = re.findall(r"^\| ([^|]+) \| (.*\[.*) \|$", (DOCS / "tasks.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(rows) == 10
    for task, clicks in rows:
        path = [(DOCS / name).resolve() for name in re.findall(r"\]\(([^)]+)\)", clicks)]
        assert 1 <= len(path) <= 3, task
        for page, target in zip([DOCS / "index.md", *path], path, strict=False):
            assert target in _links(page), f"{task}: {page.name} does not lead to {target.name}"


def test_pictures_are_there_and_small():
    for page in [ROOT / "README.md", *DOCS.rglob("*.md")]:
        text = page.read_text(encoding="utf-8")
        for name in re.findall(r"!\[[^\]]*\]\(([^)]+)\)|\{image\} (\S+)", text):
            picture = page.parent / (name[0] or name[1])
            assert picture.is_file(), f"{page.name}: {picture.name}"
            assert picture.stat().st_size < 260_000, picture.name
