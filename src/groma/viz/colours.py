# SPDX-License-Identifier: BSD-3-Clause
"""Colours of numbers, of directions, and of things to be told apart."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.scene.patches import PALETTE

if TYPE_CHECKING:
    from groma.scene import Scene

Colours = npt.NDArray[np.uint8]

#: The ramp of all pictures of groma: blue is low, red is high.
RAMP = np.array([[44, 111, 187], [63, 182, 168], [232, 197, 58], [217, 71, 43]], float)
#: For what has no number.
GREY = np.array([150, 152, 156], np.uint8)


def ramp(share: npt.ArrayLike) -> Colours:
    """Colours (..., 3) of numbers from 0 to 1; numbers outside are clipped, NaN is grey."""
    value = np.asarray(share, float)
    known = np.isfinite(value)
    place = np.clip(np.where(known, value, 0.0), 0.0, 1.0) * (len(RAMP) - 1)
    left = np.minimum(place.astype(int), len(RAMP) - 2)
    part = (place - left)[..., None]
    colour = np.round(RAMP[left] * (1 - part) + RAMP[left + 1] * part).astype(np.uint8)
    return np.where(known[..., None], colour, GREY)


def of_group(group: IntArray) -> Colours:
    """Colours (..., 3) of groups 0, 1, ...; they repeat after eight; negative numbers are grey."""
    return np.where((group >= 0)[..., None], PALETTE[group % len(PALETTE)], GREY)


def of_lines(scene: Scene) -> Colours:
    """Colours (L, 3) of lines by the direction that they share with others; where none is shared, by their own."""
    along = scene.relations.line_along_direction
    if not len(along):
        return of_direction(scene.lines.plucker[:, 3:])
    group = np.full(scene.num_lines, -1)
    group[along[:, 0]] = along[:, 1]
    return of_group(group)


def of_direction(vectors: FloatArray) -> Colours:
    """Colours (..., 3) of unit vectors of any sign: red along x, green along y, blue along z."""
    return np.round(40 + 200 * np.abs(vectors)).astype(np.uint8)


def css(colour: Colours) -> str:
    """One colour (3,) as ``#rrggbb``."""
    return "#{:02x}{:02x}{:02x}".format(*(int(channel) for channel in colour))
