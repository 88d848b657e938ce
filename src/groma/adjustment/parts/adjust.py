# SPDX-License-Identifier: BSD-3-Clause
"""Adjustment of parts on disk, by one process or by many, in the stages of every adjustment.

::

    open the parts, agree on the cameras
    for every loss
        solve                                             (a checkpoint after every step)
        bring lines back from wrong minima             (each part on its own)
    write the parts
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.outcome import COUNTED_OTHERWISE
from groma.adjustment.parts.checkpoint import FOLDER, Checkpoint, key_of
from groma.adjustment.parts.communication import agreed
from groma.adjustment.parts.cut import parts_of
from groma.adjustment.parts.memory import room_for_parts
from groma.adjustment.parts.opened import open_parts
from groma.adjustment.parts.run import Run, Solved, Squares, Written
from groma.adjustment.report import AdjustReport, not_converged
from groma.errors import InputError, OutputError, check_kind, given_or_default
from groma.factors.losses import Loss, Trivial
from groma.solver.linear.blas import one_blas_thread
from groma.solver.options import SolverOptions
from groma.solver.reduce.contract import Reducer
from groma.solver.reduce.single import SingleProcess
from groma.solver.report import SolveReport
from groma.solver.solve import Progress


@dataclass(frozen=True)
class PartsResult:
    """The adjusted parts, and the course of the adjustment."""

    #: The archives written, in the order of the parts given.
    paths: tuple[Path, ...]
    report: SolveReport
    warnings: tuple[str, ...]
    #: The same in the terms of the scene.
    adjustment: AdjustReport


def adjust_parts(
    parts: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    loss: Loss | Sequence[Loss] | None = None,
    options: SolverOptions | None = None,
    progress: Progress | None = None,
    force: bool = False,
    keep: str = "auto",
    reducer: Reducer | None = None,
    **assembly: object,
) -> PartsResult:
    """Adjust the cameras, points, lines, planes and directions of all parts together.

    A killed run resumes after its last step if it is started again with the same parts, output and options.

    Parameters
    ----------
    parts : sequence of path
        Archives with the same cameras, images and planes, and disjoint points and lines.
    output : path
        Folder for the adjusted archives, which keep their names.
    loss : Loss or sequence of Loss, optional
        Robust loss, in standard deviations, or a sequence of losses; by default least squares.
    options : SolverOptions, optional
        Steps, tolerances, threads.
    progress : callable, optional
        Called after every step; return False, on all processes, to stop with the best state so far.
    force : bool
        Replace archives that exist in ``output``.
    keep : str
        Whether parts stay in memory from one step to the next: ``always``, ``never``, or ``auto``, where they fit.
    reducer : Reducer, optional
        The processes that adjust the parts together, such as :class:`groma.solver.reduce.mpi.Ranks`; each of them calls
        this function with the same arguments. Default: this process alone.
    **assembly
        Fields of :class:`groma.adjustment.assembly_options.AssemblyOptions`, such as ``refine_intrinsics``.

    Returns
    -------
    PartsResult
        The paths written, and the report of the solve.

    Raises
    ------
    InputError
        If the parts do not have the same images and planes, or there is nothing to adjust.
    OutputError
        If archives exist in ``output`` already, or cannot be written.
    """
    check_kind(parts, (list, tuple), "parts", "Pass the paths of the archives: [path, ...].")
    reducer, options = reducer or SingleProcess(), given_or_default(options, SolverOptions)
    chosen = AssemblyOptions(**assembly)  # type: ignore[arg-type]
    paths = [Path(part) for part in parts]
    with agreed(reducer):
        _check_names(paths)
    opened = open_parts(paths, chosen, reducer)
    losses: list[Loss] = [loss] if isinstance(loss, Loss) else list(loss or [Trivial()])
    if isinstance(losses[-1], Trivial) and opened.has_lines:
        losses = [Trivial(), Trivial()]  # lines are started anew between the two
    how = replace(options, threads=None), losses, opened.options
    checkpoint = Checkpoint(Path(output) / FOLDER, key_of(paths, *how), opened, reducer)
    with agreed(reducer):
        begin = checkpoint.load()
    with agreed(reducer):
        if reducer.rank == 0:
            _prepare(Path(output), paths, begin is not None, force)
    run = Run(opened, losses, options, progress, reducer, room_for_parts(keep, reducer), checkpoint)
    with one_blas_thread():
        solved = run.solve(begin)
        written = run.write(solved, Path(output))
    with agreed(reducer):
        if reducer.rank == 0:
            _tidy(Path(output), paths, checkpoint)
    return _result(run, Path(output), solved, written)


def _check_names(paths: Sequence[Path]) -> None:
    if not paths:
        raise InputError("There are no parts. Make them with groma convert MODEL PARTS --parts.")
    if len({path.name for path in paths}) < len(paths):
        raise InputError("Two parts have the same file name; the output keeps the names. Rename one.")


def _prepare(output: Path, paths: Sequence[Path], goes_on: bool, force: bool) -> None:
    """Make the folder of the result, unless it holds results that are not to be replaced."""
    if any(path.parent.absolute() == output.absolute() for path in paths):
        raise OutputError(f"{output} is the folder of the parts. They are not replaced; choose another name.")
    output.mkdir(parents=True, exist_ok=True)
    if goes_on or force:
        return
    if (output / FOLDER).exists():
        raise OutputError(
            f"{output} holds what an adjustment of other parts, or with other options, came to before it was stopped. "
            "Pass force=True (--force) to begin anew, or choose another name."
        )
    there = next((path.name for path in paths if (output / path.name).exists()), None)
    if there is not None:
        raise OutputError(
            f"{output / there} exists already. Pass force=True (--force) to replace it, or choose another name."
        )


def _tidy(output: Path, paths: Sequence[Path], checkpoint: Checkpoint) -> None:
    """Remove the checkpoint, and parts of an earlier result that this one does not have."""
    for old in set(parts_of(output)) - {output / path.name for path in paths}:
        old.unlink()
    checkpoint.remove()


def _result(run: Run, output: Path, solved: Solved, written: Written) -> PartsResult:
    """Say what an adjustment did."""
    opened, before, after = run.opened, [fact["squares"] for fact in run.opened.facts], written.squares
    kinds = sorted({kind for part in before for kind in part}, reverse=True)
    measurements: dict[str, int] = {}
    for fact in opened.facts:
        for name, count in fact["measurements"].items():
            if name not in COUNTED_OTHERWISE and count:
                measurements[name] = measurements.get(name, 0) + count
    warnings = (*sorted({note for fact in opened.facts for note in fact["notes"]}), *not_converged(solved.report))
    adjustment = AdjustReport(
        num_images=opened.num_images,
        num_points=opened.total("points"),
        num_lines=opened.total("lines"),
        num_planes=opened.num_planes,
        num_observations=opened.total("observations"),
        rmse_px={kind: {"before": _rms(before, kind), "after": _rms(after, kind)} for kind in kinds},
        inliers={},
        sigma0=None,
        solve=solved.report,
        relations=written.relations,
        warnings=warnings,
        stages=solved.stages,
        num_measurements=measurements,
    )
    return PartsResult(tuple(output / path.name for path in opened.paths), solved.report, warnings, adjustment)


def _rms(squares: Squares, kind: str) -> float:
    total, count = np.sum([part[kind] for part in squares if kind in part], axis=0)
    return float(np.sqrt(total / count))
