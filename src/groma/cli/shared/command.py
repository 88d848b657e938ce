# SPDX-License-Identifier: BSD-3-Clause
"""Options of every command, completion of names and files, and suggestions for misspelled values."""

from __future__ import annotations

import functools
import inspect
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, get_args, get_type_hints

import typer
from typer.core import TyperCommand

from groma.cli.shared.console import Console
from groma.cli.shared.style import is_terminal, terminal_width, wrapped
from groma.errors import did_you_mean


def one_of(*names: str) -> Callable[[str], Sequence[str]]:
    """Return a completion by names; those of plugins are not included."""
    return lambda incomplete: [name for name in names if name.lower().startswith(incomplete.lower())]


class Panel(str):
    """A heading of ``--help``, which declares the options under it. Those without a heading come first."""

    def option(self, text: str, *flags: str, choices: Sequence[str] = (), **settings: Any) -> Any:
        """Declare an option with its help; ``--name`` of the argument unless flags say otherwise."""
        if choices:
            settings["autocompletion"] = one_of(*choices)
        return typer.Option(*flags, help=text, rich_help_panel=self or None, **settings)


#: Options of every command, and options without a heading.
GENERAL, PLAIN = Panel("General"), Panel("")
Json = Annotated[
    str | None,
    GENERAL.option("Write a machine-readable report to FILE; '-' is standard output.", "--json", metavar="FILE"),
]
Quiet = Annotated[bool, GENERAL.option("Show errors only.", "--quiet", "-q")]
Verbose = Annotated[bool, GENERAL.option("Show more details.", "--verbose", "-v")]
Threads = Annotated[
    int | None,
    GENERAL.option("Use at most N threads. Default: one per core, where that pays.", "--threads", min=1, metavar="N"),
]
NoColor = Annotated[bool, GENERAL.option("Use no colours; so does the environment variable NO_COLOR.", "--no-color")]
#: For commands without random numbers: accepted, so that a script can pass it to every command, but hidden.
NoSeed = Annotated[int, typer.Option("--seed", min=0, hidden=True)]


#: Stands for hyphens while help is wrapped: names of options are not broken.
_HYPHEN = "\u2011"


class Command(TyperCommand):
    """A command whose help has headings and which suggests the nearest choice for a misspelled value."""

    def collect_usage_pieces(self, ctx: Any) -> list[str]:
        """Return the usage after the name of the command: required parts and ``[optional ones]``."""
        pieces = ["[OPTIONS]"]
        for one in self.get_params(ctx):
            if one.param_type_name == "argument":
                name = (one.metavar or str(one.name)) + ("..." if one.nargs != 1 else "")
                pieces.append(name if one.required else f"[{name}]")
            elif one.required:
                pieces.append(f"{min(one.opts, key=len)} {one.metavar}")
        return pieces

    def get_help(self, ctx: Any) -> str:
        """Return the help, wrapped at spaces alone."""
        return super().get_help(ctx).replace(_HYPHEN, "-")

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write the options under their headings, in order of first appearance."""
        sections: dict[str, list[tuple[str, str]]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx)
            if record is not None:
                name, text = record
                if parameter.param_type_name == "argument":
                    name = parameter.metavar or str(parameter.name)  # the help says what kind of value
                name = re.sub(r"[<\[]([\w|]+)[>\]]$", r"\1", name)  # choices: one|another
                sections.setdefault(_heading(parameter), []).append((name, text.replace("-", _HYPHEN)))
        for heading, records in sections.items():
            if records:
                with formatter.section(heading):
                    formatter.write_dl(records)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse as usual, but refuse empty values: an empty path would mean the current folder."""
        for before, word in zip(["", *args], args, strict=False):
            option, _, value = word.partition("=") if word.startswith("--") else (before, "", word)
            if not value and (word.endswith("=") or not word):
                where = f" for {option!r}" if option.startswith("-") else ""
                raise typer.BadParameter(f"a value{where} is empty. Is a variable of the shell not set?", ctx=ctx)
        try:
            return super().parse_args(ctx, args)
        except Exception as error:  # wrong usage: a class of Click or of Typer, depending on the version
            if isinstance(error, typer.BadParameter):
                error.message = _in_plain_words(error.message)
            if is_terminal(sys.stderr):
                _break_message(error)
            raise


def _break_message(error: Any) -> None:
    """Wrap the message of a usage error for a terminal; other errors stay as they are."""
    if hasattr(error, "format_message"):
        message = wrapped(f"Error: {error.format_message()}", terminal_width()).removeprefix("Error: ")
        error.format_message = lambda: message


