# SPDX-License-Identifier: BSD-3-Clause
# ruff: noqa: RUF009 - column() is dataclasses.field() with metadata
"""What instruments measured outside the images: positions of cameras, control points with their marks, distances.

Coordinates are in the world of the scene and its unit of length. A control point is a landmark of its own, beside the
points of the scene: it is found in images by hand or by its target, and it has a name.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.scene.table import Table, check_sigma, check_unique, column, text_column

#: What is done with the coordinates of a :class:`ControlPoints`: nothing is known of the place; it is measured, and
#: holds the scene; it is measured, and kept back to check the result.
UNKNOWN, CONTROL, CHECK = 0, 1, 2


def check_covariance(name: str, covariance: FloatArray) -> None:
    """Raise when a matrix (N, 3, 3) is not symmetric and positive definite."""
    if len(covariance) == 0:
        return
    asymmetry = np.abs(covariance - covariance.transpose(0, 2, 1)).max(axis=(1, 2))
    smallest, size = np.linalg.eigvalsh(covariance)[:, 0], np.abs(covariance).max(axis=(1, 2))
    wrong = (smallest <= 1e-15 * size) | (asymmetry > 1e-6 * size)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(
            f"{name} must be positive definite covariance matrices; row {row} is {covariance[row].tolist()}. Give what "
            "is not known a large variance."
        )


def diagonal_covariance(sigma: npt.ArrayLike) -> FloatArray:
    """Return the covariances (N, 3, 3) of coordinates with standard deviations (N, 3)."""
    return np.square(np.asarray(sigma, float))[:, :, None] * np.eye(3)


@dataclass(frozen=True, eq=False)
class CameraPositions(Table):
    """Measured places of camera centres: GNSS, total stations, EXIF."""

    noun: ClassVar[str] = "position"
    optional: ClassVar[bool] = True
    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N, 3) measured place, scene units.
    xyz: FloatArray = column(np.float64, 3, world="points")
    #: (N, 3, 3) its covariance, scene units squared.
    covariance: FloatArray = column(np.float64, 3, 3, world="covariances")

    def _check(self) -> None:
        check_covariance("CameraPositions.covariance", self.covariance)


@dataclass(frozen=True, eq=False)
class ControlPoints(Table):
    """Points with a name that were measured in images, most of them in the world, too."""

    noun: ClassVar[str] = "control point"
    optional: ClassVar[bool] = True
    #: (N,) name, each once.
    names: tuple[str, ...] = text_column()
    #: (N, 3) where the scene has the point: estimated.
    xyz: FloatArray = column(np.float64, 3, world="points")
    #: (N, 3) measured place and (N, 3, 3) its covariance, scene units; of points of unknown place any numbers.
    measured: FloatArray = column(np.float64, 3, world="points")
    covariance: FloatArray = column(np.float64, 3, 3, world="covariances")
    #: (N,) :data:`UNKNOWN`, :data:`CONTROL` or :data:`CHECK`.
    role: IntArray = column(np.int64)

    def _check(self) -> None:
        check_covariance("ControlPoints.covariance", self.covariance)
        check_unique("ControlPoints.names", np.unique(np.asarray(self.names, str), return_inverse=True)[1])
        if len(self) and not np.isin(self.role, (UNKNOWN, CONTROL, CHECK)).all():
            raise InputError(f"ControlPoints.role must be 0, 1 or 2; got {sorted(set(self.role.tolist()))}.")

    @property
    def is_control(self) -> BoolArray:
        """(N,) whether the coordinates hold the scene."""
        return self.role == CONTROL

    @property
    def is_check(self) -> BoolArray:
        """(N,) whether the coordinates are kept back to check the result."""
        return self.role == CHECK


@dataclass(frozen=True, eq=False)
class Marks(Table):
    """A control point measured in an image. Pixel (0.5, 0.5) is the centre of the first pixel."""

    noun: ClassVar[str] = "mark"
    optional: ClassVar[bool] = True
    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N,) the control point.
    point_idx: IntArray = column(np.int64, refers="control_points")
    #: (N, 2) measured place, pixels.
    pixel: FloatArray = column(np.float64, 2)
    #: (N,) standard deviation of a coordinate, pixels.
    sigma: FloatArray = column(np.float64)

    def _check(self) -> None:
        check_sigma("Marks.sigma", self.sigma)


@dataclass(frozen=True, eq=False)
class PointDistances(Table):
    """Measured distances between control points: scale bars, tapes."""

    noun: ClassVar[str] = "distance"
    optional: ClassVar[bool] = True
    #: (N,) the two control points.
    first_idx: IntArray = column(np.int64, refers="control_points")
    second_idx: IntArray = column(np.int64, refers="control_points")
    #: (N,) distance and its standard deviation, scene units.
    distance: FloatArray = column(np.float64, length=1)
    sigma: FloatArray = column(np.float64, length=1)

    def _check(self) -> None:
        _check_distances(type(self).__name__, self.first_idx, self.second_idx, self.distance, self.sigma)


@dataclass(frozen=True, eq=False)
class CameraDistances(Table):
    """Measured distances between camera centres: the base of a stereo head, a slide."""

    noun: ClassVar[str] = "distance"
    optional: ClassVar[bool] = True
    #: (N,) the two images.
    first_idx: IntArray = column(np.int64, refers="images")
    second_idx: IntArray = column(np.int64, refers="images")
    #: (N,) distance and its standard deviation, scene units.
    distance: FloatArray = column(np.float64, length=1)
    sigma: FloatArray = column(np.float64, length=1)

    def _check(self) -> None:
        _check_distances(type(self).__name__, self.first_idx, self.second_idx, self.distance, self.sigma)


def _check_distances(name: str, first: IntArray, second: IntArray, distance: FloatArray, sigma: FloatArray) -> None:
    check_sigma(f"{name}.distance", distance)
    check_sigma(f"{name}.sigma", sigma)
    if (same := first == second).any():
        raise InputError(f"{name}: row {int(np.argmax(same))} is the distance of something from itself. Drop it.")


__all__ = [
    "CHECK",
    "CONTROL",
    "UNKNOWN",
    "CameraDistances",
    "CameraPositions",
    "ControlPoints",
    "Marks",
    "PointDistances",
    "check_covariance",
    "diagonal_covariance",
]
