# SPDX-License-Identifier: BSD-3-Clause
"""The application and its commands, each defined in the file of its name."""

from collections.abc import Callable
from typing import Annotated

import typer

import groma
from groma.cli.commands import (
    adjust,
    align,
    convert,
    demo,
    evaluate,
    localize,
    map,
    merge,
    report,
    selfcheck,
    synth,
    track,
    view,
    warmup,
)
from groma.cli.shared.command import Command, NoColor, forbid_colours, with_common_options
from groma.cli.shared.guard import guard

app = typer.Typer(
    name="groma",
    help="Reconstruct and adjust scenes made of points, lines and planes.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
)
#: Name, function, and summary for the list of ``groma --help``; the docstring is the full help of a command.
_Commands = tuple[tuple[str, Callable[..., None], str], ...]
_COMMANDS: _Commands = (
    ("demo", demo.demo, "Map the photographs included in groma: start here."),
    ("map", map.map_, "Map photographs: points, lines, planes and poses."),
    ("track", track.track, "Track a camera through a sequence and map the scene."),
    ("merge", merge.merge, "Join two maps of one place."),
    ("localize", localize.localize, "Localise photographs in an existing map."),
    ("adjust", adjust.adjust, "Bundle adjustment of a COLMAP model, BAL file or archive."),
    ("align", align.align, "Align a scene with another scene, measured positions or control points."),
    ("convert", convert.convert, "Convert between file formats."),
    ("report", report.report, "Write a scene as one HTML page that needs no network."),
    ("view", view.view, "View a scene in the browser."),
    ("synth", synth.synth, "Generate a synthetic scene with exact ground truth."),
    ("selfcheck", selfcheck.selfcheck, "Check derivatives and covariances on this machine."),
    ("warmup", warmup.warmup, "Compile everything once, so that later commands start at once."),
)
_COMPARISONS: _Commands = (
    ("poses", evaluate.poses, "Camera poses of two scenes."),
    ("trajectory", evaluate.trajectory, "Two trajectories: absolute, relative errors and drift."),
    ("lines", evaluate.lines, "3D lines with lines, edges, a mesh or points."),
    ("planes", evaluate.planes, "Planes with planes or points."),
)


def _add(group: typer.Typer, commands: _Commands) -> None:
    for name, command, words in commands:
        group.command(name, cls=Command, short_help=words)(with_common_options(guard(command)))


_evaluate = typer.Typer(help="Compare a result with a reference.", no_args_is_help=True, rich_markup_mode=None)
_add(app, _COMMANDS)
_add(_evaluate, _COMPARISONS)
app.add_typer(_evaluate, name="evaluate")


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"groma {groma.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and exit.")
    ] = False,
    no_color: NoColor = False,
) -> None:
    """Reconstruct and adjust scenes made of points, lines and planes."""
    forbid_colours(no_color)
