# SPDX-License-Identifier: BSD-3-Clause
"""The stages of an adjustment of opened parts, and writing what came of it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from groma.adjustment.adjust import damping_after, stage_tolerance
from groma.adjustment.assemble import disassemble
from groma.adjustment.outcome import drop_failed_relations
from groma.adjustment.parts.checkpoint import Checkpoint, Progressed, reports_of
from groma.adjustment.parts.communication import agreed, exchange
from groma.adjustment.parts.opened import LANDMARKS, OpenParts
from groma.adjustment.pixel_residuals import squared_residuals_px
from groma.adjustment.rescue.restart import renew_lines, with_seen_ends
from groma.adjustment.rescue.slips import without_slips
from groma.adjustment.stages import STAGES, one_after_another, stage_entries
from groma.adjustment.survey.best_fit import best_fit, moved_to
from groma.adjustment.terms.objects import with_held_states
from groma.factors.losses import GemanMcClure, Loss, Trivial
from groma.gates import chi_square_gate
from groma.io.archive import write_archive
from groma.scene import Similarity
from groma.solver.options import SolverOptions
from groma.solver.reduce.contract import Reducer
from groma.solver.reduce.shards import solve_shards
from groma.solver.report import Iteration, SolveReport
from groma.solver.solve import Progress
from groma.solver.steps import States

#: Histogram of squared residuals by their binary logarithm (number and bounds of bins), for a median that
#: all processes agree on (cost: a bin is 1.4 per cent wide, less than a median of parts is known to).
BINS, BIN_RANGE = 4096, (-40.0, 40.0)
#: Of every part and kind of landmark: the sum of squared residuals, pixels, and their number.
Squares = list[dict[str, list[float]]]


@dataclass(frozen=True)
class Solved:
    """The last states, one report of all stages, and an entry of each stage."""

    states: States
    report: SolveReport
    stages: tuple[dict[str, Any], ...]
    #: The loss of the last of them.
    loss: Loss


@dataclass(frozen=True)
class Written:
    """What is known of all parts when they are written."""

    squares: Squares
    #: By kind, how many relations between landmarks hold, and how many the loss gave up.
    relations: dict[str, dict[str, int]]


@dataclass(frozen=True)
class Run:
    """An adjustment of opened parts, stage by stage."""

    opened: OpenParts
    losses: list[Loss]
    options: SolverOptions
    progress: Progress | None
    reducer: Reducer
    #: Bytes for parts that stay in memory.
    room: float
    checkpoint: Checkpoint

    def solve(self, begin: States | None) -> Solved:
        """Go through the stages; or, from the states of an earlier run, through those that it left."""
        start = {name: group.state for name, group in self.opened.variables.items()}
        states, losses = begin or start, list(self.losses)
        at, reports = self.checkpoint.progressed, reports_of(self.checkpoint.progressed)
        for number in range(at.stage, len(losses)):
            last = number + 1 == len(losses)
            if number > at.stage:
                earlier = [(report.initial_cost, report.history) for report in reports]
                at = Progressed(number, self._wider(states, losses[number]), earlier)
                self.checkpoint.enter(at)
            if at.scale is not None:
                losses[number] = replace(losses[number], scale=at.scale)  # type: ignore[call-arg]
            states, report, stopped = self._stage(states, losses[number], last, reports)
            reports.append(report)
            if stopped:
                break
            states, moved = self._with_renewed_lines(states, losses[number], last, report.iterations)
            if moved and last:
                reports[-1] = replace(report, final_cost=self._evaluate(states, losses[number]).final_cost)
        report, loss = one_after_another(reports), losses[len(reports) - 1]
        report = replace(report, initial_cost=reports[0].initial_cost)
        if loss != losses[0]:  # costs under different losses cannot be compared
            report = replace(report, initial_cost=self._evaluate(start, loss).initial_cost)
        return Solved(states, report, stage_entries(losses, reports), loss)

    def _stage(
        self, states: States, loss: Loss, last: bool, earlier: list[SolveReport]
    ) -> tuple[States, SolveReport, bool]:
        """Solve under one loss; return the states, the report, and whether the caller wants to stop."""
        options, spent, stopped = self.options, sum(report.iterations for report in earlier), []
        patient = last or not isinstance(loss, Trivial)

        def tell(record: Iteration) -> bool:
            if self.progress is not None:
                own = replace(record, iteration=spent + record.iteration)
                stopped.extend([True] if self.progress(own) is False else [])
            return not stopped and (record.accepted or patient)

        options = replace(
            options,
            max_iterations=options.max_iterations - spent,
            function_tolerance=options.function_tolerance if last else stage_tolerance(loss),
            initial_damping=options.initial_damping or damping_after(earlier, loss) or None,
        )
        solution = solve_shards(
            {name: group.with_state(states[name]) for name, group in self.opened.variables.items()},
            self.opened.shards(loss),
            options,
            tell,
            self.reducer,
            self.room,
            self.checkpoint,
        )
        return {name: group.state for name, group in solution.variables.items()}, solution.report, bool(stopped)

    def _evaluate(self, states: States, loss: Loss) -> SolveReport:
        """Return the cost of states under a loss."""
        variables = {name: group.with_state(states[name]) for name, group in self.opened.variables.items()}
        options = replace(self.options, max_iterations=0)
        return solve_shards(variables, self.opened.shards(loss), options, reducer=self.reducer).report

    def _with_renewed_lines(self, states: States, loss: Loss, last: bool, steps: int) -> tuple[States, bool]:
        """Bring lines back from wrong minima, and return whether any process did; cameras are held.

        Lines are compared with those of their part.
        """
        robust = not isinstance(loss, Trivial)
        if not self.opened.has_lines or (last and not robust) or not steps:
            return states, False
        states, found = dict(states), False
        states |= {name: states[name].copy() for name in LANDMARKS if name in states}
        for part in self.opened.parts:
            if "lines" not in part.rows:
                continue
            scene, made = self.opened.assembled(part, states, loss)
            problem, moved = made.problem, []
            if not last:
                problem, renewed = with_held_states(problem, *renew_lines(scene, problem, self.options.threads))
                moved.append(renewed)
            if robust:
                problem, renewed = with_held_states(problem, *without_slips(problem, self.options.threads))
                moved.append(renewed)
            for name, rows in part.rows.items():
                states[name][rows] = problem.variables[name].state
            self.checkpoint.moved[part.rows["lines"]][np.concatenate(moved)] = True
            found = found or problem is not made.problem
        return states, any(exchange(self.reducer, found))

    def _wider(self, states: States, loss: Loss) -> float | None:
        """Return the scale of a loss, widened if residuals are noisier than it suggests; None: as it is."""
        if not isinstance(loss, GemanMcClure):
            return None
        count = np.zeros(BINS, np.int64)
        for part in self.opened.parts:
            squares = squared_residuals_px(self.opened.assembled(part, states)[1], weighted=True)
            for values in squares.values():
                logarithm = np.clip(np.log2(values[values > 0.0]), *BIN_RANGE)  # what cannot be evaluated is zero
                count += np.histogram(logarithm, BINS, BIN_RANGE)[0]
        count = np.sum(exchange(self.reducer, count.tolist()), axis=0)
        middle = int(np.searchsorted(np.cumsum(count), 0.5 * count.sum()))
        median = 2.0 ** (BIN_RANGE[0] + (middle + 0.5) * (BIN_RANGE[1] - BIN_RANGE[0]) / BINS)
        return max(loss.scale, STAGES.last_scale * float(np.sqrt(median / chi_square_gate(0.5, 2))))

    def _best_fit_of(self, solved: Solved) -> Similarity | None:
        """Return where measurements of other instruments fit best now, found by the process that has their part."""
        found, first = None, self.opened.paths[0]
        with agreed(self.reducer):
            for part in self.opened.parts if self.opened.reader.fits is not None else ():
                if part.path == first:
                    scene, made = self.opened.assembled(part, solved.states, solved.loss)
                    last = best_fit(disassemble(scene, made.problem))
                    assert last is not None
                    found = last.scale, last.rotation.tolist(), last.translation.tolist()
        told = next((one for one in exchange(self.reducer, found) if one), None)
        return None if told is None else Similarity(told[0], np.array(told[1]), np.array(told[2]))

    def write(self, solved: Solved, output: Path) -> Written:
        """Write the parts of this process; return squared residuals and relations of all parts."""
        own, opened, fits = {}, self.opened, self._best_fit_of(solved)
        with agreed(self.reducer):
            for part in opened.parts:
                scene, made = opened.assembled(part, solved.states, solved.loss)
                adjusted, relations = drop_failed_relations(disassemble(scene, made.problem), made.problem)
                if "lines" in part.rows and self.checkpoint.moved[part.rows["lines"]].any():
                    moved = np.flatnonzero(self.checkpoint.moved[part.rows["lines"]])
                    adjusted = with_seen_ends(adjusted, moved)
                if fits is not None:
                    adjusted = moved_to(adjusted, fits)
                if opened.reader.near is not None:
                    adjusted = adjusted.transformed(opened.reader.near.inverse())
                write_archive(adjusted, output / part.path.name, force=True)
                squares = squared_residuals_px(made)
                squares = {kind: [float(v.sum()), len(v)] for kind, v in squares.items()}
                own[part.path.name] = {"squares": squares, "relations": relations}
        told = {name: found for facts in exchange(self.reducer, own) for name, found in facts.items()}
        outcome: dict[str, dict[str, int]] = {}
        for path in opened.paths:
            for kind, counts in told[path.name]["relations"].items():
                total = outcome.setdefault(kind, dict.fromkeys(counts, 0))
                outcome[kind] = {name: total[name] + count for name, count in counts.items()}
        return Written([told[path.name]["squares"] for path in opened.paths], outcome)
