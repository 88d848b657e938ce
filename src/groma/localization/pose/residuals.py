# SPDX-License-Identifier: BSD-3-Clause
"""What a pose leaves of its matches, in standard deviations; and which of them have a pull on it.

Each match has a landmark of its own. What is far is not noise, and says nothing about the pose: under a noise that is
normal for the right matches and uniform over the image for the wrong ones, the cost of a match stops growing where both
are about as likely, and there its pull ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from groma._numba import loop
from groma._typing import FloatArray
from groma.localization.pose.one_pose import OnePose


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _whiten(record, weight, lens, rows, value, by_pose, spread):
    """Whiten records, those of parameters along the directions of the lens; what cannot be evaluated is left."""
    last = record.shape[2] - 1
    for n in range(record.shape[0]):
        row, seen = rows[n], False
        for i in range(2):
            for j in range(last + 1):
                seen = seen or record[n, i, j] != 0.0
        a, b, c, d = weight[n, 0, 0], weight[n, 0, 1], weight[n, 1, 0], weight[n, 1, 1]
        spread[row] = 1.0 / abs(a * d - b * c)
        if not seen:
            continue
        value[row, 0] = a * record[n, 0, last] + b * record[n, 1, last]
        value[row, 1] = c * record[n, 0, last] + d * record[n, 1, last]
        for j in range(last):
            u, v = record[n, 0, j], record[n, 1, j]
            if j < 6:
                by_pose[row, 0, j], by_pose[row, 1, j] = a * u + b * v, c * u + d * v
                continue
            for k in range(lens.shape[1]):
                by_pose[row, 0, 6 + k] += (a * u + b * v) * lens[j - 6, k]
                by_pose[row, 1, 6 + k] += (c * u + d * v) * lens[j - 6, k]


# ----------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class Residuals:
    """What a pose leaves of the matches, in standard deviations, and what it says about the pose."""

    #: (n, 2) whitened residuals, NaN where a match has no image; (n, 2, 6 + k) their derivatives by the left twist, and
    #: by what is estimated of the lens.
    value: FloatArray
    by_pose: FloatArray
    #: (n,) square pixels of an ellipse of one standard deviation, over pi: root of the determinant of the noise.
    spread: FloatArray

    @cached_property
    def square(self) -> FloatArray:
        """(n,) squared lengths; infinite where a match has no image."""
        square = (self.value**2).sum(axis=1)
        return np.where(np.isfinite(square), square, np.inf)


def residuals(
    one: OnePose, weights: Sequence[FloatArray], landmarks: str, count: int, lens: FloatArray | None = None
) -> Residuals:
    """Whitened residuals of the matches of one kind, ``points`` or ``lines``; each match has a landmark of its own.

    ``weights`` are the inverse noise of the factors, ``lens`` (p, k) the directions in which parameters of the camera
    are estimated, too.
    """
    lens = np.zeros((0, 0)) if lens is None else lens
    more = lens.shape[1]
    value, by_pose, spread = np.full((count, 2), np.nan), np.zeros((count, 2, 6 + more)), np.ones(count)
    for part, weight in zip(one.parts, weights, strict=True):
        if part.kind != landmarks:
            continue
        record = one.records(part, "pose", *(["lens"] if more and part.has_lens else []))
        _whiten(record, np.ascontiguousarray(weight), lens, part.row, value, by_pose, spread)
    return Residuals(value, by_pose, spread)
