# SPDX-License-Identifier: BSD-3-Clause
"""Progress: a line that rewrites itself on a terminal, a line now and then in a pipe, nothing with --quiet."""

import os
import sys

import pytest

from groma.cli.shared import console as _console
from groma.cli.shared.console import Console, say_seconds, stage_line


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "0 s"), (59.4, "59 s"), (125, "2 min 5 s"), (3600, "1 h 0 min"), (11_430, "3 h 10 min")],
)
def test_lengths_of_time(seconds, words):
    assert say_seconds(seconds) == words


def test_a_stage_with_parts_has_a_bar_and_the_time_left():
    assert stage_line(3, "finding lines", 0, 1, 5.0) == " 3. finding lines"
    assert (
        stage_line(3, "finding lines", 25, 100, 10.0) == " 3. finding lines  [#####...............] 25/100, 30 s left"
    )
    assert stage_line(3, "finding lines", 100, 100, 10.0).endswith("[####################] 100/100")
    assert "left" not in stage_line(3, "finding lines", 0, 100, 10.0)


def test_on_a_terminal_the_line_is_as_wide_as_it_and_vanishes(monkeypatch, capsys):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    monkeypatch.setattr(_console.shutil, "get_terminal_size", lambda: os.terminal_size((30, 24)))
    with Console(False, False, None).stages() as stages:
        stages("a stage with a name that is too long for this terminal", 1, 2)
    said = capsys.readouterr().err
    shown = said.split("\x1b[K")
    assert shown[0] == "\r" and len(shown[1].rstrip("\r")) <= 30
    assert said.endswith("\r\x1b[K")


def test_in_a_pipe_a_line_comes_every_ten_seconds(monkeypatch, capsys):
    now = [100.0]
    monkeypatch.setattr(_console.time, "monotonic", lambda: now[0])
    with Console(False, False, None).stages() as stages:
        for step in range(26):
            now[0] = 100.0 + step
            stages("finding lines", step, 50)
    said = capsys.readouterr().err
    assert [line.split()[-1] for line in said.splitlines()] == ["10/50", "20/50"]
    assert "\r" not in said and "\x1b" not in said


def test_quiet_shows_nothing(monkeypatch, capsys):
    monkeypatch.setattr(_console, "PAUSE", 0.0)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with Console(True, False, None).stages() as stages:
        stages("finding lines", 1, 2)
    assert capsys.readouterr().err == ""
