# SPDX-License-Identifier: BSD-3-Clause
"""``groma adjust`` of a folder of parts, by one process or by the ranks of MPI."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from groma.cli.shared import output as _output
from groma.cli.shared.console import Console
from groma.errors import GromaError, InputError

if TYPE_CHECKING:
    from groma.adjustment.adjust import AdjustOptions
    from groma.solver.reduce.contract import Reducer


def has_company() -> bool:
    """Whether this is one of several ranks of MPI."""
    from groma.solver.reduce.mpi import started_as

    return started_as()[1] > 1


def is_parts(path: Path) -> bool:
    """Whether a path is a folder of parts."""
    return path.is_dir() and next(path.glob("part-*.npz"), None) is not None


def adjust_parts_and_write(
    source: Path,
    output: Path | None,
    console: Console,
    options: AdjustOptions,
    refused: dict[str, Any],
    keep: str = "auto",
    force: bool = False,
) -> None:
    """Adjust the parts in a folder and write them; rank 0 prints the summary.

    Parameters
    ----------
    source, output : Path
        Folders of the parts and of the adjusted parts.
    console : Console
        Used by rank 0 only.
    options : AdjustOptions
        How to adjust.
    refused : dict
        Options that do not apply to parts, with their values.
    keep : str
        Whether parts stay in memory: ``auto``, ``always``, ``never``.
    force : bool
        Replace existing files.
    """
    from groma.adjustment.parts.communication import agreed

    with _one_voice() as reducer:
        with agreed(reducer):
            folder = _checked(source, output, refused)
            if reducer.rank == 0:
                _output.check_outputs(force, None, json_target=console.json_target)
        numbers = _adjust(source, folder, console, options, keep, force, reducer)
        if reducer.rank == 0:
            _output.write_json(console.json_target, numbers, force)


def _adjust(
    source: Path, output: Path, console: Console, options: AdjustOptions, keep: str, force: bool, reducer: Reducer
) -> dict[str, Any]:
    """Adjust, and return the numbers."""
    from groma.adjustment.parts import adjust_parts, parts_of
    from groma.adjustment.parts.communication import agreed
    from groma.adjustment.parts.settings import settings_of
    from groma.adjustment.report import Progress
    from groma.cli.shared.sentences import say_adjustment
    from groma.compilation.time import compilation_time

    speaks = reducer.rank == 0
    with agreed(reducer):
        paths = parts_of(source)
        losses, solver, assembly = settings_of(paths[0], options)
    if speaks:
        console.expect_compilation("adjust")
        idle = reducer.size - len(paths)
        if idle > 0:
            console.warn(f"There are {len(paths)} parts for {reducer.size} ranks: {idle} have nothing to do.")
        if (output / ".checkpoint" / "state.npz").exists():
            console.say(f"Going on where an earlier run in {output} stopped.")
    began = time.perf_counter()
    with compilation_time() as compilation, console.progress() as line:
        result = adjust_parts(
            paths, output, losses, solver,
            (lambda record: line(Progress(record.iteration, options.max_iterations, record.cost))) if speaks else None,
            force=force, keep=keep, reducer=reducer, **assembly,
        )  # fmt: skip
    if not speaks:
        return {}
    numbers = {**result.adjustment.to_dict(), "warnings": list(result.warnings), "ranks": reducer.size}
    numbers |= {"parts": len(paths), "bytes_per_step": getattr(reducer, "bytes_per_sum", 0)}
    numbers["seconds"] |= {"compilation": compilation.seconds, "total": time.perf_counter() - began}
    say_adjustment(console, numbers, result.report.termination.sentence, compilation)
    for kind, rmse in numbers["rmse_px"].items() if not console.verbose else ():
        console.say(f"  rms of all {kind}, outliers included: {rmse['before']:.3f} px -> {rmse['after']:.3f} px")
    console.warn(*result.warnings)
    console.wrote(output)
    return numbers


def _checked(source: Path, output: Path | None, refused: dict[str, Any]) -> Path:
    """Validate the options; return the folder for the adjusted parts."""
    for name, value in refused.items():
        if value:
            raise InputError(f"{name} is for whole scenes; {source} is a folder of parts. Leave it out.")
    if not is_parts(source):
        if source.exists() and not has_company():
            raise InputError(f"{source} has no parts (part-*.npz).")
        raise InputError(
            f"{source} is not a folder of parts (part-*.npz) that this process can see. Processes adjust together "
            "what groma convert MODEL PARTS --parts has cut, in a folder that all of them see."
            if has_company()
            else f"{source} does not exist."
        )
    if output is None:
        raise InputError("Parts are adjusted into a folder: pass -o OUT.")
    if output.exists() and not output.is_dir():
        raise InputError(f"{output} is a file; parts are written into a folder. Choose another name.")
    return output


@contextmanager
def _one_voice() -> Iterator[Reducer]:
    """Yield the reducer of this process. An error is printed once and ends all ranks."""
    from groma.adjustment.parts.communication import AllRanksError
    from groma.solver.reduce.mpi import Ranks, reducer_of_launcher, started_as

    try:
        reducer = reducer_of_launcher()
    except GromaError:
        if started_as()[0] == 0:
            raise
        raise typer.Exit(1) from None  # rank 0 prints it
    try:
        yield reducer
    except AllRanksError:
        if reducer.rank == 0:
            raise
        raise typer.Exit(1) from None
    except BaseException as error:
        if isinstance(reducer, Ranks):
            known = isinstance(error, GromaError | OSError | MemoryError | KeyboardInterrupt)
            text = " ".join((str(error) or type(error).__name__).split()) if known else traceback.format_exc()
            print(f"groma: rank {reducer.rank} of {reducer.size}: {text}", file=sys.stderr, flush=True)
            reducer.abort()
        raise
