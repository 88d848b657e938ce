# SPDX-License-Identifier: BSD-3-Clause
"""The application: which commands there are. Each lives in a file of its own name."""

from typing import Annotated

import typer

import groma
from groma.cli import adjust, convert, demo, evaluate, map, report, selfcheck, synth, track, view, warmup
from groma.cli._guard import guard

app = typer.Typer(
    name="groma",
    help="Reconstruct and adjust scenes made of points, lines and planes.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command("demo")(guard(demo.demo))
app.command("map")(guard(map.map_))
app.command("track")(guard(track.track))
app.command("adjust")(guard(adjust.adjust))
app.command("convert")(guard(convert.convert))
app.command("report")(guard(report.report))
app.command("view")(guard(view.view))
app.command("synth")(guard(synth.synth))
app.command("selfcheck")(guard(selfcheck.selfcheck))
app.command("warmup")(guard(warmup.warmup))

_evaluate = typer.Typer(help="Compare a result with a reference.", no_args_is_help=True, rich_markup_mode=None)
_evaluate.command("poses")(guard(evaluate.poses))
_evaluate.command("lines")(guard(evaluate.lines))
_evaluate.command("planes")(guard(evaluate.planes))
_evaluate.command("trajectory")(guard(evaluate.trajectory))
app.add_typer(_evaluate, name="evaluate")


def _show_version(wanted: bool) -> None:
    if wanted:
        print(f"groma {groma.__version__}")
        raise typer.Exit()


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Print the version and leave.")
    ] = False,
) -> None:
    """Reconstruct and adjust scenes made of points, lines and planes."""
