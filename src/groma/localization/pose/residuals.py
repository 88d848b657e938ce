# SPDX-License-Identifier: BSD-3-Clause
"""What a pose leaves of its matches, in standard deviations; and which of them have a pull on it.

Each match has a landmark of its own. What is far is not noise, and says nothing about the pose: under a noise that is
normal for the right matches and uniform over the image for the wrong ones, the cost of a match stops growing where both
are about as likely, and there its pull ends.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.factors.contract import Factor
from groma.localization.pose.matches import Matches
from groma.localization.pose.records import landmark_rows, records
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


def residuals(
    problem: Problem, weights: Sequence[FloatArray], landmarks: str, count: int, lens: FloatArray | None = None
) -> Residuals:
    """Whitened residuals of the matches of one kind, ``points`` or ``lines``; each match has a landmark of its own.

    ``weights`` are the inverse noise of the factors, ``lens`` (p, k) the directions in which parameters of the camera
    are estimated, too.
    """
    lens = np.zeros((0, 0)) if lens is None else lens
    more = lens.shape[1]
    value, by_pose, spread = np.full((count, 2), np.nan), np.zeros((count, 2, 6 + more)), np.ones(count)
    for factor, weight in zip(problem.factors, weights, strict=True):
        rows = landmark_rows(factor, landmarks)
        if rows is None:
            continue
        known = more > 0 and any(slot.name == "intrinsics" for slot, _ in factor.references())
        record = records(problem, factor, {"pose": 6, "intrinsics": len(lens)} if known else {"pose": 6})
        white = weight @ record
        seen = (record != 0.0).any(axis=(1, 2))  # what cannot be evaluated is zero
        value[rows[seen]] = white[seen, :, -1]
        by_pose[rows[seen], :, :6] = white[seen][:, :, :6]
        if known:
            by_pose[rows[seen], :, 6:] = white[seen][:, :, 6:-1] @ lens
        spread[rows] = 1.0 / np.abs(weight[:, 0, 0] * weight[:, 1, 1] - weight[:, 0, 1] * weight[:, 1, 0])
    return Residuals(value, by_pose, spread)


def residual_squares_of(
    problem: Problem, weights: Sequence[FloatArray], matches: Matches
) -> tuple[FloatArray, FloatArray]:
    """Squared whitened residuals (N,) of points and (M,) of lines; infinite where a match has no image."""
    found = []
    for name, count in (("points", matches.num_points), ("lines", matches.num_lines)):
        square = np.full(count, np.inf)
        for factor, weight in zip(problem.factors, weights, strict=True):
            rows = landmark_rows(factor, name)
            if rows is not None:
                square[rows] = ((weight @ records(problem, factor, {}))[..., 0] ** 2).sum(axis=1)
        found.append(np.where(square > 0.0, square, np.inf))  # what cannot be evaluated is zero
    return found[0], found[1]


def weighted_near(problem: Problem, weights: Sequence[FloatArray], near: tuple[BoolArray, BoolArray]) -> Problem:
    """Return a problem with other weights; matches that are not near, of points and of lines, have none."""
    kept: dict[str, BoolArray] = dict(zip(("points", "lines"), near, strict=True))
    factors = [
        replace(factor, sqrt_information=np.where(near_of(factor, kept)[:, None, None], weight, 0.0))
        for factor, weight in zip(problem.factors, weights, strict=True)
    ]
    return Problem(problem.variables, factors)


def near_of(factor: Factor, near: Mapping[str, BoolArray]) -> BoolArray:
    """Which rows of a factor are near, of the matches of each kind that are."""
    for name, kept in near.items():
        rows = landmark_rows(factor, name)
        if rows is not None:
            return kept[rows]
    return np.ones(len(factor), bool)
