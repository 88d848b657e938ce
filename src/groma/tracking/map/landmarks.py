# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks of a growing map: arrays with room to grow, one row per point, line or plane.

A landmark is *pending* while it is followed in the images but its place is not known, *alive* when it is, and *dead*
after it was culled. Rows are never reused, so an index always means the same landmark.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray

PENDING, ALIVE, DEAD = 0, 1, 2


class _Growing:
    """Arrays of one length that double when they are full."""

    _columns: dict[str, tuple[tuple[int, ...], type, float]]
    state: np.ndarray

    def __init__(self) -> None:
        self.count = 0
        self._arrays = {
            name: np.full((64, *shape), fill, dtype) for name, (shape, dtype, fill) in self._columns.items()
        }
        self._show_rows()

    def __len__(self) -> int:
        return self.count

    def _show_rows(self) -> None:
        """Make the rows in use the attributes that are named as the columns."""
        for name, array in self._arrays.items():
            setattr(self, name, array[: self.count])

    def extend(self, count: int) -> IntArray:
        """Add ``count`` rows and return their indices."""
        need = self.count + count
        for name, (shape, dtype, fill) in self._columns.items():
            array = self._arrays[name]
            if need > len(array):
                larger = np.full((max(need, 2 * len(array)), *shape), fill, dtype)
                larger[: self.count] = array[: self.count]
                self._arrays[name] = larger
        rows = np.arange(self.count, need)
        self.count = need
        self._show_rows()
        return rows

    def copy(self) -> Self:
        """Return an independent copy."""
        out = type(self)()
        out.count, out._arrays = self.count, {name: array.copy() for name, array in self._arrays.items()}
        out._show_rows()
        return out

    @property
    def alive(self) -> BoolArray:
        """Which landmarks have a place."""
        return self.state == ALIVE


class PointTable(_Growing):
    """Points: place, where their patch is kept, how often they were missed, and the plane they lie on."""

    _columns = {  # noqa: RUF012
        "xyz": ((3,), np.float64, 0.0),
        "state": ((), np.int8, PENDING),
        "keyframe": ((), np.int64, -1),
        "pixel": ((2,), np.float64, 0.0),
        "first_keyframe": ((), np.int64, -1),
        "first_pixel": ((2,), np.float64, 0.0),
        "misses": ((), np.int32, 0),
        "plane": ((), np.int64, -1),
        "plane_sigma": ((), np.float64, 0.0),
    }
    xyz: FloatArray
    state: np.ndarray
    keyframe: IntArray
    pixel: FloatArray
    first_keyframe: IntArray
    first_pixel: FloatArray
    misses: IntArray
    plane: IntArray
    plane_sigma: FloatArray


class LineTable(_Growing):
    """Lines: place, the part that was seen, the strength of their edge in the image, and their plane."""

    _columns = {  # noqa: RUF012
        "plucker": ((6,), np.float64, 0.0),
        "segment": ((2, 3), np.float64, 0.0),
        "state": ((), np.int8, PENDING),
        "strength": ((), np.float64, 0.0),
        "first_keyframe": ((), np.int64, -1),
        "first_ends": ((4,), np.float64, 0.0),
        "plane": ((), np.int64, -1),
        "plane_sigma": ((), np.float64, 0.0),
    }
    plucker: FloatArray
    segment: FloatArray
    state: np.ndarray
    strength: FloatArray
    first_keyframe: IntArray
    first_ends: FloatArray
    plane: IntArray
    plane_sigma: FloatArray


class PlaneTable(_Growing):
    """Planes: place, samples of the part that was seen, and how many points support them.

    Those found in depth images count in how many; those found in points and lines of the map, in none.
    """

    #: Samples of the extent kept for each plane.
    samples_kept = 64
    _columns = {  # noqa: RUF012
        "hesse": ((4,), np.float64, 0.0),
        "state": ((), np.int8, PENDING),
        "samples": ((samples_kept, 3), np.float64, np.nan),
        "support": ((), np.float64, 0.0),
        "found": ((), np.int32, 0),
        "merged_into": ((), np.int64, -1),
    }
    hesse: FloatArray
    state: np.ndarray
    samples: FloatArray
    support: FloatArray
    found: IntArray
    merged_into: IntArray

    @property
    def of_landmarks(self) -> BoolArray:
        """Which planes with a place were found in points and lines, not in depth images."""
        return self.alive & (self.found == 0)


@dataclass(frozen=True)
class MapView:
    """The landmarks that measurements refer to; arrays are read, not kept."""

    points: PointTable
    lines: LineTable
    planes: PlaneTable
