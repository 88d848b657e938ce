# SPDX-License-Identifier: BSD-3-Clause
"""What a pose leaves of its matches, in standard deviations; and which of them have a pull on it.

Each match has a landmark of its own. What is far is not noise, and says nothing about the pose: under a noise that is
normal for the right matches and uniform over the image for the wrong ones, the cost of a match stops growing where both
are about as likely, and there its pull ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.localization.pose.one_pose import OnePose


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
        known = more > 0 and part.has_lens
        record = one.records(part, "pose", *(["lens"] if known else []))
        white = weight @ record
        seen = (record != 0.0).any(axis=(1, 2))  # what cannot be evaluated is zero
        rows = part.row
        value[rows[seen]] = white[seen, :, -1]
        by_pose[rows[seen], :, :6] = white[seen][:, :, :6]
        if known:
            by_pose[rows[seen], :, 6:] = white[seen][:, :, 6:-1] @ lens
        spread[rows] = 1.0 / np.abs(weight[:, 0, 0] * weight[:, 1, 1] - weight[:, 0, 1] * weight[:, 1, 0])
    return Residuals(value, by_pose, spread)
