# SPDX-License-Identifier: BSD-3-Clause
"""The command line as a whole: help, version, usage errors, exit codes of known errors and of Ctrl-C."""

import errno
import os
import subprocess
import sys
import warnings

import pytest

from groma.cli.app import app
from groma.cli.main import run
from groma.cli.shared.console import Console
from groma.cli.shared.guard import guard
from groma.errors import InputError, OutputError

COMMANDS = [[command.name] for command in app.registered_commands] + [["evaluate", "poses"]]


@pytest.mark.parametrize("columns", ["60", "80", "120"])
@pytest.mark.parametrize("command", [[], ["evaluate"], *COMMANDS], ids=" ".join)
def test_help(command, columns, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", columns)
    assert run([*command, "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Usage: groma") and max(map(len, lines)) <= int(columns)
    assert not any(line.endswith("-") for line in lines)  # no name of an option is broken


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
@pytest.mark.parametrize("option", ["--json", "--quiet", "--verbose", "--threads", "--force"])
def test_every_command_has_the_common_options(command, option, capsys):
    run([*command, "--help"])
    assert option in capsys.readouterr().out


@pytest.mark.parametrize("command", [*COMMANDS, ["evaluate", "lines"]], ids=" ".join)
def test_every_command_takes_a_seed(command):
    """Drawn or not: a script passes it to all of them."""
    assert run([*command, "--seed", "1", "--help"]) == 0


def test_the_list_of_commands_is_not_cut_off(capsys):
    for words in ([], ["evaluate"]):
        assert run([*words, "--help"]) == 0
        assert "..." not in capsys.readouterr().out.split("Commands:")[1]


def test_version(capsys):
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("groma 0.")


@pytest.mark.parametrize(
    "arguments",
    [
        ["no-such-command"],
        ["adjust"],
        ["adjust", "x", "--no-such-option"],
        ["adjust", "x", "--linear-solver", "magic"],
        ["adjust", "x", "--threads", "0"],
        ["adjust", "x", "--max-iterations", "-1"],
        ["synth"],
        ["synth", "-o", "x", "--seed", "-1"],
        ["synth", "-o", "x", "-n", "99999999999999999999"],
        ["adjust", "x", "--seed", "-1"],
        ["evaluate", "poses", "only-one"],
    ],
    ids=" ".join,
)
def test_wrong_usage_is_exit_code_2(arguments, capsys):
    assert run(arguments) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "where"),
    [
        (["adjust", ""], "a value is empty"),
        (["adjust", "x", "-o", ""], "a value for '-o' is empty"),
        (["adjust", "x", "--output="], "a value for '--output' is empty"),
        (["map", "", "-o", "out"], "a value is empty"),
        (["evaluate", "poses", "a", ""], "a value is empty"),
    ],
    ids=str,
)
def test_an_empty_name_is_not_the_folder_one_is_in(arguments, where, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run(arguments) == 2
    assert f"Error: Invalid value: {where}. Is a variable of the shell not set?" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["merge", "/", "b", "-o", "out"], "/ holds no COLMAP model"),
        (["merge", "text.txt", "b", "-o", "out"], "text.txt is not a scene"),
        (["merge", "b", "./b", "-o", "out"], "A and B are the same map, b"),
        (["adjust", "empty"], "; it is empty."),
        (["adjust", "b", "-o", "text.txt/out"], "text.txt is a file. Choose another place."),
        (["evaluate", "trajectory", "b", "text.txt"], "Cannot read b: it is a folder. Pass the file in it."),
        (["evaluate", "lines", "text.txt", "text.txt"], "Line 1: expected X1 Y1 Z1 X2 Y2 Z2 in every line"),
        (["synth", "-n", "2", "--noise", "inf", "-o", "out"], "noise_px must be a standard deviation"),
    ],
    ids=str,
)
def test_what_cannot_be_meant_is_told_in_one_line(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "b").mkdir()
    (tmp_path / "text.txt").write_text("hello world\n")
    (tmp_path / "empty").touch()
    assert run(arguments) == 1
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1


@pytest.mark.parametrize(
    ("error", "code", "words"),
    [
        (InputError("expected this,\ngot that."), 1, "groma: expected this, got that."),
        (OutputError("cannot write."), 1, "groma: cannot write."),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "a.txt"), 1, "groma: a.txt: No such file"),
        (MemoryError(), 1, "memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_known_errors_are_one_line(error, code, words, capsys):
    def command() -> None:
        raise error

    with pytest.raises(BaseException) as caught:
        guard(command)()
    assert caught.value.exit_code == code
    text = capsys.readouterr().err
    assert words in text
    assert text.count("\n") == 1


def test_no_standard_output_at_all(monkeypatch):
    """As with ``groma ... >&-``: what would be said is lost, and nothing else."""
    monkeypatch.setattr("sys.stdout", None)
    guard(lambda: print("said"))()


def test_names_that_the_terminal_cannot_show(tmp_path):
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    program = "from groma.cli.main import main; main()"
    arguments = [sys.executable, "-c", program, "adjust", str(tmp_path / "Brücke"), "--loss", "日本"]
    finished = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=300)
    assert finished.returncode == 1
    assert finished.stderr.startswith("groma: Cannot read ") and finished.stderr.count("\n") == 1
    assert "Br\\xfccke" in finished.stderr


def test_our_own_errors_keep_their_traceback():
    def command() -> None:
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        guard(command)()


@pytest.mark.parametrize("quiet", [False, True])
def test_warnings_of_the_library_are_lines(capsys, quiet):
    @guard
    def command(console: Console) -> None:
        warnings.warn("2 lines were left out.", stacklevel=2)
        warnings.warn("for developers", DeprecationWarning, stacklevel=2)

    with warnings.catch_warnings():
        warnings.simplefilter("default")
        command(console=Console(quiet, False, None))
    assert capsys.readouterr().err == ("" if quiet else "warning: 2 lines were left out.\n")


def test_long_help_has_headings_and_what_every_command_takes_comes_last(capsys):
    assert run(["map", "--help"]) == 0
    said = capsys.readouterr().out
    headings = [line[:-1] for line in said.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings[:3] == ["Arguments", "Options", "Cameras and poses"] and headings[-1] == "General"
    assert said.index("Measurements:") < said.index("--positions") < said.index("Depth maps:")
    assert said.index("General:") < said.index("--no-color") < said.index("--help", said.index("--no-color"))


@pytest.mark.parametrize(
    ("command", "usage"),
    [
        ("synth", "[OPTIONS] -o OUT"),
        ("align", "[OPTIONS] INPUT [REFERENCE]"),
        ("localize", "[OPTIONS] MAP QUERIES... -o OUT"),
        ("warmup", "[OPTIONS] [PART...]"),
    ],
)
def test_the_usage_names_all_that_must_be_given_and_brackets_what_may_be(command, usage, capsys):
    assert run([command, "--help"]) == 0
    assert capsys.readouterr().out.splitlines()[0] == f"Usage: groma {command} {usage}"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--max-iterations", "1.5"], "must be a whole number."),
        (["--max-iterations", "-3"], "must be 0 or more."),
        (["--mark-sigma", "much"], "must be a number."),
        (["--keep", "alwys"], "'alwys' is not one of 'auto', 'always', 'never'. Did you mean 'always'?"),
    ],
    ids=" ".join,
)
def test_a_wrong_value_is_told_in_plain_words(words, said, capsys):
    assert run(["adjust", "x", *words]) == 2
    assert capsys.readouterr().err.endswith(f"Error: Invalid value for '{words[0]}': {said}\n")
