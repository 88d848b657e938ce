# SPDX-License-Identifier: BSD-3-Clause
"""Gross errors among measurements: taken out, and accepted again where they fit without each other.

A robust loss limits what a wrong measurement does; it goes on pulling, and makes its neighbours look wrong, too. So
the worst of what the test calls gross errors (:func:`~groma.adjustment.survey.records.gross_errors`) are rejected
together, the scene is adjusted without them, each is tested against what is left, and the next are taken. Those that
fit take part again, once for all, and so do those without which hardly anything checks others: of two scale bars that
contradict each other nobody knows which is wrong, and both keep what the loss leaves them. Nothing is rejected without
which less of the scene's place, turn and scale would be known, nor the second last mark of a point whose coordinates
take no part: its place would be open.

References: W. Baarda, *A testing procedure for use in geodetic networks*, 1968; W. Foerstner, *Reliability and
discernability of extended Gauss-Markov models*, 1983, on tests that are correlated.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from groma.adjustment.report import AdjustResult
from groma.adjustment.stages import keeps_loss
from groma.adjustment.survey.records import GATES, Reliability, gross_errors, rejection_limit
from groma.adjustment.survey.reliability import reliability
from groma.adjustment.terms.open_motions import num_open_motions
from groma.errors import ProblemError
from groma.factors.losses import Huber
from groma.problem.problem import Problem
from groma.scene import Scene
from groma.scene.survey import accepted, rejected_rows, with_rejected

#: Standard deviations that no residual has.
_NEVER = 1e12


def without_gross_errors(
    result: AdjustResult, adjust_again: Callable[[Scene], AdjustResult]
) -> tuple[AdjustResult, Reliability | None]:
    """Reject gross errors of measurements, and adjust without them.

    Parameters
    ----------
    result : AdjustResult
        An adjustment with all measurements.
    adjust_again : callable
        Adjusts a scene with other rejected measurements.

    Returns
    -------
    result, reliability
        The last adjustment, of a scene whose tables mark rejected rows, and the tests of the measurements; None
        where the poses are not determined.
    """
    found = reliability_of(result.scene, result.problem)
    returned: set[tuple[str, int]] = set()
    for _ in range(GATES.max_rounds):
        if found is None:
            break
        before = rejected_rows(result.scene)
        wrong = gross_errors(found.measurements)
        returned |= before - wrong.keys()
        kept = before & wrong.keys()
        doubted = _worst(result.scene, {place: size for place, size in wrong.items() if place not in returned | before})
        if kept | doubted == before:
            break
        if needed := _needed(result.scene, kept, doubted):
            returned |= needed
            continue
        again = adjust_again(with_rejected(result.scene, kept | doubted))
        if (told := reliability_of(again.scene, again.problem)) is None:
            break
        full = reliability_of(result.scene, _at_full_weight(result.problem))
        if doubted and (unclear := _no_longer_checked(full, told, min(wrong[place] for place in doubted))):
            returned |= {place for place in doubted if place[0] in unclear} or doubted
        else:
            result, found = again, told
    return result, found


def _worst(scene: Scene, wrong: dict[tuple[str, int], float]) -> set[tuple[str, int]]:
    """Return the worst of each table, and one mark of a point; the others may be affected by these."""
    most = {table: max(size for (of, _), size in wrong.items() if of == table) for table, _ in wrong}
    found: dict[tuple[str, int], tuple[str, int]] = {}
    for place, size in sorted(wrong.items(), key=lambda one: -one[1]):
        point = ("point", int(scene.marks.point_idx[place[1]])) if place[0] == "marks" else place
        if size >= GATES.at_once * most[place[0]]:
            found.setdefault(point, place)
    return set(found.values())


def _needed(scene: Scene, rejected: set[tuple[str, int]], doubted: set[tuple[str, int]]) -> set[tuple[str, int]]:
    """Return what of the doubted the place, turn and scale of the scene need, tables as a whole, or a point."""
    if lonely := _second_last(scene, rejected | doubted) & doubted:
        return lonely
    known = num_open_motions(with_rejected(scene, ()))

    def opens(rows: set[tuple[str, int]]) -> bool:
        return num_open_motions(with_rejected(scene, rejected | rows)) > known

    parts = [{place for place in doubted if place[0] == table} for table in {table for table, _ in doubted}]
    needed = [part for part in parts if opens(part)]
    if not needed and opens(doubted):
        return doubted
    return set().union(*needed)


def _second_last(scene: Scene, rejected: set[tuple[str, int]]) -> set[tuple[str, int]]:
    """Return the rejected marks of points that are left with fewer than two, and without coordinates."""
    left = accepted(with_rejected(scene, rejected))
    count = np.bincount(left.marks.point_idx, minlength=len(left.control_points))
    open_ = np.flatnonzero((count < 2) & ~left.control_points.is_control)
    rows = np.flatnonzero(np.isin(scene.marks.point_idx, open_)).tolist()
    return {("marks", row) for row in rows} & rejected


def _no_longer_checked(before: Reliability | None, after: Reliability, size: float) -> set[str]:
    """Return the tables of measurements that may be wrong in place of what was rejected.

    If the tests of two measurements have the correlation rho, one has 1 - rho^2 of its redundancy without the other.
    With the first rejected in place of the second, the normalised residual w of that is w sqrt(1 - rho^2): if this is
    still beyond the limit, it is not the first that is wrong.
    """
    if before is None:
        return set()
    share = {(one.table_row, one.coordinate): one.redundancy for one in before.measurements}
    pairs = [(one, share[one.table_row, one.coordinate]) for one in after.measurements if not one.is_rejected]
    least = (rejection_limit(after.measurements) / size) ** 2
    return {one.table_row[0] for one, had in pairs if had > GATES.checked and one.redundancy < least * had}


def _at_full_weight(problem: Problem | None) -> Problem | None:
    """Return the problem with full weights of the measurements, for their redundancy numbers."""
    if problem is None:
        return None
    return problem.with_losses([
        Huber(_NEVER) if keeps_loss(factor) and isinstance(factor.loss, Huber) else factor.loss
        for factor in problem.factors
    ])  # fmt: skip


def reliability_of(scene: Scene, problem: Problem | None) -> Reliability | None:
    """Return :func:`~groma.adjustment.survey.reliability.reliability`; None where the poses are not determined."""
    try:
        return reliability(scene, problem)
    except ProblemError:
        return None
