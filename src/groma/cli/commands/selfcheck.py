# SPDX-License-Identifier: BSD-3-Clause
"""``groma selfcheck``: every derivative, and the covariances, checked on this machine."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from groma._counted import counted
from groma.cli.shared import options as _options
from groma.cli.shared.console import Console
from groma.errors import InputError

if TYPE_CHECKING:
    from groma.factors import SelfCheckRow

#: Simulated scenes (cost: time).
_RUNS = 100


def selfcheck(
    console: Console,
    golden: Annotated[
        Path | None,
        _options.PLAIN.option("Folder of reference values (*.json) to compare with as well.", metavar="DIR"),
    ] = None,
    nees: Annotated[
        bool, _options.PLAIN.option("Check covariances instead, against errors of simulated scenes.", "--nees")
    ] = False,
    runs: Annotated[int, _options.PLAIN.option("With --nees: simulated scenes per gauge.", min=2, metavar="N")] = _RUNS,
    seed: _options.Seed = 0,
    force: _options.ForceReport = False,
) -> None:
    """Compare the analytic derivatives of every factor with numeric ones, and with reference values.

    Prints the worst deviation per factor, with --verbose per block. With --nees, simulates scenes of known noise and
    prints how the errors of poses, points, lines, planes, directions and intrinsics compare with their covariances.
    Exit code 1 if a deviation is too large.
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.input import refuse_idle

    _output.check_json(console.json_target, force)
    refuse_idle(
        ("--runs", runs != _RUNS and not nees, "with --nees"),
        ("--golden", golden is not None and nees, "without --nees"),
    )
    if golden is not None and not golden.is_dir():
        raise InputError(f"--golden must be a folder of reference values; there is none at {golden}. Check the path.")
    console.expect_compilation("selfcheck")
    passed, numbers = _check_covariances(console, runs, seed) if nees else _check_derivatives(console, golden, seed)
    _output.write_json(console.json_target, numbers, force)
    if not passed:
        raise typer.Exit(1)


def _check_derivatives(console: Console, golden: Path | None, seed: int) -> tuple[bool, dict[str, Any]]:
    from groma.factors import selfcheck as run_selfcheck

    outcome = run_selfcheck(golden, seed)
    by_factor: dict[tuple[str, str], list[SelfCheckRow]] = {}
    for row in outcome.rows:
        by_factor.setdefault((row.factor, row.against), []).append(row)
    console.table(
        ["factor or camera", "against", "comparisons", "worst / allowed", ""],
        [
            [factor, against, f"{len(rows):,}", f"{max(row.worst for row in rows):.1e}", _mark(rows)]
            for (factor, against), rows in by_factor.items()
        ],
    )
    failed = [row for row in outcome.rows if not row.passed]
    if console.verbose or failed:
        console.table(
            [f"{'each' if console.verbose else 'failed'}: factor or camera", "by", "against", "worst / allowed", ""],
            [
                [row.factor, row.block, row.against, f"{row.worst:.1e}", _mark([row])]
                for row in (outcome.rows if console.verbose else failed)
            ],
        )
    console.say(f"{counted(len(outcome.rows), 'comparisons')}, {len(failed):,} failed.")
    return outcome.passed, outcome.to_dict()


def _mark(rows: Sequence[SelfCheckRow]) -> str:
    return "" if all(row.passed for row in rows) else "FAILED"


def _check_covariances(console: Console, runs: int, seed: int) -> tuple[bool, dict[str, Any]]:
    from groma.adjustment.consistency import ConsistencyReport, consistency
    from groma.localization.pose.consistency import localization_consistency

    outcome = ConsistencyReport(runs, seed, consistency(runs, seed).rows + localization_consistency(runs, seed))
    console.say("Normalised estimation error squared: its average should be the degrees of freedom.")
    console.table(
        ["kind", "gauge", "expected", "average", "95 % band", "errors", ""],
        [
            [
                *(row.kind, row.gauge, f"{row.dof}", f"{row.average:.3f}", f"{row.low:.3f} .. {row.high:.3f}"),
                *(f"{row.count:,}", "" if row.inside else "outside" if row.passed else "FAILED"),
            ]
            for row in outcome.rows
        ],
    )
    inside = sum(row.inside for row in outcome.rows)
    failures = sum(not row.passed for row in outcome.rows)
    console.say(
        f"{inside} of {len(outcome.rows)} averages are in their band (1 in 20 is not, by chance); {failures} failed."
    )
    return outcome.passed, outcome.to_dict()
