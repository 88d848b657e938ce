# SPDX-License-Identifier: BSD-3-Clause
"""What a pose leaves of its matches, in standard deviations; and which of them have a pull on it.

Each match has a landmark of its own. What is far is not noise, and says nothing about the pose: under a noise that is
normal for the right matches and uniform over the image for the wrong ones, the cost of a match stops growing where both
are about as likely, and there its pull ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.factors.contract import Factor
from groma.localization.pose.matches import Matches
from groma.localization.pose.records import landmark_rows, records, times
from groma.problem.problem import Problem


@dataclass(frozen=True, eq=False)
class Residuals:
    """What a pose leaves of the matches, in standard deviations, and what it says about the pose."""

    #: (n, 2) whitened residuals, NaN where a match has no image; (n, 2, 6 + k) their derivatives by the left twist, and
    #: by what is estimated of the lens.
    value: FloatArray
    by_pose: FloatArray
    #: (n,) square pixels of an ellipse of one standard deviation, over pi: root of the determinant of the noise.
    spread: FloatArray

    @property
    def square(self) -> FloatArray:
        """(n,) squared lengths; infinite where a match has no image."""
        square = (self.value**2).sum(axis=1)
        return np.where(np.isfinite(square), square, np.inf)


def residuals(problem: Problem, landmarks: str, count: int, lens: Sequence[int] = ()) -> Residuals:
    """Whitened residuals of the matches of one kind, ``points`` or ``lines``; each match has a landmark of its own.

    ``lens`` are the parameters of the camera that are estimated, too.
    """
    value, by_pose, spread = np.full((count, 2), np.nan), np.zeros((count, 2, 6 + len(lens))), np.ones(count)
    for factor in problem.factors:
        rows = landmark_rows(factor, landmarks)
        if rows is None:
            continue
        size = next(
            (problem.variables[r.group].manifold.dof for slot, r in factor.references() if slot.name == "intrinsics"), 0
        )
        record = records(problem, factor, {"pose": 6, "intrinsics": size} if lens and size else {"pose": 6})
        kept = [*range(6), *(6 + k for k in lens if size)]
        weight = np.broadcast_to(times(factor.sqrt_information, np.eye(2)[None]), (len(factor), 2, 2))
        white = weight @ record
        seen = (record != 0.0).any(axis=(1, 2))  # what cannot be evaluated is zero
        value[rows[seen]] = white[seen, :, -1]
        by_pose[rows[seen], :, : len(kept)] = white[seen][:, :, kept]
        spread[rows] = 1.0 / np.abs(weight[:, 0, 0] * weight[:, 1, 1] - weight[:, 0, 1] * weight[:, 1, 0])
    return Residuals(value, by_pose, spread)


def residual_squares_of(problem: Problem, matches: Matches) -> tuple[FloatArray, FloatArray]:
    """Squared whitened residuals (N,) of points and (M,) of lines; infinite where a match has no image."""
    found = []
    for name, count in (("points", matches.num_points), ("lines", matches.num_lines)):
        square = np.full(count, np.inf)
        for factor in problem.factors:
            rows = landmark_rows(factor, name)
            if rows is not None:
                white = times(factor.sqrt_information, records(problem, factor, {}))[..., 0]
                square[rows] = (white**2).sum(axis=1)
        found.append(np.where(square > 0.0, square, np.inf))  # what cannot be evaluated is zero
    return found[0], found[1]


def without_far(problem: Problem, near: tuple[BoolArray, BoolArray]) -> Problem:
    """Return a problem in which the matches that are not near, of points and of lines, have no weight."""
    kept: dict[str, BoolArray] = dict(zip(("points", "lines"), near, strict=True))
    return Problem(problem.variables, [_of_near(factor, kept) for factor in problem.factors])


def _of_near(factor: Factor, near: dict[str, BoolArray]) -> Factor:
    for name, kept in near.items():
        rows = landmark_rows(factor, name)
        if rows is not None and not kept.all():
            weight = times(factor.sqrt_information, np.eye(2)[None])
            return replace(factor, sqrt_information=np.where(kept[rows, None, None], weight, 0.0))
    return factor
