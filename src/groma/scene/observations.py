# SPDX-License-Identifier: BSD-3-Clause
# ruff: noqa: RUF009 - column() is dataclasses.field() with metadata
"""What was measured in the images, and which landmarks belong together."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import ClassVar, Self

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.scene.table import Table, check_sigma, column, convert


@dataclass(frozen=True, eq=False)
class PointObservations(Table):
    """A point seen in an image. Pixel (0.5, 0.5) is the centre of the first pixel."""

    noun: ClassVar[str] = "observation"
    #: (N,) the image.
    image_idx: IntArray = column(np.int64)
    #: (N,) the point.
    point_idx: IntArray = column(np.int64)
    #: (N, 2) measured place, pixels.
    pixel: FloatArray = column(np.float64, 2)
    #: (N,) number of the 2D point within its image (COLMAP's ``point2D_idx``).
    keypoint_idx: IntArray = column(np.int64)
    #: (N,) standard deviation of a coordinate, relative to the usual one; 1 if left out.
    sigma: FloatArray = column(np.float64, fill=1.0)

    def _check(self) -> None:
        check_sigma("PointObservations.sigma", self.sigma)

    @classmethod
    def numbered(cls, image_idx: npt.ArrayLike, point_idx: npt.ArrayLike, pixel: npt.ArrayLike) -> Self:
        """Return observations whose 2D points are numbered 0, 1, 2, ... within each image, in the order given.

        Parameters
        ----------
        image_idx, point_idx : (N,) int
            The image and the point of each.
        pixel : (N, 2) float
            Measured places, pixels.
        """
        image = np.asarray(image_idx)
        order = np.argsort(image, kind="stable")
        number = np.empty(len(order), np.int64)
        number[order] = np.arange(len(order)) - np.searchsorted(image[order], image[order])
        return cls(image, point_idx, pixel, number)  # type: ignore[arg-type]  # columns are converted


@dataclass(frozen=True, eq=False)
class Keypoints(Table):
    """2D points that belong to no 3D point; carried along so that a model is written back whole."""

    noun: ClassVar[str] = "keypoint"
    #: (N,) the image.
    image_idx: IntArray = column(np.int64)
    #: (N, 2) place, pixels.
    pixel: FloatArray = column(np.float64, 2)
    #: (N,) number of the 2D point within its image.
    keypoint_idx: IntArray = column(np.int64)


@dataclass(frozen=True, eq=False)
class LineObservations(Table):
    """A line seen in an image as a segment."""

    noun: ClassVar[str] = "observation"
    #: (N,) the image.
    image_idx: IntArray = column(np.int64)
    #: (N,) the line.
    line_idx: IntArray = column(np.int64)
    #: (N, 4) end points u1 v1 u2 v2 of the detected segment, pixels; no correspondence with the 3D end points.
    segment: FloatArray = column(np.float64, 4)
    #: (N,) standard deviation of an end point across the segment, relative to the usual one; 1 if left out.
    sigma: FloatArray = column(np.float64, fill=1.0)

    def _check(self) -> None:
        check_sigma("LineObservations.sigma", self.sigma)


@dataclass(frozen=True, eq=False)
class Relations:
    """Which landmarks belong together: (R, 2) pairs of indices, first and second landmark as the names say."""

    #: (R, 2) point, plane.
    point_on_plane: IntArray = column(np.int64, 2)
    #: (R, 2) line, plane.
    line_on_plane: IntArray = column(np.int64, 2)
    #: (R, 2) line, direction.
    line_along_direction: IntArray = column(np.int64, 2)
    #: (R, 2) point, line.
    point_on_line: IntArray = column(np.int64, 2)

    def __post_init__(self) -> None:
        for item in fields(self):
            pairs = convert(f"Relations.{item.name}", getattr(self, item.name), item)
            object.__setattr__(self, item.name, pairs)

    def __len__(self) -> int:
        return sum(len(getattr(self, item.name)) for item in fields(self))
