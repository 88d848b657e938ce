# SPDX-License-Identifier: BSD-3-Clause
"""Adjustment of a scene that is too large for memory, in parts on disk.

A part is a groma archive (``.npz``). All parts have the same cameras and images; each has landmarks of its own, with
all their observations. One part is in memory at a time, besides the states of all cameras and landmarks; see
:mod:`groma.solver.reduce.shards`. Points and lines take part; planes, directions and relations do not.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from groma.adjustment.assemble import AssemblyOptions, assemble, disassemble
from groma.errors import InputError
from groma.factors.contract import Factor
from groma.factors.losses import Loss
from groma.io.archive import read_archive, write_archive
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Relations, Scene
from groma.solver.options import SolverOptions
from groma.solver.reduce.shards import Shard, solve_shards
from groma.solver.report import SolveReport
from groma.solver.solve import Progress

#: Observations of a part, where a scene is cut: about 400 MB while it is worked on.
PART_SIZE = 1_000_000


@dataclass(frozen=True)
class PartsResult:
    """The adjusted parts and how they came about."""

    #: The archives written, in the order of the parts given.
    paths: tuple[Path, ...]
    report: SolveReport
    warnings: tuple[str, ...] = ()


def write_parts(
    scene: Scene, folder: str | os.PathLike[str], observations: int = PART_SIZE, force: bool = False
) -> tuple[Path, ...]:
    """Cut a scene into parts with about so many observations each.

    Landmarks are taken in the order of the first image that sees them, so that a part concerns few images.

    Parameters
    ----------
    scene : Scene
        What to cut; its relations between landmarks are left out.
    folder : path
        Where; made where it is missing.
    observations : int
        About so many in each part.
    force : bool
        Replace archives that exist in ``folder``.

    Returns
    -------
    tuple of Path
        ``part-00000.npz`` and so on, in ``folder``.

    Raises
    ------
    InputError
        If ``observations`` is not positive.
    OutputError
        If an archive exists already, or cannot be written.
    """
    if observations < 1:
        raise InputError(f"A part needs at least one observation; got {observations}. The default is {PART_SIZE}.")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    scene = scene.replace(relations=Relations())
    seen_points = np.bincount(scene.point_observations.point_idx, minlength=scene.num_points)
    seen_lines = np.bincount(scene.line_observations.line_idx, minlength=scene.num_lines)
    seen = np.concatenate([seen_points, seen_lines])
    first = np.full(len(seen), scene.num_images)
    np.minimum.at(first, scene.point_observations.point_idx, scene.point_observations.image_idx)
    np.minimum.at(first, scene.num_points + scene.line_observations.line_idx, scene.line_observations.image_idx)
    order = np.argsort(first, kind="stable")
    part = np.empty(len(seen), np.int64)
    part[order] = (np.cumsum(seen[order]) - seen[order]) // observations
    paths = []
    for number in np.unique(part):
        own = part == number
        paths.append(folder / f"part-{number:05d}.npz")
        cut = scene.keep(points=own[: scene.num_points], lines=own[scene.num_points :])
        write_archive(cut, paths[-1], force)
    return tuple(paths)


def adjust_parts(
    parts: Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    loss: Loss | None = None,
    options: SolverOptions | None = None,
    progress: Progress | None = None,
    force: bool = False,
    **assembly: object,
) -> PartsResult:
    """Adjust the cameras, points and lines of all parts together.

    Parameters
    ----------
    parts : sequence of path
        Archives with the same cameras and images, each with landmarks of its own.
    output : path
        Folder for the adjusted archives, which keep their names.
    loss : Loss, optional
        Robust loss, in standard deviations; squares if not given.
    options : SolverOptions, optional
        Steps, tolerances, threads.
    progress : callable, optional
        Called after every step; return False to stop with the best state so far.
    force : bool
        Replace archives that exist in ``output``.
    **assembly
        Fields of :class:`groma.adjustment.assemble.AssemblyOptions`, such as ``refine_intrinsics``.

    Returns
    -------
    PartsResult
        The paths written, and the report of the solve.

    Raises
    ------
    InputError
        If the parts do not have the same images, or there is nothing to adjust.
    """
    paths = [Path(part) for part in parts]
    if len({path.name for path in paths}) < len(paths):
        raise InputError("Two parts have the same file name; the output keeps the names. Rename one.")
    chosen = AssemblyOptions(**{"planes": False, **assembly})  # type: ignore[arg-type]
    chosen = replace(chosen, loss=loss) if loss is not None else chosen
    kept: dict[str, Variables] = {}
    landmarks: dict[str, list[Variables]] = {}
    shards, notes, first = [], set(), None
    for path in paths:
        scene = read_archive(path)
        first = first or scene
        if scene.images.names != first.images.names or scene.cameras.models != first.cameras.models:
            raise InputError(f"{path} has other images or cameras than {paths[0]}. All parts need the same ones.")
        made = assemble(scene, chosen)
        notes |= set(made.notes)
        rows = {}
        for name, group in made.problem.variables.items():
            if name in ("points", "lines"):
                begin = sum(map(len, landmarks.setdefault(name, [])))
                rows[name] = slice(begin, begin + len(group))
                landmarks[name].append(group)
            else:
                kept.setdefault(name, group)
        shards.append(Shard(rows, _Reader(path, chosen)))
    if not landmarks:
        raise InputError("There is nothing to adjust: no part has points or lines with observations.")
    variables = {**kept, **{name: _joined(groups) for name, groups in landmarks.items()}}
    solution = solve_shards(variables, shards, options, progress)
    target = Path(output)
    target.mkdir(parents=True, exist_ok=True)
    written = []
    for path, shard in zip(paths, shards, strict=True):
        part = {
            name: Variables(group.manifold, group.state[shard.landmarks.get(name, slice(None))])
            for name, group in solution.variables.items()
            if name in kept or name in shard.landmarks
        }
        written.append(target / path.name)
        write_archive(disassemble(read_archive(path), Problem(part, ())), written[-1], force)
    return PartsResult(tuple(written), solution.report, tuple(sorted(notes)))


@dataclass(frozen=True)
class _Reader:
    """Makes the factors of a part from its file."""

    path: Path
    options: AssemblyOptions

    def __call__(self) -> Sequence[Factor]:
        return assemble(read_archive(self.path), self.options).problem.factors


def _joined(groups: list[Variables]) -> Variables:
    return Variables(groups[0].manifold, np.concatenate([group.state for group in groups]))


__all__ = ["PART_SIZE", "PartsResult", "adjust_parts", "write_parts"]
