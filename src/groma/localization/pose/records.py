# SPDX-License-Identifier: BSD-3-Clause
"""What factors say of a problem at its states: derivatives by one kind of variable, and covariances of landmarks."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.factors.contract import Factor
from groma.factors.losses import GemanMcClure
from groma.gates import NORMAL
from groma.problem.problem import Problem

#: Loss that landmarks of a map are estimated with in the end (convention: three standard deviations).
LANDMARK_LOSS = GemanMcClure(NORMAL.far)


def landmark_rows(factor: Factor, group: str) -> IntArray | None:
    """The landmarks of a factor; None if it is of another kind."""
    return next((ref.index for _, ref in factor.references() if ref.group == group), None)


def records(problem: Problem, factor: Factor, wanted: Mapping[str, int]) -> FloatArray:
    """Derivatives by slots of so many coordinates, side by side, and the residual in the last column; not whitened."""
    return records_at(
        {ref.group: problem.variables[ref.group].ambient() for _, ref in factor.references()}, factor, wanted
    )


def records_at(ambients: Mapping[str, FloatArray], factor: Factor, wanted: Mapping[str, int]) -> FloatArray:
    """Return :func:`records` where what factors read of each group of variables is known."""
    begin, place = {}, 0
    for slot, size in wanted.items():
        begin[slot], place = place, place + size
    references = factor.references()
    columns = tuple(begin.get(own.name, -1) for own, _ in references)
    record = np.zeros((len(factor), factor.residual_size, place + 1))
    inputs = factor.prepare(tuple(ambients[ref.group] for _, ref in references))
    factor.linearize(inputs, 0, len(factor), columns, record)
    return record


def times(weight: float | FloatArray, record: FloatArray) -> FloatArray:
    """Records (n, 2, m) multiplied by the inverse noise of a factor: a number, (n,) of them, or (n, 2, 2) matrices."""
    weight = np.asarray(weight)
    return weight @ record if weight.ndim == 3 else weight.reshape(-1, 1, 1) * record


def residual_squares(problem: Problem, group: str, count: int) -> FloatArray:
    """Squared whitened residuals (count,) of the observations of one kind, in the order of the factors; zero where a
    residual cannot be evaluated.
    """
    parts = [
        (times(factor.sqrt_information, records(problem, factor, {"pose": 6}))[..., 6] ** 2).sum(axis=1)
        for factor in problem.factors
        if landmark_rows(factor, group) is not None
    ]
    return np.concatenate([np.zeros(0), *parts])[:count]


def landmark_covariances(problem: Problem, group: str, count: int) -> FloatArray:
    """Covariances of points (count, 3, 3), or of (moment, direction) of lines (count, 6, 6) with a unit direction, from
    their observations with the poses held; NaN for those that are not determined.
    """
    size = 3 if group == "points" else 6
    total = np.zeros((count, size, size))
    for factor in problem.factors:
        rows = landmark_rows(factor, group)
        if rows is None:
            continue
        record = records(problem, factor, {group[:-1]: size})
        white = times(factor.sqrt_information, record)
        J, weight = white[..., :size], LANDMARK_LOSS.evaluate((white[..., size] ** 2).sum(axis=1))[1]
        np.add.at(total, rows, np.einsum("n,nki,nkj->nij", weight, J, J))
    free = np.broadcast_to(np.eye(3), (count, 3, 3))
    if group == "lines":
        free = motions_of_lines(problem.variables[group].ambient()[:count])
    inside = np.swapaxes(free, 1, 2) @ total @ free
    values = np.linalg.eigvalsh(inside) if count else np.zeros((0, 1))
    good = values[:, 0] > 1e-12 * values[:, -1]
    found = np.full((count, size, size), np.nan)
    found[good] = free[good] @ np.linalg.inv(inside[good]) @ np.swapaxes(free[good], 1, 2)
    return found


def motions_of_lines(lines: FloatArray) -> FloatArray:
    """Bases (L, 6, 4) of the motions of (m, d) that keep the direction's length and m . d = 0."""
    m, d = lines[:, :3], lines[:, 3:]
    zero = np.zeros_like(d)
    held = np.stack([np.hstack([zero, d]), np.hstack([d, m])], axis=1)
    return np.swapaxes(np.linalg.svd(held)[2][:, 2:], 1, 2)
