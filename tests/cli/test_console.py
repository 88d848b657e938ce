# SPDX-License-Identifier: BSD-3-Clause
"""What commands show: counted stages, bars that fit, a line now and then in a pipe, tables, colours where wanted."""

import os
import re
import sys
from types import SimpleNamespace

import pytest

from groma._counted import duration
from groma.cli.main import run
from groma.cli.shared import progress as _progress
from groma.cli.shared import style
from groma.cli.shared.console import Console
from groma.cli.shared.progress import Plan, parts_done, screen_line


def be_terminal(monkeypatch):
    """A terminal of 80 columns, without colours."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(style.shutil, "get_terminal_size", lambda: os.terminal_size((80, 24)))
    monkeypatch.setenv("NO_COLOR", "1")


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "0 s"), (59.4, "59 s"), (125, "2 min 5 s"), (3600, "1 h 0 min"), (11_430, "3 h 10 min")],
)
def test_lengths_of_time(seconds, words):
    assert duration(seconds) == words


def test_parts_and_the_time_left():
    assert parts_done("finding lines", 0, 1, 5.0) == ""
    assert parts_done("finding lines", 25, 100, 10.0) == "25/100, 30 s left"
    assert parts_done("finding lines", 25, 100, 0.5) == "25/100"
    assert parts_done("finding lines", 100, 100, 10.0) == "100/100"
    assert parts_done("tracking frame", 1234, 0, 10.0) == "1,234"  # how many there are is not known
    assert parts_done("adjusting points", 7, 50, 10.0) == "step 7 of at most 50"  # it ends when it has converged


def test_the_time_left_leaves_out_what_was_compiled(monkeypatch):
    """Ten parts of two seconds; the first and the fourth wait for a minute until a function is compiled."""
    now, said = [0.0], []
    counts = SimpleNamespace(missed=0, compiled=0, unsaved=0)
    monkeypatch.setitem(sys.modules, "groma._kernels.cache", SimpleNamespace(counts=counts))
    monkeypatch.setattr(_progress.time, "perf_counter", lambda: now[0])
    stages = Console(False, False, None).stages()
    monkeypatch.setattr(stages, "_show", lambda label, parts, share: said.append(parts))
    stages("finding lines", 0, 10)
    for done in range(1, 11):
        now[0] += 2.0
        if done in (1, 4):
            now[0] += 60.0
            counts.missed += 1
        stages("finding lines", done, 10)
    assert said == [
        "0/10", "1/10", "2/10, 16 s left", "3/10, 14 s left", "4/10", "5/10, 10 s left",
        "6/10, 8 s left", "7/10, 6 s left", "8/10, 4 s left", "9/10, 2 s left", "10/10",
    ]  # fmt: skip


@pytest.mark.parametrize("width", [30, 60, 80, 120])
@pytest.mark.parametrize("name", ["finding lines", "looking for photographs of the second map in the first"])
def test_the_line_fits_whatever_the_width(width, name, monkeypatch):
    monkeypatch.setenv("NO_COLOR", "1")
    line = screen_line(f"stage 10 of 17: {name}", "25/100, 30 s left", 0.25, width)
    assert len(line) < width
    bar = re.search(r"\[(#*)(\.*)\]", line)
    assert (bar is not None) == (width >= len(f"  stage 10 of 17: {name}  []  25/100, 30 s left") + 7)
    assert bar is None or len(bar[1]) == (len(bar[1]) + len(bar[2])) // 4


def test_stages_are_counted_by_what_was_announced():
    plan = Plan(["checking", "lines", "joint", "lines", "writing"])
    assert plan.label("checking") == "stage 1 of 5: checking"
    assert plan.label("lines") == "stage 2 of 5: lines"
    assert plan.label("joint") == "stage 3 of 5: joint"
    assert plan.label("lines") == "stage 4 of 5: lines"
    assert plan.label("joint") == "stage 3 of 5, round 2: joint"
    assert plan.label("lines") == "stage 4 of 5, round 2: lines"
    assert plan.label("something else") == "something else"
    assert plan.label("writing") == "stage 5 of 5: writing"


def test_a_stage_that_was_kept_is_passed_over():
    plan = Plan(["checking", "lines", "joint", "lines", "writing"])
    assert plan.label("joint") == "stage 3 of 5: joint"
    assert plan.label("lines") == "stage 4 of 5: lines"


def test_on_a_terminal_the_line_is_as_wide_as_it_and_vanishes(monkeypatch, capsys):
    be_terminal(monkeypatch)
    console = Console(False, False, None)
    console.expect_stages("first", "a stage with a name")
    with console.stages() as stages:
        stages("a stage with a name", 1, 2)
    said = capsys.readouterr().err
    assert said == "\r\x1b[K  stage 2 of 2: a stage with a name  [##########..........]  1/2\r\x1b[K"


def test_a_terminal_that_cannot_rewrite_a_line_gets_none(monkeypatch, capsys):
    be_terminal(monkeypatch)
    monkeypatch.setenv("TERM", "dumb")
    with Console(False, False, None).stages() as stages:
        stages("finding lines", 1, 2)
    assert capsys.readouterr().err == ""


def test_a_line_too_narrow_for_all_says_how_far_and_leaves_out_the_time():
    assert screen_line("finding lines", "25/100, 30 s left", 0.25, 30) == "  finding lines  25/100"


def test_verbose_leaves_a_line_for_every_stage_with_its_time(capsys):
    with Console(False, True, None).stages() as stages:
        stages("first", 0, 1)
        stages("second", 0, 1)
    assert [line.split(":")[0].strip() for line in capsys.readouterr().out.splitlines()] == ["first", "second"]


def test_in_a_pipe_a_line_comes_every_ten_seconds(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr(_progress.time, "monotonic", lambda: now[0])
    console = Console(False, False, None)
    console.expect_stages("finding lines", "others")
    with console.stages() as stages:
        for step in range(26):
            now[0] = 100.0 + step
            stages("finding lines", step, 50)
    said = capsys.readouterr().err
    assert said.splitlines() == [f"  stage 1 of 2: finding lines  {done}/50" for done in (10, 20)]
    assert "\r" not in said and "\x1b" not in said


def test_quiet_shows_nothing(monkeypatch, capsys):
    be_terminal(monkeypatch)
    monkeypatch.setattr(_progress, "PAUSE", 0.0)
    console = Console(True, False, None)
    with console.stages() as stages:
        stages("finding lines", 1, 2)
    console.say("a sentence")
    console.table(("", "number"), [["points", "3"]])
    console.warn("odd")
    console.wrote("out")
    said = capsys.readouterr()
    assert said.out == said.err == ""


def test_tables_are_aligned_and_leave_out_what_nothing_has(capsys):
    rows = [["points", "1,200", "", "0.5 px"], ["lines", "42", "", ""]]
    Console(False, False, None).table(("", "number", "nothing", "error"), rows)
    assert capsys.readouterr().out.splitlines() == [
        "          number   error",
        "  points   1,200  0.5 px",
        "  lines       42",
    ]


def test_the_header_of_a_table_that_is_too_wide_is_broken_into_few_lines():
    header, row = ("", "length found", "for 90 % right"), ["points", "1.25", "3.0 %"]
    assert style.aligned(header, [row]) == style.aligned(header, [row], 38)
    two = ["          length   for 90", "           found  % right"]
    three = ["                    for", "          length   90 %", "           found  right"]
    for width, top in [(37, two), (25, two), (24, three), (5, three)]:  # narrower than 23 it cannot be
        heads, (line,) = style.aligned(header, [row], width)
        assert heads == top
        assert line.split() == ["points", "1.25", "3.0", "%"] and len(line) == max(map(len, heads))


def test_what_is_wrong_in_every_file_is_told_once(capsys):
    many = [f"{k:04d}.png has no right image." for k in range(37, 41)]
    few = [f"{k}.jpg cannot be read." for k in range(3)]
    Console(False, False, None).warn_of_all([*many, *few, "The map is in pieces."])
    expected = [f"{many[0]} The same of 3 others.", *few, "The map is in pieces."]
    assert capsys.readouterr().err.splitlines() == [f"warning: {text}" for text in expected]


def test_sentences_are_broken_between_words_on_a_terminal_only(monkeypatch, capsys):
    be_terminal(monkeypatch)
    sentence = "  some words, " * 12
    console = Console(False, False, None)
    console.say(sentence)
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) > 1 and max(map(len, lines)) <= 80
    assert " ".join(" ".join(lines).split()) == " ".join(sentence.split())
    monkeypatch.setattr(sys.stdout, "isatty", lambda: False, raising=False)
    console.say(sentence)
    assert capsys.readouterr().out == sentence + "\n"


def test_errors_are_broken_like_sentences_and_stay_one_line_in_a_pipe(monkeypatch, capsys, tmp_path):
    wrong = tmp_path / "notes.md"
    wrong.write_text("# Notes\n")
    assert run(["adjust", str(wrong)]) == 1
    (one,) = capsys.readouterr().err.splitlines()
    assert one.startswith("groma: ") and "it begins with '# Notes" in one
    be_terminal(monkeypatch)
    assert run(["adjust", str(wrong)]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) > 1 and " ".join(" ".join(lines).split()) == one
    assert all(len(line) <= 80 or str(wrong) in line for line in lines)


@pytest.mark.parametrize(
    ("environment", "is_terminal", "coloured"),
    [({}, True, True), ({"NO_COLOR": "1"}, True, False), ({"TERM": "dumb"}, True, False), ({}, False, False)],
    ids=["terminal", "NO_COLOR", "dumb", "pipe"],
)
def test_colours_are_for_terminals_where_nobody_asked_for_none(environment, is_terminal, coloured, monkeypatch, capsys):
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    for stream in (sys.stdout, sys.stderr):
        monkeypatch.setattr(stream, "isatty", lambda: is_terminal, raising=False)
    console = Console(False, False, None)
    console.table(("", "number"), [["points", "3"]])
    console.warn("odd")
    console.wrote("out")
    said = capsys.readouterr()
    assert ("\x1b[" in said.out) == ("\x1b[" in said.err) == coloured
    plain = re.sub(r"\x1b\[\d+m", "", said.out + said.err)
    assert plain == "          number\n  points       3\nWrote out\nwarning: odd\n"


@pytest.mark.parametrize(("own", "said"), [("", "Later runs start at once."), ("/tmp/groma-x", "NUMBA_CACHE_DIR")])
def test_compiling_is_announced_as_the_first_time_only_where_it_is_kept(own, said, monkeypatch, capsys):
    from groma._kernels import folder

    monkeypatch.setattr(folder, "_own", own)
    Console(False, False, None)._announce_compilation()
    assert said in capsys.readouterr().out


def test_a_percent_sign_stays_with_its_number():
    assert style.wrapped("of the points 12 % are left", 17) == style.wrapped("of the points 12 % are left", 20)
    assert style.wrapped("of the points ab 12 % left", 20) == "of the points ab\n  12 % left"
