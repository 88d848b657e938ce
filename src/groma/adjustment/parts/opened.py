# SPDX-License-Identifier: BSD-3-Clause
"""From parts on disk to variables: each process reads the parts that are its own, and all agree on the cameras.

What a process must know of the parts of others (numbers of landmarks, errors at the start, what holds the scene) is
told once, as facts by part, and put together in the order of the parts: the same on all processes, and the same for any
number of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from groma._counted import counted
from groma._typing import IntArray
from groma.adjustment.assemble import (
    Assembly,
    assemble,
    camera_variables,
    control_point_variables,
    first_camera_gauge,
    gauge_of,
    observations_of_frames,
    structure_variables,
)
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.parts.communication import agreed, exchange
from groma.adjustment.parts.same_scene import check_same_scene
from groma.adjustment.pixel_residuals import squared_residuals_px
from groma.adjustment.stages import with_loss
from groma.adjustment.survey.best_fit import best_fit, moved_to
from groma.adjustment.terms.camera_poses import lengths_on_planes
from groma.adjustment.terms.objects import with_held
from groma.adjustment.terms.principal_points import is_prior, near_the_middle_if_guessed, observed_cameras
from groma.errors import InputError
from groma.factors.contract import Factor
from groma.factors.losses import Loss
from groma.io.archive import read_archive
from groma.problem.problem import Problem
from groma.problem.variables import Variables
from groma.scene import Scene, Similarity
from groma.scene.local_frame import local_frame
from groma.scene.survey import Kind, accepted
from groma.solver.reduce import exact_sums
from groma.solver.reduce.contract import Reducer
from groma.solver.reduce.shard import Shard
from groma.solver.steps import States

#: Groups of landmarks.
LANDMARKS = ("points", "lines")
#: Groups that all parts share, by the first part of their names. Control points are few, and distances tie them.
SHARED = ("frames", "sensors", "intrinsics", "planes", "directions", "control_points")


@dataclass(frozen=True)
class PartReader:
    """How parts are read: near the origin of their world, and where measurements of other instruments fit best."""

    #: Moves a scene far from the origin of its world near to it.
    near: Similarity | None
    #: Moves it on to where it is placed; what was measured stays.
    fits: Similarity | None
    options: AssemblyOptions

    def read(self, path: Path) -> Scene:
        """Read a part."""
        scene, how = read_archive(path), self.options
        scene = near_the_middle_if_guessed(scene, how.refine_intrinsics, how.refine_principal_point)
        scene = scene if self.near is None else scene.transformed(self.near)
        return scene if self.fits is None else moved_to(scene, self.fits)


@dataclass(frozen=True)
class Part:
    """A part of this process."""

    path: Path
    #: Rows of its landmarks among those of the process.
    rows: dict[str, slice]


@dataclass(frozen=True)
class OpenParts:
    """The parts of this process as variables, and facts about all parts."""

    #: All parts of all processes, in order; and those of this one.
    paths: tuple[Path, ...]
    parts: tuple[Part, ...]
    variables: dict[str, Variables]
    options: AssemblyOptions
    #: Where the parts are read to.
    reader: PartReader
    #: Of every part: see :func:`_facts`.
    facts: tuple[dict[str, Any], ...]
    num_images: int = 0

    @property
    def has_lines(self) -> bool:
        """Whether any part has lines."""
        return any(fact["lines"] for fact in self.facts)

    def read(self, part: Part) -> Scene:
        """Read a part, near the origin."""
        return self.reader.read(part.path)

    def assembled(self, part: Part, states: States | None = None, loss: Loss | None = None) -> tuple[Scene, Assembly]:
        """Return a part as a scene, and as a problem at given states of all variables of this process."""
        scene = self.read(part)
        made = _assembled(scene, self.options, part.path == self.paths[0])
        own = {} if states is None else self.states_of(part, states)
        # A part may have no factors of planes, for example; they move all the same.
        shared = {name: group for name, group in self.variables.items() if _is_shared(name)}
        if not len(scene.control_points):
            shared.pop("control_points", None)
        variables = {
            name: replace(group, state=own.get(name, group.state))
            for name, group in (shared | dict(made.problem.variables)).items()
        }
        problem = Problem(variables, made.problem.factors)
        if loss is not None:
            problem = with_loss(problem, loss, self.options.relation_loss, self.options.line_loss_factor)
        return scene, replace(made, problem=problem)

    def states_of(self, part: Part, states: States) -> States:
        """Return the states of what all parts share and of the landmarks of a part."""
        return {
            name: state[part.rows.get(name, slice(None))]
            for name, state in states.items()
            if name in part.rows or name not in LANDMARKS
        }

    def shards(self, loss: Loss) -> list[Shard]:
        """Return the parts of this process for a solve under a loss."""
        return [Shard(part.rows, _Reader(self, part, loss)) for part in self.parts]

    @property
    def num_planes(self) -> int:
        """Number of planes that take part."""
        return len(self.variables.get("planes", ()))

    def total(self, name: str) -> int:
        """Return the sum of a number over all parts."""
        return sum(int(fact[name]) for fact in self.facts)


@dataclass(frozen=True)
class _Reader:
    """Makes the factors of a part from its file."""

    parts: OpenParts
    part: Part
    loss: Loss

    def __call__(self) -> Sequence[Factor]:
        return self.parts.assembled(self.part, loss=self.loss)[1].problem.factors


def open_parts(paths: Sequence[Path], options: AssemblyOptions, reducer: Reducer) -> OpenParts:
    """Read the parts of this process, and agree with the others on what all share.

    Raises
    ------
    InputError
        On all processes, if one of them cannot read its parts, sees others than the rest, or finds cameras or planes
        that are not those of the first part; or if there is nothing to adjust.
    """
    # Lines in the reduced system would be on all processes: points are tied to lines in pixels.
    options = replace(options, max_coupled_lines=0)
    with agreed(reducer):
        sizes = [path.stat().st_size for path in paths]
    _check_same(reducer, [[path.name, size] for path, size in zip(paths, sizes, strict=True)])
    with agreed(reducer):
        reader = PartReader(local_frame(read_archive(paths[0])), None, options)
        head = reader.read(paths[0])
        _check_distances(paths[0], head)
        if options.refine_poses:
            reader = replace(reader, fits=best_fit(head))
            head = head if reader.fits is None else moved_to(head, reader.fits)
    mine = np.flatnonzero(_owners(sizes, reducer.size) == reducer.rank)
    with agreed(reducer):
        parts, own, facts, count = _read_own(paths, mine.tolist(), options, (head, reader))
    told = {int(number): fact for part in exchange(reducer, facts) for number, fact in part.items()}
    ordered = tuple(told[number] for number in sorted(told))
    with agreed(reducer):
        if not any(fact["kept"] for fact in ordered):
            raise InputError("There is nothing to adjust: no part has points, lines or planes with observations.")
    of_frames, of_cameras = np.split(_sum_of(count, reducer), [head.num_frames])
    seen = tuple(np.flatnonzero(of_cameras).tolist())
    lengths = sum(fact["lengths"] for fact in ordered)
    options = replace(options, gauge=_gauge(options, ordered), seen_cameras=seen, num_lengths=lengths)
    held = first_camera_gauge(head, of_frames, any(fact["metric"] for fact in ordered))
    shared = {**camera_variables(head, options, held), **structure_variables(head, options)}
    shared = with_held(shared | control_point_variables(head, options), head)
    used = {name for fact in ordered for name in fact["kept"]}
    with agreed(reducer):
        if unknown := sorted(used - shared.keys()):
            raise InputError(f"Parts cannot share these variables: {', '.join(unknown)}. Leave their options out.")
    variables = {name: group for name, group in shared.items() if name in used} | own
    return OpenParts(tuple(paths), tuple(parts), variables, options, reader, ordered, head.num_images)


def _read_own(
    paths: Sequence[Path], mine: list[int], options: AssemblyOptions, first: tuple[Scene, PartReader]
) -> tuple[list[Part], dict[str, Variables], dict[int, dict[str, Any]], IntArray]:
    """Return the parts of this process, variables of theirs alone, facts by part, and what frames and cameras see."""
    head, reader = first
    groups: dict[str, list[Variables]] = {}
    held: dict[str, Variables] = {}
    parts, facts, count = [], {}, np.zeros(head.num_frames + head.num_cameras, np.int64)
    for number in mine:
        scene = reader.read(paths[number])
        check_same_scene(paths[number], scene, paths[0], head, options.planes)
        made = _assembled(scene, options, number == 0)
        rows = {}
        for name in LANDMARKS:
            if name in made.problem.variables:
                group = made.problem.variables[name]
                begin = sum(map(len, groups.setdefault(name, [])))
                rows[name] = slice(begin, begin + len(group))
                groups[name].append(group)
        parts.append(Part(paths[number], rows))
        held |= {name: made.problem.variables[name] for name in _held_besides(made)}
        facts[number] = _facts(accepted(scene), options, made)
        count[: head.num_frames] += observations_of_frames(scene)
        count[head.num_frames + observed_cameras(scene)] += 1
    return parts, held | {name: _joined(group) for name, group in groups.items()}, facts, count


def _check_distances(path: Path, head: Scene) -> None:
    """Refuse distances that tie two lines, all of which are eliminated in their part."""
    table = head.distances
    tied = (table.first_kind == Kind.LINE) & (table.second_kind == Kind.LINE) & ~table.rejected
    if tied.any():
        raise InputError(
            f"{path} has {counted(int(tied.sum()), 'distances')} between lines, which are not "
            "adjusted in parts. Adjust the scene as a whole, or leave these distances out."
        )


def _sum_of(count: IntArray, reducer: Reducer) -> IntArray:
    """Return the sum over processes."""
    return exact_sums.rounded(reducer.sum(count.astype(complex))).astype(np.int64)


def _assembled(scene: Scene, options: AssemblyOptions, is_first: bool) -> Assembly:
    """Return a part as a problem; where principal points are expected counts once, in the first part."""
    made = assemble(scene, options)
    if is_first:
        return made
    kept = [(name, one) for name, one in zip(made.terms, made.groups, strict=True) if not is_prior(one.factor)]
    problem = Problem(made.problem.variables, [one.factor for _, one in kept])
    return replace(made, problem=problem, terms=tuple(n for n, _ in kept), groups=tuple(one for _, one in kept))


def _facts(scene: Scene, options: AssemblyOptions, made: Assembly) -> dict[str, Any]:
    """Return the facts about a part that all processes need."""
    squares = squared_residuals_px(made)
    return {
        "points": scene.num_points if "points" in made.problem.variables else 0,
        "lines": scene.num_lines if "lines" in made.problem.variables else 0,
        "observations": sum(len(group.factor) for group in made.groups if group.observes),
        "measurements": made.num_measurements,
        "kept": sorted(made.problem.variables.keys() - set(LANDMARKS) - _held_besides(made)),
        "priors": len(scene.pose_priors) > 0 or scene.is_surveyed,
        "metric": scene.has_scale,
        "lengths": lengths_on_planes(scene),
        "gauge": gauge_of(scene, options) if options.gauge == "auto" else options.gauge,
        "squares": {kind: [float(values.sum()), len(values)] for kind, values in squares.items()},
        "notes": [*made.notes, *_held_lenses(scene, options)],
    }


def _held_lenses(scene: Scene, options: AssemblyOptions) -> list[str]:
    """Say that parts hold what a whole scene estimates of a calibration that was not given."""
    count = len(scene.principal_point_priors)
    if not count or (options.refine_principal_point is not False and options.refine_intrinsics is not False):
        return []
    rest = "" if options.refine_intrinsics else " and the rest, which --refine-intrinsics (refine_intrinsics) estimates"
    return [f"The calibration of {counted(count, 'cameras')} was not given. Parts hold the principal points{rest}."]


def _held_besides(made: Assembly) -> set[str]:
    """Return the groups that a term adds and that do not move, such as the places of second cameras of stereo pairs."""
    groups = made.problem.variables.items()
    return {name for name, group in groups if group.is_constant and not (_is_shared(name) or name in LANDMARKS)}


def _is_shared(name: str) -> bool:
    return name.partition("/")[0] in SHARED


def _gauge(options: AssemblyOptions, facts: Sequence[dict[str, Any]]) -> str:
    """What holds the scene, as one part or another wants it; known poses hold all."""
    if options.gauge != "auto":
        return options.gauge
    free = any(fact["priors"] for fact in facts) or all(fact["gauge"] == "free" for fact in facts)
    return "free" if free else "first_camera"


def _owners(sizes: Sequence[int], count: int) -> np.ndarray:
    """Return the rank each part belongs to: the largest first, each to the rank with the least so far."""
    load, owner = np.zeros(count), np.zeros(len(sizes), int)
    for number in sorted(range(len(sizes)), key=lambda number: -sizes[number]):
        owner[number] = int(np.argmin(load))
        load[owner[number]] += sizes[number]
    return owner


def _check_same(reducer: Reducer, listing: list[list[Any]]) -> None:
    """All processes see the same files."""
    told = exchange(reducer, listing)
    for rank, other in enumerate(told):
        if other != told[0]:
            with agreed(reducer):
                raise InputError(
                    f"Rank 0 sees {len(told[0])} parts and rank {rank} sees {len(other)}, or files of other sizes. All "
                    "machines need the same folder, for example on a disk they share."
                )


def _joined(groups: list[Variables]) -> Variables:
    constant = [np.broadcast_to(group.constant, len(group)) for group in groups]
    state = np.concatenate([group.state for group in groups])
    return Variables(groups[0].manifold, state, np.concatenate(constant) if np.any(np.concatenate(constant)) else False)
