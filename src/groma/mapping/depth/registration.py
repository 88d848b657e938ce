# SPDX-License-Identifier: BSD-3-Clause
"""Depth maps that belong to other pixels than those of their photographs: registered to another camera, or not at all.

In come the depths of points of a model, which the photographs alone tell, and depths of the maps where these points are
seen and some pixels beside; out comes a sentence, or none. Maps that are shifted fit better beside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.gates import NORMAL, gate


@dataclass(frozen=True)
class RegistrationGates:
    """When depth maps are shifted."""

    shares: tuple[float, ...] = gate(
        (0.005, 0.01, 0.02, 0.04), "widths", "by which depths are looked up beside", "convention: 3 to 26 of 640 pixels"
    )
    min_share: float = gate(
        0.01, "widths", "of a shift that is told",
        "chosen on the TUM cabinet, whose maps fit best shifted by 4 of 640 pixels as they come",
    )  # fmt: skip
    gain: float = gate(0.1, "share", "by which deviations fall there", "convention: a tenth")
    sample: int = gate(500, "points", "of an image that are looked up", "cost: time")


GATES = RegistrationGates()
#: (S, 2) where depths are looked up, widths of the image: where they belong, then left, right, above and below.
BESIDE = np.vstack([
    np.zeros((1, 2)),
    *([[-share, 0.0], [share, 0.0], [0.0, -share], [0.0, share]] for share in GATES.shares),
])  # fmt: skip


def sample(count: int) -> slice:
    """Return which of the points that an image sees are looked up, evenly."""
    return slice(None, None, max(1, count // GATES.sample))


def shifted_maps(measured: FloatArray, predicted: FloatArray, width: float) -> list[str]:
    """Return a sentence where depth maps fit better beside the pixels that they are taken for.

    Parameters
    ----------
    measured : (S, n) float64
        Depths in the maps at the places :data:`BESIDE` n observations of points; NaN where unknown.
    predicted : (n,) float64
        Depths of the points by the photographs alone, in any unit.
    width : float
        Of an image, pixels, for the sentence.
    """
    known = np.where(predicted > 0.0, predicted, np.nan)
    level = np.full(measured.shape, np.nan)
    np.log(measured / known, out=level, where=np.isfinite(known) & (measured > 0.0))
    both = np.isfinite(level) & np.isfinite(level[0])
    best, least = 0, 1.0 - GATES.gain
    for row in np.flatnonzero(both.any(1) & (np.abs(BESIDE).max(1) > 0.0)):
        here, beside = (np.abs(values - np.median(values)) for values in (level[0, both[row]], level[row, both[row]]))
        better, worse = int((beside < here).sum()), int((beside > here).sum())
        gain = float(np.median(beside)) / max(float(np.median(here)), 1e-12)
        if gain < least and better - worse > NORMAL.sure * np.sqrt(better + worse):
            best, least = int(row), gain
    if np.abs(BESIDE[best]).max() < GATES.min_share:
        return []
    x, y = -BESIDE[best] * width
    where = f"by about {abs(x):.0f} pixels to the {'right' if x > 0.0 else 'left'}" if x else ""
    where = where or f"by about {abs(y):.0f} pixels {'down' if y > 0.0 else 'up'}"
    return [
        f"The depth maps fit the photographs better when shifted {where}: the deviations of depths fall by "
        f"{100 * (1.0 - least):.0f} %. They may be those of another camera, and then bend the map. Register them to "
        "the photographs, or leave them out."
    ]
