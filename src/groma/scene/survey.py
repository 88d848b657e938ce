# SPDX-License-Identifier: BSD-3-Clause
"""What instruments measured outside the images: poses, control points with marks, distances, directions, planes.

Coordinates are in the world of the scene and its unit of length. A control point is a landmark of its own, beside the
points of the scene: it is found in images by hand or by its target, and it has a name.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import partial
from typing import TYPE_CHECKING, Self

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.scene.landmarks import check_normals, check_unit
from groma.scene.table import OBJECTS, Table, check_sigma, check_unique, column, joined, text_column

if TYPE_CHECKING:
    from groma.scene.scene import Scene

#: What is done with the coordinates of a :class:`ControlPoints`: nothing is known of the place; it is measured, and
#: holds the scene; it is measured, and kept back to check the result; it was measured, and is wrong.
UNKNOWN, CONTROL, CHECK, REJECTED = 0, 1, 2, 3
#: Tables whose rows may be rejected: they stay in the scene, and take no part.
REJECTABLE = ("camera_positions", "camera_poses", "marks", "distances", "known_planes", "known_directions")


class Kind(IntEnum):
    """What a measurement is of: the table of :data:`~groma.scene.table.OBJECTS` with this number."""

    IMAGE, CONTROL_POINT, LINE, PLANE, POINT, DIRECTION = range(6)


#: Kinds that have a place and can be eliminated beside each other, and kinds that have a direction.
LOCATED = (Kind.IMAGE, Kind.CONTROL_POINT, Kind.LINE, Kind.PLANE)
DIRECTED = (Kind.IMAGE, Kind.LINE, Kind.PLANE, Kind.DIRECTION)
#: Powers of the unit of length in the covariance of a pose (derived from its three shifts and three turns).
_POSE_LENGTHS = ((2, 2, 2, 1, 1, 1),) * 3 + ((1, 1, 1, 0, 0, 0),) * 3


def check_covariance(name: str, covariance: FloatArray, exact: bool = False) -> None:
    """Raise when a matrix (N, m, m) is not symmetric and positive definite; ``exact``: semidefinite will do."""
    if len(covariance) == 0:
        return
    if not exact:  # units of coordinates may differ; of what is exact, rounding would be scaled up
        root = np.sqrt(np.maximum(np.einsum("nii->ni", covariance), 1e-300))
        covariance = covariance / root[:, :, None] / root[:, None, :]
    asymmetry = np.abs(covariance - covariance.transpose(0, 2, 1)).max(axis=(1, 2))
    smallest, size = np.linalg.eigvalsh(covariance)[:, 0], np.abs(covariance).max(axis=(1, 2))
    wrong = (smallest < -1e-6 * size if exact else smallest <= 1e-15 * size) | (asymmetry > 1e-6 * size)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(
            f"{name} must be symmetric positive {'semi' * exact}definite covariance matrices; row {row} is "
            f"{covariance[row].tolist()}. Give what is not known a large variance."
        )


def check_kinds(name: str, kinds: IntArray, allowed: tuple[int, ...]) -> None:
    """Raise where a kind of object is not allowed."""
    if len(kinds) and not (known := np.isin(kinds, allowed)).all():
        row = int(np.argmin(known))
        names = ", ".join(f"{int(kind)} ({OBJECTS[kind]})" for kind in allowed)
        raise InputError(f"{name} must be one of {names}; row {row} is {kinds[row]}.")


def diagonal_covariance(sigma: npt.ArrayLike) -> FloatArray:
    """Return the covariances (N, 3, 3) of coordinates with standard deviations (N, 3)."""
    return np.square(np.asarray(sigma, float))[:, :, None] * np.eye(3)


@dataclass(frozen=True, eq=False)
class CameraPositions(Table, noun="position", optional=True):
    """Measured positions of camera centres: GNSS, total stations, EXIF."""

    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N, 3) measured place, scene units.
    xyz: FloatArray = column(np.float64, 3, world="points", measured=True)
    #: (N, 3, 3) its covariance, scene units squared.
    covariance: FloatArray = column(np.float64, 3, 3, world="covariances", measured=True, check=check_covariance)
    #: (N,) whether the row is a gross error that takes no part.
    rejected: BoolArray = column(np.bool_, fill=False)


@dataclass(frozen=True, eq=False)
class ControlPoints(Table, noun="control point", optional=True):
    """Points with a name that were measured in images, most of them in the world, too."""

    #: (N,) name, each once.
    names: tuple[str, ...] = text_column()
    #: (N, 3) where the scene has the point: estimated.
    xyz: FloatArray = column(np.float64, 3, world="points")
    #: (N, 3) measured place and (N, 3, 3) its covariance, scene units; of points of unknown place any numbers.
    measured: FloatArray = column(np.float64, 3, world="points", measured=True)
    covariance: FloatArray = column(np.float64, 3, 3, world="covariances", measured=True, check=check_covariance)
    #: (N,) :data:`UNKNOWN`, :data:`CONTROL`, :data:`CHECK` or :data:`REJECTED`.
    role: IntArray = column(np.int64)

    def _check(self) -> None:
        check_unique("ControlPoints.names", np.unique(np.asarray(self.names, str), return_inverse=True)[1])
        if len(self) and not np.isin(self.role, (UNKNOWN, CONTROL, CHECK, REJECTED)).all():
            raise InputError(f"ControlPoints.role must be 0, 1, 2 or 3; got {sorted(set(self.role.tolist()))}.")

    @property
    def is_control(self) -> BoolArray:
        """(N,) whether the coordinates hold the scene."""
        return self.role == CONTROL

    @property
    def is_check(self) -> BoolArray:
        """(N,) whether the coordinates are kept back to check the result."""
        return self.role == CHECK

    def with_unmeasured(self, names: Sequence[str], xyz: FloatArray) -> Self:
        """Return these points and others at places (M, 3) whose coordinates nobody measured."""
        covariance, role = np.tile(np.eye(3), (len(names), 1, 1)), np.full(len(names), UNKNOWN)
        return joined(self, type(self)(tuple(names), xyz, xyz, covariance, role))


@dataclass(frozen=True, eq=False)
class Marks(Table, noun="mark", optional=True):
    """A control point measured in an image. Pixel (0.5, 0.5) is the centre of the first pixel."""

    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N,) the control point.
    point_idx: IntArray = column(np.int64, refers="control_points")
    #: (N, 2) measured place, pixels.
    pixel: FloatArray = column(np.float64, 2)
    #: (N,) standard deviation of a coordinate, pixels.
    sigma: FloatArray = column(np.float64, check=check_sigma)
    #: (N,) whether the row is a gross error that takes no part.
    rejected: BoolArray = column(np.bool_, fill=False)


@dataclass(frozen=True, eq=False)
class Distances(Table, noun="distance", optional=True):
    """Measured distances between two objects each: scale bars, tapes, bases of stereo heads, heights above a floor.

    Objects are camera centres, control points, lines and planes. From a line or plane it is measured at the foot of a
    place; between skew lines where they are nearest.
    """

    #: (N,) kinds of the two objects (:class:`Kind`), not larger for the first, and which they are.
    first_kind: IntArray = column(np.int64, check=partial(check_kinds, allowed=LOCATED))
    first_idx: IntArray = column(np.int64, kinds="first_kind")
    second_kind: IntArray = column(np.int64, check=partial(check_kinds, allowed=LOCATED))
    second_idx: IntArray = column(np.int64, kinds="second_kind")
    #: (N, 3) of a line or plane that is the first: near where it is measured; else any place. It does not count where
    #: ``is_shortest``.
    anchor: FloatArray = column(np.float64, 3, world="points")
    #: (N,) distance and its standard deviation, scene units.
    distance: FloatArray = column(np.float64, length=1, measured=True, check=check_sigma)
    sigma: FloatArray = column(np.float64, length=1, measured=True, check=check_sigma)
    #: (N,) whether the row is a gross error that takes no part.
    rejected: BoolArray = column(np.bool_, fill=False)
    #: (N,) of two lines: whether it is the shortest between them, wherever that is.
    is_shortest: BoolArray = column(np.bool_, fill=False)

    def _check(self) -> None:
        if (self.is_shortest & ((self.first_kind != Kind.LINE) | (self.second_kind != Kind.LINE))).any():
            raise InputError("Distances.is_shortest is of two lines; other kinds have a place. Set it to False.")
        if (wrong := self.first_kind > self.second_kind).any():
            raise InputError(f"Distances: row {int(np.argmax(wrong))} has its kinds in the wrong order. Exchange them.")
        same = (self.first_kind == self.second_kind) & (self.first_idx == self.second_idx)
        if same.any():
            raise InputError(
                f"Distances: row {int(np.argmax(same))} is the distance of something from itself. Drop it."
            )

    @classmethod
    def between(
        cls, kind: Kind, first: npt.ArrayLike, second: npt.ArrayLike, distance: npt.ArrayLike, sigma: npt.ArrayLike
    ) -> Self:
        """Return distances between objects of one kind: cameras or control points."""
        one, two = np.atleast_1d(first), np.atleast_1d(second)
        kinds, numbers = np.full(len(one), kind), (np.asarray(distance, float), np.asarray(sigma, float))
        return cls(kinds, one, kinds, two, np.zeros((len(one), 3)), *numbers)


@dataclass(frozen=True, eq=False)
class KnownPlanes(Table, noun="known plane", optional=True):
    """Objects that are on planes with known coordinates: heights, levelled floors, walls in the frame of a building."""

    #: (N,) kind of the object (:class:`Kind`), and which it is: camera centre, control point, line or plane.
    kind: IntArray = column(np.int64, check=partial(check_kinds, allowed=LOCATED))
    idx: IntArray = column(np.int64, kinds="kind")
    #: (N, 3) of a line or plane: near the place that is on the plane, two of a line and three of a plane; else any.
    anchor: FloatArray = column(np.float64, 3, world="points")
    #: (N, 4) unit normal and offset, n.X + w = 0, scene units.
    hesse: FloatArray = column(np.float64, 4, world="planes", measured=True, check=check_normals)
    #: (N,) standard deviation of the distance from it, scene units.
    sigma: FloatArray = column(np.float64, length=1, measured=True, check=check_sigma)
    #: (N,) whether the row is a gross error that takes no part.
    rejected: BoolArray = column(np.bool_, fill=False)


@dataclass(frozen=True, eq=False)
class KnownDirections(Table, noun="known direction", optional=True):
    """Directions known in the world: gravity in cameras, lines, planes and vanishing directions that are vertical."""

    #: (N,) kind of the object (:class:`Kind`): image, line, plane (its normal) or direction; and which it is.
    kind: IntArray = column(np.int64, check=partial(check_kinds, allowed=DIRECTED))
    idx: IntArray = column(np.int64, kinds="kind")
    #: (N, 3) unit vector in the world. That of landmarks has no sign.
    vector: FloatArray = column(np.float64, 3, world="directions", measured=True, check=check_unit)
    #: (N, 3) of images: how the camera sees it, a unit vector (x right, y down, z forward); else as ``vector``.
    in_camera: FloatArray = column(np.float64, 3, check=check_unit)
    #: (N,) standard deviation of a component, radians.
    sigma: FloatArray = column(np.float64, check=check_sigma)
    #: (N,) whether the row is a gross error that takes no part.
    rejected: BoolArray = column(np.bool_, fill=False)


@dataclass(frozen=True, eq=False)
class CameraPoses(Table, noun="pose", optional=True):
    """Measured poses of cameras with their covariance: RTK with an IMU, a motion capture system, another adjustment."""

    #: (N,) the image.
    image_idx: IntArray = column(np.int64, refers="images")
    #: (N, 7) pose [qx qy qz qw tx ty tz].
    cam_from_world: FloatArray = column(np.float64, 7, world="poses", measured=True)
    #: (N, 6, 6) covariance of the shift along and the turn about the axes of the camera, scene units and radians.
    covariance: FloatArray = column(
        np.float64, 6, 6, length=_POSE_LENGTHS, measured=True, check=check_covariance
    )  # fmt: skip
    #: (N,) whether the row is a gross error that takes no part.
    rejected: BoolArray = column(np.bool_, fill=False)


@dataclass(frozen=True, eq=False)
class Held(Table, noun="held object", optional=True):
    """Objects held fixed: cameras and landmarks of an earlier adjustment, a datum."""

    #: (N,) kind of the object (:class:`Kind`), and which it is. Of an image its whole frame is held.
    kind: IntArray = column(np.int64, check=partial(check_kinds, allowed=tuple(Kind)))
    idx: IntArray = column(np.int64, kinds="kind")


def accepted(scene: Scene) -> Scene:
    """Return a scene without the measurements that are rejected."""
    tables = {name: getattr(scene, name) for name in REJECTABLE}
    kept = {name: table.take(~table.rejected) for name, table in tables.items() if table.rejected.any()}
    return scene.replace(**kept) if kept else scene


def only_rejected(scene: Scene) -> Scene:
    """Return a scene with the measurements that are rejected in place of those that are not."""
    tables = {name: getattr(scene, name) for name in REJECTABLE}
    taken = {name: table.take(table.rejected).replace(rejected=[]) for name, table in tables.items()}
    role = scene.control_points.role
    role = np.where(role == REJECTED, CONTROL, np.where(role == CONTROL, UNKNOWN, role))
    return scene.replace(**taken, control_points=scene.control_points.replace(role=role))


def rejected_rows(scene: Scene) -> set[tuple[str, int]]:
    """Return table and row of all measurements that are rejected."""
    rows = {name: np.flatnonzero(getattr(scene, name).rejected) for name in REJECTABLE}
    rows["control_points"] = np.flatnonzero(scene.control_points.role == REJECTED)
    return {(name, row) for name, found in rows.items() for row in found.tolist()}


def with_rejected(scene: Scene, rows: Collection[tuple[str, int]]) -> Scene:
    """Return a scene in which these measurements are rejected, by table and row, and no others."""
    tables, points = {}, scene.control_points
    for name in REJECTABLE:
        mask = np.zeros(len(getattr(scene, name)), bool)
        mask[[row for table, row in rows if table == name]] = True
        tables[name] = getattr(scene, name).replace(rejected=mask)
    role = np.where(points.role == REJECTED, CONTROL, points.role)
    role[[row for name, row in rows if name == "control_points"]] = REJECTED
    return scene.replace(**tables, control_points=points.replace(role=role))
