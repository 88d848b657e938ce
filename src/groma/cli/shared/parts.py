# SPDX-License-Identifier: BSD-3-Clause
"""``groma adjust`` of a folder of parts, by one process or by all that a launcher started."""

from __future__ import annotations

import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
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
    """Whether a launcher of MPI started this process together with others."""
    from groma.solver.reduce.mpi import started_as

    return started_as()[1] > 1


def is_parts(path: Path) -> bool:
    """Whether a path is a folder with parts in it."""
    return path.is_dir() and next(path.glob("part-*.npz"), None) is not None


@dataclass(frozen=True)
class PartsWanted:
    """What comes out of ``groma adjust`` of parts."""

    #: Folder of the adjusted parts.
    output: Path | None
    #: Value of --json, and whether files may be replaced.
    json_target: str | None = None
    force: bool = False
    #: Whether parts stay in memory: ``auto``, ``always``, ``never``.
    keep: str = "auto"


def adjust_parts_and_write(
    source: Path, console: Console, options: AdjustOptions, wanted: PartsWanted, refused: dict[str, Any]
) -> None:
    """Adjust the parts in a folder and write what is wanted; rank 0 says how it went.

    Parameters
    ----------
    source : Path
        The folder of the parts.
    console : Console
        Where rank 0 speaks.
    options : AdjustOptions
        How to adjust.
    wanted : PartsWanted
        What to write.
    refused : dict
        Options of the command that mean nothing for parts, and their values.
    """
    with _one_voice() as reducer:
        numbers = _adjust(source, console, options, wanted, refused, reducer)
        if reducer.rank == 0:
            _output.write_json(wanted.json_target, numbers, wanted.force)


def _adjust(
    source: Path,
    console: Console,
    options: AdjustOptions,
    wanted: PartsWanted,
    refused: dict[str, Any],
    reducer: Reducer,
) -> dict[str, Any]:
    """Adjust, and return the numbers."""
    from groma.adjustment.parts import adjust_parts, parts_of
    from groma.adjustment.parts.settings import settings_of
    from groma.adjustment.parts.together import agreed
    from groma.adjustment.report import Progress
    from groma.cli.shared.sentences import say_adjustment
    from groma.compilation.time import compilation_time

    speaks = reducer.rank == 0
    with agreed(reducer):
        output = _checked(source, wanted, refused, reducer.rank)
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
            force=wanted.force, keep=wanted.keep, reducer=reducer, **assembly,
        )  # fmt: skip
    if not speaks:
        return {}
    numbers = {**result.adjustment.to_dict(), "warnings": list(result.warnings), "ranks": reducer.size}
    numbers |= {"parts": len(paths), "bytes_per_step": getattr(reducer, "bytes_per_sum", 0)}
    numbers["seconds"] |= {"compilation": compilation.seconds, "total": time.perf_counter() - began}
    sentence = result.report.termination.sentence
    say_adjustment(console, numbers, sentence, compilation)
    for kind, rmse in numbers["rmse_px"].items() if not console.verbose else ():
        console.say(f"  rms of all {kind}, outliers included: {rmse['before']:.3f} px -> {rmse['after']:.3f} px")
    for text in result.warnings:
        console.warn(text)
    console.wrote(output)
    return numbers


def _checked(source: Path, wanted: PartsWanted, refused: dict[str, Any], rank: int) -> Path:
    """Refuse early what cannot be done; return where parts are written."""
    output = wanted.output
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
    if not output.absolute().parent.is_dir():
        raise InputError(f"Cannot write {output}: the folder {output.absolute().parent} does not exist. Make it first.")
    if rank == 0:
        _output.check_outputs(wanted.force, None, json_target=wanted.json_target)
    return output


@contextmanager
def _one_voice() -> Iterator[Reducer]:
    """Yield the reducer of this process. What goes wrong is said once, all ranks end, and none waits for another."""
    from groma.adjustment.parts.together import ToldByAllError
    from groma.solver.reduce.mpi import Ranks, reducer_of_launcher, started_as

    try:
        reducer = reducer_of_launcher()
    except GromaError:
        if started_as()[0] == 0:
            raise
        raise typer.Exit(1) from None  # rank 0 says it
    try:
        yield reducer
    except ToldByAllError:
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
