# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks of a growing map: arrays with room to grow, one row per point, line or plane.

A landmark is *pending* while it is followed in the images but its place is not known, *alive* when it is, and *dead*
after it was culled. Rows are never reused, so an index always means the same landmark.
"""

from __future__ import annotations

from typing import Any, ClassVar, Self

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray

PENDING, ALIVE, DEAD = 0, 1, 2
#: Samples of the extent kept for each plane (cost: time).
SAMPLES_KEPT = 64


def _column(*shape: int, dtype: type = np.float64, fill: float = 0.0) -> Any:
    """Declare a column: the shape of one row, the type of its numbers, and their first value."""
    return shape, dtype, fill


class _Growing:
    """Arrays of one length that double when they are full; every annotated attribute is a column."""

    columns: ClassVar[dict[str, tuple[tuple[int, ...], type, float]]]
    state: np.ndarray

    def __init_subclass__(cls) -> None:
        cls.columns = {name: getattr(cls, name) for name in cls.__annotations__}

    def __init__(self) -> None:
        self.count = 0
        self._arrays = {name: np.full((64, *shape), fill, dtype) for name, (shape, dtype, fill) in self.columns.items()}
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
        for name, (shape, dtype, fill) in self.columns.items():
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

    xyz: FloatArray = _column(3)
    state: np.ndarray = _column(dtype=np.int8, fill=PENDING)
    keyframe: IntArray = _column(dtype=np.int64, fill=-1)
    pixel: FloatArray = _column(2)
    first_keyframe: IntArray = _column(dtype=np.int64, fill=-1)
    first_pixel: FloatArray = _column(2)
    misses: IntArray = _column(dtype=np.int32)
    plane: IntArray = _column(dtype=np.int64, fill=-1)
    plane_sigma: FloatArray = _column()


class LineTable(_Growing):
    """Lines: place, the part that was seen, the strength of their edge in the image, and their plane."""

    plucker: FloatArray = _column(6)
    segment: FloatArray = _column(2, 3)
    state: np.ndarray = _column(dtype=np.int8, fill=PENDING)
    strength: FloatArray = _column()
    first_keyframe: IntArray = _column(dtype=np.int64, fill=-1)
    first_ends: FloatArray = _column(4)
    plane: IntArray = _column(dtype=np.int64, fill=-1)
    plane_sigma: FloatArray = _column()


class PlaneTable(_Growing):
    """Planes: place, samples of the part that was seen, and how many points support them.

    Those found in depth images count in how many; those found in points and lines of the map, in none.
    """

    hesse: FloatArray = _column(4)
    state: np.ndarray = _column(dtype=np.int8, fill=PENDING)
    samples: FloatArray = _column(SAMPLES_KEPT, 3, fill=np.nan)
    support: FloatArray = _column()
    found: IntArray = _column(dtype=np.int32)
    merged_into: IntArray = _column(dtype=np.int64, fill=-1)

    @property
    def of_landmarks(self) -> BoolArray:
        """Which planes with a place were found in points and lines, not in depth images."""
        return self.alive & (self.found == 0)

    def now(self, index: IntArray) -> IntArray:
        """Return the numbers of planes (n,) after some were merged into others."""
        while (merged := self.merged_into[index] >= 0).any():
            index = np.where(merged, self.merged_into[index], index)
        return index
