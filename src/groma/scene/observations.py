# SPDX-License-Identifier: BSD-3-Clause
"""Points and segments found in the images, and which landmarks belong together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.scene.table import Table, check_sigma, column, convert, rows_of

#: How the standard deviations of relations are called, after the column that holds the relations.
_SIGMA = "_sigma"


@dataclass(frozen=True, eq=False)
class PointObservations(Table, noun="observation"):
    """A point seen in an image. Pixel (0.5, 0.5) is the centre of the first pixel."""

    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N,) the point.
    point_idx: IntArray = column(np.int64, refers="points")
    #: (N, 2) measured place, pixels.
    pixel: FloatArray = column(np.float64, 2)
    #: (N,) number of the 2D point within its image (COLMAP's ``point2D_idx``).
    keypoint_idx: IntArray = column(np.int64)
    #: (N,) standard deviation of a coordinate, relative to the usual one; 1 if left out.
    sigma: FloatArray = column(np.float64, fill=1.0, check=check_sigma)

    @classmethod
    def numbered(
        cls, image_idx: npt.ArrayLike, point_idx: npt.ArrayLike, pixel: npt.ArrayLike, sigma: npt.ArrayLike = ()
    ) -> Self:
        """Return observations whose 2D points are numbered 0, 1, 2, ... within each image, in the order given.

        Parameters
        ----------
        image_idx, point_idx : (N,) int
            The image and the point of each.
        pixel : (N, 2) float
            Measured places, pixels.
        sigma : (N,) float, optional
            Standard deviations, relative to the usual one.
        """
        image = np.asarray(image_idx)
        order = np.argsort(image, kind="stable")
        number = np.empty(len(order), np.int64)
        number[order] = np.arange(len(order)) - np.searchsorted(image[order], image[order])
        return cls(image, point_idx, pixel, number, sigma)  # type: ignore[arg-type]  # columns are converted


@dataclass(frozen=True, eq=False)
class Keypoints(Table, noun="keypoint"):
    """2D points that belong to no 3D point; carried along so that a model is written back whole."""

    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N, 2) place, pixels.
    pixel: FloatArray = column(np.float64, 2)
    #: (N,) number of the 2D point within its image.
    keypoint_idx: IntArray = column(np.int64)


@dataclass(frozen=True, eq=False)
class LineObservations(Table, noun="observation"):
    """A line seen in an image as a segment."""

    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N,) the line.
    line_idx: IntArray = column(np.int64, refers="lines")
    #: (N, 4) end points u1 v1 u2 v2 of the detected segment, pixels; no correspondence with the 3D end points.
    segment: FloatArray = column(np.float64, 4)
    #: (N,) standard deviation of an end point across the segment, relative to the usual one; 1 if left out.
    sigma: FloatArray = column(np.float64, fill=1.0, check=check_sigma)
    #: (N,) gradient of the segment over that of the image beside it; 0 where it is not known.
    contrast: FloatArray = column(np.float64, fill=0.0)


@dataclass(frozen=True, eq=False)
class Relations:
    """Structural relations between landmarks: (R, 2) index pairs, first and second landmark by the names.

    Each kind may have standard deviations, one for each pair: how far the first is off the second, in scene units;
    angles in radians. Where one is 0 it follows from the noise of the images (see
    :class:`groma.adjustment.assembly_options.AssemblyOptions`).
    """

    #: (R, 2) point, plane.
    point_on_plane: IntArray = column(np.int64, 2, refers=("points", "planes"))
    #: (R, 2) line, plane.
    line_on_plane: IntArray = column(np.int64, 2, refers=("lines", "planes"))
    #: (R, 2) line, direction.
    line_along_direction: IntArray = column(np.int64, 2, refers=("lines", "directions"))
    #: (R, 2) point, line.
    point_on_line: IntArray = column(np.int64, 2, refers=("points", "lines"))
    #: (R, 2) line, line.
    lines_meeting: IntArray = column(np.int64, 2, refers=("lines", "lines"), optional=True)
    #: (R, 2) plane, plane.
    parallel_planes: IntArray = column(np.int64, 2, refers=("planes", "planes"), optional=True)
    #: (R, 2) plane, plane.
    perpendicular_planes: IntArray = column(np.int64, 2, refers=("planes", "planes"), optional=True)
    #: (R, 2) direction, direction.
    parallel_directions: IntArray = column(np.int64, 2, refers=("directions", "directions"), optional=True)
    #: (R, 2) direction, direction.
    perpendicular_directions: IntArray = column(np.int64, 2, refers=("directions", "directions"), optional=True)
    #: (R, 2) plane, direction: its normal is along the direction.
    plane_across_direction: IntArray = column(np.int64, 2, refers=("planes", "directions"), optional=True)
    #: (R, 2) plane, direction: it contains the direction.
    plane_along_direction: IntArray = column(np.int64, 2, refers=("planes", "directions"), optional=True)
    #: (R,) standard deviations: distance from the plane, also of the ends of a line; angle; distance from the line.
    point_on_plane_sigma: FloatArray = column(np.float64, fill=0.0, length=1)
    line_on_plane_sigma: FloatArray = column(np.float64, fill=0.0, length=1)
    line_along_direction_sigma: FloatArray = column(np.float64, fill=0.0)
    point_on_line_sigma: FloatArray = column(np.float64, fill=0.0, length=1)
    lines_meeting_sigma: FloatArray = column(np.float64, fill=0.0, length=1)
    parallel_planes_sigma: FloatArray = column(np.float64, fill=0.0)
    perpendicular_planes_sigma: FloatArray = column(np.float64, fill=0.0)
    parallel_directions_sigma: FloatArray = column(np.float64, fill=0.0)
    perpendicular_directions_sigma: FloatArray = column(np.float64, fill=0.0)
    plane_across_direction_sigma: FloatArray = column(np.float64, fill=0.0)
    plane_along_direction_sigma: FloatArray = column(np.float64, fill=0.0)

    def __post_init__(self) -> None:
        for item in fields(self):
            value = convert(f"Relations.{item.name}", getattr(self, item.name), item)
            if item.name.endswith(_SIGMA):
                count = len(getattr(self, item.name.removesuffix(_SIGMA)))
                value = value if value.any() else np.zeros(count)  # all zero: as if left out
                if len(value) != count:
                    raise ShapeError(f"Relations.{item.name} must have one row for each of {count}; got {len(value)}.")
                if count and value.min() < 0.0:
                    raise InputError(f"Relations.{item.name} must not be negative; got {value.min()}.")
            object.__setattr__(self, item.name, value)

    def __len__(self) -> int:
        return sum(len(getattr(self, name)) for name in self.kinds())

    @classmethod
    def kinds(cls) -> tuple[str, ...]:
        """Return the names of the columns that hold pairs."""
        return tuple(item.name for item in fields(cls) if not item.name.endswith(_SIGMA))

    def sigma(self, kind: str) -> FloatArray:
        """Return the standard deviations (R,) of one kind; 0: by the noise of the images."""
        return getattr(self, f"{kind}_sigma")

    def take(self, **rows: npt.ArrayLike) -> Self:
        """Return the relations with the chosen rows (indices or a mask) of some kinds, and all of the others."""
        columns = {}
        for kind, chosen in rows.items():
            pairs = getattr(self, kind)
            kept = rows_of(f"rows of Relations.{kind}", chosen, len(pairs), "relations")
            columns |= {kind: pairs[kept], f"{kind}_sigma": self.sigma(kind)[kept]}
        return replace(self, **columns)

    def renumbered(self, new_index: Mapping[str, IntArray]) -> tuple[Self, None]:
        """See :meth:`groma.scene.table.Table.renumbered`."""
        moved, kept = {}, {}
        for item in fields(self):
            refers = item.metadata["refers"]
            if not new_index.keys() & set(refers):
                continue
            pairs = getattr(self, item.name).copy()
            for side, table in enumerate(refers):
                pairs[:, side] = new_index[table][pairs[:, side]] if table in new_index else pairs[:, side]
            kept[item.name] = (pairs >= 0).all(axis=1)
            moved[item.name] = pairs[kept[item.name]]
        return (replace(self.take(**kept), **moved) if moved else self), None
