# SPDX-License-Identifier: BSD-3-Clause
"""``groma selfcheck``: every derivative, checked on this machine."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli import _options


def selfcheck(
    golden: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Folder of reference values (*.json) to compare with as well."),
    ] = None,
    seed: _options.Seed = 0,
    force: _options.Force = False,
    threads: _options.Threads = None,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Compare the analytic derivatives of every factor with numeric ones, and with reference values.

    Prints the worst deviation per factor and block. Exit code 1 if any of them is too large.
    """
    from groma.cli import _output
    from groma.cli._console import Console

    console = Console(quiet, verbose, json_target, threads)
    _output.check_json(json_target, force)
    console.announce_compilation()

    from groma.factors._selfcheck import selfcheck as run_selfcheck

    outcome = run_selfcheck(golden, seed)
    console.say(f"{'factor':<28}{'block':<34}{'against':<12}{'cases':>6}{'worst / allowed':>18}")
    for row in outcome.rows:
        mark = "" if row.passed else "   FAILED"
        console.say(f"{row.factor:<28}{row.block:<34}{row.against:<12}{row.cases:>6}{row.worst:>18.2e}{mark}")
    failures = sum(not row.passed for row in outcome.rows)
    console.say(f"{len(outcome.rows)} comparisons, {failures} failed.")
    _output.write_json(json_target, outcome.to_dict(), force)
    if not outcome.passed:
        raise typer.Exit(1)
