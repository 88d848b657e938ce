# SPDX-License-Identifier: BSD-3-Clause
# ruff: noqa: RUF009 - no_rows() is dataclasses.field() with a default
r"""The four files of LIMAP 2's ``structures`` folder, binary and text.

Binary files are little-endian without padding. ``u4``, ``u8``, ``i4``, ``f8`` are the types, ``n *`` stands for a
count (u8) followed by so many rows, and 2^64 - 1 is "no 3D line" and "no 3D group"::

    structures2d.bin  n * image:  u4 image id, u4 number of 2D points,
                                  n * (4 f8 ends u1 v1 u2 v2, f8 score, u8 3D line),
                                  n * group: (i4 kind, n * (u4 2D point, f8 weight), n * (u4 2D line, f8 weight),
                                              u8 3D group),
                                  n * (u4 2D point, u4 2D line, f8 weight)                  the 2D wireframe
    lines3D.bin       n * line:   u8 id, 6 f8 ends, n * (u4 image id, u4 2D line), f8 uncertainty
    groups3D.bin      n * group:  u8 id, i4 kind, n * (u8 point, f8 weight), n * (u8 line, f8 weight),
                                  n * (u4 image id, u4 2D group), n * f8 parameters
    wireframe3D.bin   n * (u8 point, u8 line, f8 weight)

Text files hold the same numbers as words, with these differences: counts of members come before all members (``kind,
points, lines[, 3D group]``), an image begins with its id on a line and ``points lines groups edges`` on the next (the
edges are counted again where they begin), and a 2D line has **no** 3D line: that is known from the tracks alone.

Points and images are those of the COLMAP model beside, by identifier; a 2D point is COLMAP's ``point2D_idx``. LIMAP
writes text with six digits and trusts all counts when it reads; here text keeps every digit, and a count that the
file cannot hold is refused before memory is taken.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray

Records = npt.NDArray[np.void]
Form = Literal["binary", "text"]

#: The identifier that means "none" (file format).
NONE = 2**64 - 1
#: Kinds of groups and the number of their 3D parameters.
VANISHING_POINT, PLANE = 0, 1
NUM_PARAMS = {0: 3, 1: 4, 2: 4, 3: 7, 4: 10, 5: 10, 6: 7}
NAMES = ("structures2d", "lines3D", "groups3D", "wireframe3D")
SUFFIX = {"binary": ".bin", "text": ".txt"}

LINE_2D = np.dtype([("ends", "<f8", 4), ("score", "<f8"), ("line_id", "<u8")])
MEMBER_2D = np.dtype([("idx", "<u4"), ("weight", "<f8")])
MEMBER_3D = np.dtype([("id", "<u8"), ("weight", "<f8")])
EDGE_2D = np.dtype([("point", "<u4"), ("line", "<u4"), ("weight", "<f8")])
EDGE_3D = np.dtype([("point", "<u8"), ("line", "<u8"), ("weight", "<f8")])
TRACK = np.dtype([("image_id", "<u4"), ("idx", "<u4")])
NUMBER = np.dtype("<f8")


def no_rows(dtype: np.dtype[Any]) -> Any:
    """Return a dataclass field that defaults to no rows of a type."""
    return field(default_factory=lambda: np.zeros(0, dtype))


@dataclass(frozen=True, eq=False)
class Group2d:
    """2D points and lines of one image that belong together."""

    #: Kind of the group; 0 vanishing point, 1 plane.
    kind: int
    #: Numbers of 2D points and their weights.
    points: Records = no_rows(MEMBER_2D)
    #: Numbers of 2D lines and their weights.
    lines: Records = no_rows(MEMBER_2D)
    #: The 3D group, or :data:`NONE`.
    group_id: int = NONE


@dataclass(frozen=True, eq=False)
class Structure2d:
    """What was found in one image."""

    #: Identifier of the image.
    image_id: int
    #: Number of the image's 2D points in the COLMAP model.
    num_points: int = 0
    #: End points in pixels, score, 3D line or :data:`NONE`.
    lines: Records = no_rows(LINE_2D)
    #: Groups.
    groups: tuple[Group2d, ...] = ()
    #: 2D points on 2D lines.
    wireframe: Records = no_rows(EDGE_2D)


@dataclass(frozen=True, eq=False)
class Lines3d:
    """3D lines; the track of line ``i`` is ``track[start[i]:start[i + 1]]``."""

    #: (L,) identifiers.
    ids: npt.NDArray[np.uint64] = no_rows(np.dtype("<u8"))
    #: (L, 2, 3) end points.
    segments: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    #: (L,) uncertainty; -1 where unknown.
    uncertainty: FloatArray = no_rows(NUMBER)
    #: (L + 1,) bounds of the tracks.
    start: IntArray = field(default_factory=lambda: np.zeros(1, np.int64))
    #: Images and numbers of 2D lines.
    track: Records = no_rows(TRACK)


@dataclass(frozen=True, eq=False)
class Group3d:
    """Points and lines that belong together in the world."""

    #: Identifier.
    id: int
    #: Kind; 0 vanishing point, 1 plane, 2 sphere, 3 cylinder, 4 ellipsoid, 5 cuboid, 6 cone.
    kind: int
    #: Parameters; a direction, or n and w of a plane n.X + w = 0.
    params: FloatArray
    #: Identifiers of points and their weights.
    points: Records = no_rows(MEMBER_3D)
    #: Identifiers of lines and their weights.
    lines: Records = no_rows(MEMBER_3D)
    #: Images and numbers of 2D groups.
    track: Records = no_rows(TRACK)


@dataclass(frozen=True, eq=False)
class Structures:
    """Everything in a ``structures`` folder, in the order of the files."""

    #: By image.
    images: tuple[Structure2d, ...] = ()
    #: Lines in the world.
    lines: Lines3d = field(default_factory=Lines3d)
    #: Groups in the world.
    groups: tuple[Group3d, ...] = ()
    #: Points on lines in the world.
    wireframe: Records = no_rows(EDGE_3D)


def columns_of(dtype: np.dtype[Any]) -> list[tuple[str, int | None, np.dtype[Any]]]:
    """Return the numbers of a row: field, place within the field, type."""
    columns: list[tuple[str, int | None, np.dtype[Any]]] = []
    for name in dtype.names or ("",):
        kind = dtype[name] if name else dtype
        places: list[int | None] = list(range(kind.shape[0])) if kind.shape else [None]
        columns += [(name, place, kind.base) for place in places]
    return columns