#: Typer's messages about invalid values, before and since 0.29, and those of groma.
_PLAIN = (
    (r".* is not a valid int.*", "must be a whole number."),
    (r".* is not a valid float.*", "must be a number."),
    (r".* is not in the range \w>=(\S+)\.", r"must be \1 or more."),
    (r".* is not in the range \w<=(\S+)\.", r"must be \1 or less."),
    (r".* is not in the range (\S+)<=\w<=(\S+)\.", r"must be from \1 to \2."),
    (r"Value error, ", ""),
    (r"Input should be a valid integer.*", "must be a whole number."),
    (r"Input should be a valid number.*", "must be a number."),
    (r"Input should be greater than or equal to (\S+)", r"must be \1 or more."),
    (r"Input should be less than or equal to (\S+)", r"must be \1 or less."),
)


def _in_plain_words(message: str) -> str:
    """Return the message in plain words, with the nearest choice."""
    for words, plain in _PLAIN:
        message = re.sub(f"^{words}", plain, message)
    named, among, choices = message.partition("is not one of")
    if among:
        (value, *_), choices = re.findall(r"'([^']*)'", named) or [""], re.findall(r"[\w-]+", choices)
        message += did_you_mean(value, choices)
    return message


def _heading(parameter: Any) -> str:
    if parameter.param_type_name == "argument":
        return "Arguments"
    default = GENERAL if parameter.name == "help" else "Options"
    return getattr(parameter, "rich_help_panel", None) or default


def console_of(
    threads: Threads = None, json_target: Json = None, quiet: Quiet = False, verbose: Verbose = False,
    no_color: NoColor = False, seed: NoSeed = 0,
) -> Console:  # fmt: skip
    """Return the console for the options of every command."""
    forbid_colours(no_color)
    return Console(quiet, verbose, json_target, threads)


def with_common_options(command: Callable[..., None]) -> Callable[..., None]:
    """Add a console and the options of :func:`console_of` to a command, and completion of files by the shell.

    A parameter that is a dataclass is replaced by the options that its fields declare. An option that the command
    declares, too, is passed to both.
    """
    own, every = inspect.signature(command, eval_str=True), inspect.signature(console_of, eval_str=True).parameters
    common = {name: one for name, one in every.items() if name not in own.parameters}
    groups: dict[str, Any] = {
        name: one.annotation for name, one in own.parameters.items() if is_dataclass(one.annotation)
    }
    listed = [
        one
        for name, parameter in own.parameters.items()
        for one in (_declared(groups[name], own.parameters) if name in groups else [parameter])
        if name != "console"
    ]
    for parameter in listed:
        kind, *infos = get_args(parameter.annotation) or (parameter.annotation,)
        if Path in (kind, *get_args(kind)) and infos and infos[0].autocompletion is None:
            infos[0].autocompletion = left_to_shell

    @functools.wraps(command)
    def prepared(**options: Any) -> None:
        console = console_of(**{name: options.pop(name) for name in common})
        made = {name: kind(**{item.name: options[item.name] for item in fields(kind)}) for name, kind in groups.items()}
        command(console=console, **{name: value for name, value in options.items() if name in own.parameters}, **made)

    parameters = [one.replace(kind=inspect.Parameter.KEYWORD_ONLY) for one in (*listed, *common.values())]
    prepared.__signature__ = own.replace(parameters=parameters)  # type: ignore[attr-defined]
    prepared.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return prepared


def _declared(group: type[Any], own: Mapping[str, inspect.Parameter]) -> list[inspect.Parameter]:
    """Return the options declared by the fields of a dataclass, except those that the command declares."""
    kinds = get_type_hints(group, include_extras=True)
    return [
        inspect.Parameter(item.name, inspect.Parameter.KEYWORD_ONLY, default=item.default, annotation=kinds[item.name])
        for item in fields(group)
        if item.name not in own
    ]


def forbid_colours(wanted: bool) -> None:
    """If set, disable colours in this process and its children."""
    if wanted:
        os.environ["NO_COLOR"] = "1"


def left_to_shell(incomplete: str) -> list[str]:
    """Complete nothing, so that the shell completes files."""
    return []


#: Choices of options without plugins; tests compare them with the registries, which take a second to import.
LOSSES = "auto none huber soft_l1 cauchy tukey geman_mcclure barron truncated".split()
LINEAR_SOLVERS = "auto dense sparse pcg".split()
LINE_CHARTS = "cartesian orthonormal_left orthonormal_right free_left free_right".split()
GAUGES = "auto free first_camera".split()
CAMERA_MODELS = (
    "SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV FULL_OPENCV OPENCV_FISHEYE SIMPLE_RADIAL_FISHEYE "
    "RADIAL_FISHEYE THIN_PRISM_FISHEYE RAD_TAN_THIN_PRISM_FISHEYE FOV SIMPLE_FISHEYE FISHEYE SIMPLE_DIVISION DIVISION "
    "EUCM EQUIRECTANGULAR"
).split()
DETECTORS, MATCHERS = ["lsd"], ["wide_baseline", "flow"]
MAPPERS, CALIBRATIONS = ["incremental", "global"], ["auto", "map", "exif", "unknown"]
SEQUENCES, COMPILED = ["rgbd", "stereo", "mono"], ["adjust", "map", "track"]
