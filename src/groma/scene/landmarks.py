# SPDX-License-Identifier: BSD-3-Clause
"""Landmarks in the world: points, lines, planes, directions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.scene.table import Table, check_unique, column

#: How far a stored unit vector may be from length one.
_UNIT_TOLERANCE = 1e-6


def check_unit(name: str, vectors: FloatArray) -> None:
    """Raise when a row is not of length one."""
    if len(vectors) == 0:
        return
    deviation = np.abs(np.einsum("ij,ij->i", vectors, vectors) - 1)
    if deviation.max() > 2 * _UNIT_TOLERANCE:
        row = int(deviation.argmax())
        raise InputError(f"{name} must be unit vectors; row {row} is {vectors[row].tolist()}. Divide by the length.")


def check_normals(name: str, planes: FloatArray) -> None:
    """Raise when a plane (n, w) has no unit normal."""
    check_unit(f"{name}[:, :3]", planes[:, :3])


@dataclass(frozen=True, eq=False)
class Points(Table, noun="point"):
    """Points in the world."""

    #: (P,) identifiers.
    ids: IntArray = column(np.int64, check=check_unique)
    #: (P, 3) coordinates, scene units.
    xyz: FloatArray = column(np.float64, 3, world="points")
    #: (P, 3) red, green, blue.
    color: npt.NDArray[np.uint8] = column(np.uint8, 3)
    #: (P,) mean reprojection error, pixels; -1 where unknown.
    error: FloatArray = column(np.float64)

    @classmethod
    def at(cls, xyz: npt.ArrayLike) -> Self:
        """Return points with identifiers 1, 2, ..., no colour and no known error."""
        places = np.asarray(xyz, float).reshape(-1, 3)
        count = len(places)
        return cls(np.arange(count) + 1, places, np.zeros((count, 3), np.uint8), np.full(count, -1.0))


@dataclass(frozen=True, eq=False)
class Lines(Table, noun="line"):
    """Infinite lines, each with the segment of it that was seen."""

    #: (L,) identifiers.
    ids: IntArray = column(np.int64, check=check_unique)
    #: (L, 6) Plücker vectors (moment, direction), unit direction, moment = point x direction.
    plucker: FloatArray = column(np.float64, 6, world="lines")
    #: (L, 2, 3) end points of the segment, scene units.
    segments: FloatArray = column(np.float64, 2, 3, world="points")
    #: (L,) probability that an edge runs along the line; -1 where unknown.
    confidence: FloatArray = column(np.float64, fill=-1.0)

    def _check(self) -> None:
        check_unit("Lines.plucker[:, 3:]", self.plucker[:, 3:])
        if len(self):
            moment, direction = self.plucker[:, :3], self.plucker[:, 3:]
            slip = np.abs(np.einsum("ij,ij->i", moment, direction)) / (1 + np.linalg.norm(moment, axis=1))
            if slip.max() > _UNIT_TOLERANCE:
                row = int(slip.argmax())
                raise InputError(
                    f"Lines.plucker must have moments perpendicular to directions; row {row} is "
                    f"{self.plucker[row].tolist()}. Project it to the closest line first."
                )

    @classmethod
    def through(cls, segments: npt.ArrayLike, ids: npt.ArrayLike | None = None) -> Self:
        r"""Return the lines through the end points of segments.

        .. math:: d = (p_2 - p_1) / \|p_2 - p_1\|, \qquad m = p_1 \times d

        Parameters
        ----------
        segments : (L, 2, 3) float
            End points, scene units.
        ids : (L,) int, optional
            Identifiers; 1, 2, ... by default.
        """
        ends = np.asarray(segments, float)
        if ends.ndim != 3 or ends.shape[1:] != (2, 3):
            raise ShapeError(f"segments must have shape (L, 2, 3); got {ends.shape}.")
        direction = ends[:, 1] - ends[:, 0]
        length = np.linalg.norm(direction, axis=1, keepdims=True)
        if (length == 0).any():
            raise InputError(f"Segment {int(length.argmin())} has no length. Remove it.")
        direction = direction / length
        # The point nearest to the origin among the two ends loses the least to rounding.
        near = np.where(
            (np.abs(ends[:, :1]).sum((1, 2)) <= np.abs(ends[:, 1:]).sum((1, 2)))[:, None], *ends.swapaxes(0, 1)
        )
        plucker = np.hstack([np.cross(near, direction), direction])
        return cls(np.arange(len(ends)) + 1 if ids is None else np.asarray(ids), plucker, ends)

    def moved_to(self, plucker: npt.ArrayLike) -> Self:
        """Return these lines at new places: the end points become their feet on the new lines.

        Parameters
        ----------
        plucker : (L, 6) float
            New Plücker vectors, any scale; they are scaled to unit direction.
        """
        new = np.asarray(plucker, float)
        if new.shape != self.plucker.shape:
            raise ShapeError(f"plucker must have shape {self.plucker.shape}; got {new.shape}.")
        length = np.linalg.norm(new[:, 3:], axis=1, keepdims=True)
        if not (length > 0).all():
            raise InputError("Lines at infinity (zero direction) cannot be kept in a scene. Remove them first.")
        new = new / length
        moment, direction = new[:, :3], new[:, 3:]
        moment = moment - np.einsum("ij,ij->i", moment, direction)[:, None] * direction
        foot = np.cross(direction, moment)
        along = np.einsum("lej,lj->le", self.segments, direction)
        segments = foot[:, None] + along[:, :, None] * direction[:, None]
        return self.replace(plucker=np.hstack([moment, direction]), segments=segments)


@dataclass(frozen=True, eq=False)
class Planes(Table, noun="plane"):
    """Infinite planes."""

    #: (K,) identifiers.
    ids: IntArray = column(np.int64, check=check_unique)
    #: (K, 4) unit normal n and offset w with n.X + w = 0.
    hesse: FloatArray = column(np.float64, 4, world="planes", check=check_normals)


@dataclass(frozen=True, eq=False)
class Directions(Table, noun="direction"):
    """Directions that several lines share (vanishing points)."""

    #: (D,) identifiers.
    ids: IntArray = column(np.int64, check=check_unique)
    #: (D, 3) unit vectors; the sign has no meaning.
    vectors: FloatArray = column(np.float64, 3, world="directions", check=check_unit)
