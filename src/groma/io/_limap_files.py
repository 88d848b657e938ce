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

import struct
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray, IntArray
from groma.errors import FileFormatError

Records = npt.NDArray[np.void]
Form = Literal["binary", "text"]

#: The identifier that means "none".
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
_LINE_2D_TEXT = np.dtype([("ends", "<f8", 4), ("score", "<f8")])
_NUMBER = np.dtype("<f8")


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
    uncertainty: FloatArray = no_rows(_NUMBER)
    #: (L + 1,) where tracks begin and end.
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


# Reading


def read_files(folder: Path, form: Form) -> Structures:
    """Read the four files; whatever is wrong with them is raised by name."""
    parts: list[Any] = []
    for name, parse in zip(NAMES, (_images, _lines, _groups, _wireframe), strict=True):
        path = folder / (name + SUFFIX[form])
        content = path.read_bytes()
        try:
            source = _Words(content) if form == "text" else _Bytes(content)
            parts.append(parse(source))
            source.finish()
        except (FileFormatError, struct.error, ValueError, OverflowError) as error:
            raise FileFormatError(f"{path} is incomplete or damaged: {error}. Fetch or export it again.") from error
    images, lines, groups, wireframe = parts
    if form == "text":
        images = _with_line_ids(images, lines)
    return Structures(images, lines, groups, wireframe)


class _Bytes:
    """A binary file, read from front to back."""

    text = False

    def __init__(self, content: bytes) -> None:
        self.content, self.at = content, 0

    def one(self, code: str) -> Any:
        value = struct.unpack_from("<" + code, self.content, self.at)[0]
        self.at += struct.calcsize("<" + code)
        return value

    def count(self, least: int = 1) -> int:
        """Return a count of rows of at least so many numbers, refused where the file could not hold them."""
        return self.fits(self.one("Q"), 4 * least)

    def fits(self, count: int, size: int) -> int:
        if count * size > len(self.content) - self.at:
            raise FileFormatError(f"it promises {count} entries, {len(self.content) - self.at} bytes are left")
        return count

    def rows(self, count: int, dtype: np.dtype[Any]) -> Any:
        array = np.frombuffer(self.content, dtype, self.fits(count, dtype.itemsize), self.at).copy()
        self.at += array.nbytes
        return array

    def finish(self) -> None:
        if self.at != len(self.content):
            raise FileFormatError(f"{len(self.content) - self.at} bytes are left over")


class _Words:
    """A text file, read word by word."""

    text = True

    def __init__(self, content: bytes) -> None:
        self.words, self.at = content.decode("ascii").split(), 0

    def one(self, code: str) -> Any:
        if self.at == len(self.words):
            raise FileFormatError("it ends too early")
        word = self.words[self.at]
        self.at += 1
        if code == "d":
            return float(word)
        value = int(word)
        struct.pack("<" + code, value)  # raises where it does not fit
        return value

    def count(self, least: int = 1) -> int:
        return self.fits(self.one("Q"), least)

    def fits(self, count: int, size: int) -> int:
        if count * size > len(self.words) - self.at:
            raise FileFormatError(f"it promises {count} entries, {len(self.words) - self.at} numbers are left")
        return count

    def rows(self, count: int, dtype: np.dtype[Any]) -> Any:
        columns = _columns(dtype)
        self.fits(count, len(columns))
        array = np.zeros(count, dtype)
        end = self.at + count * len(columns)
        for place, (name, entry, kind) in enumerate(columns):
            words = self.words[self.at + place : end : len(columns)]
            values = np.array([(float if kind.kind == "f" else int)(word) for word in words], kind)
            target = array[name] if name else array
            (target if entry is None else target[:, entry])[...] = values
        self.at = end
        return array

    def finish(self) -> None:
        if self.at != len(self.words):
            raise FileFormatError(f"{len(self.words) - self.at} words are left over")


def _columns(dtype: np.dtype[Any]) -> list[tuple[str, int | None, np.dtype[Any]]]:
    """Return the numbers of a row: field, place within the field, type."""
    columns: list[tuple[str, int | None, np.dtype[Any]]] = []
    for name in dtype.names or ("",):
        kind = dtype[name] if name else dtype
        places: list[int | None] = list(range(kind.shape[0])) if kind.shape else [None]
        columns += [(name, place, kind.base) for place in places]
    return columns


_Source = _Bytes | _Words


def _images(source: _Source) -> tuple[Structure2d, ...]:
    return tuple(_structure(source) for _ in range(source.count(4)))


def _structure(source: _Source) -> Structure2d:
    image_id, num_points = source.one("I"), source.one("I")
    if source.text:
        num_lines, num_groups, _ = (source.count(0) for _ in range(3))
        lines = np.zeros(source.fits(num_lines, 5), LINE_2D)
        for name, values in zip(("ends", "score"), _fields(source.rows(num_lines, _LINE_2D_TEXT)), strict=True):
            lines[name] = values
        lines["line_id"] = NONE
        groups = tuple(_group_2d_text(source) for _ in range(source.fits(num_groups, 4)))
    else:
        lines = source.rows(source.count(), LINE_2D)
        groups = tuple(_group_2d(source) for _ in range(source.count(7)))
    return Structure2d(image_id, num_points, lines, groups, source.rows(source.count(), EDGE_2D))


def _fields(array: Records) -> list[npt.NDArray[Any]]:
    return [array[name] for name in array.dtype.names or ()]


def _group_2d(source: _Source) -> Group2d:
    kind = source.one("i")
    points = source.rows(source.count(), MEMBER_2D)
    lines = source.rows(source.count(), MEMBER_2D)
    return Group2d(kind, points, lines, source.one("Q"))


def _group_2d_text(source: _Source) -> Group2d:
    kind, num_points, num_lines, group_id = source.one("i"), source.count(), source.count(), source.one("Q")
    return Group2d(kind, source.rows(num_points, MEMBER_2D), source.rows(num_lines, MEMBER_2D), group_id)


def _lines(source: _Source) -> Lines3d:
    ids, ends, tracks, uncertainty = [], [], [np.zeros(0, TRACK)], []
    for _ in range(source.count(9)):
        ids.append(source.one("Q"))
        ends.append(source.rows(6, _NUMBER))
        tracks.append(source.rows(source.count(), TRACK))
        uncertainty.append(source.one("d"))
    return Lines3d(
        np.array(ids, "<u8"),
        np.array(ends, float).reshape(-1, 2, 3),
        np.array(uncertainty, float),
        np.cumsum([len(track) for track in tracks]),
        np.concatenate(tracks),
    )


def _groups(source: _Source) -> tuple[Group3d, ...]:
    groups = []
    for _ in range(source.count(6)):
        number, kind = source.one("Q"), source.one("i")
        if source.text:
            num_points, num_lines = source.count(), source.count()
            points, lines = source.rows(num_points, MEMBER_3D), source.rows(num_lines, MEMBER_3D)
        else:
            points, lines = (source.rows(source.count(), MEMBER_3D) for _ in range(2))
        track = source.rows(source.count(), TRACK)
        params = source.rows(source.count(), _NUMBER)
        if NUM_PARAMS.get(kind) != len(params):
            raise FileFormatError(f"group {number} is of kind {kind} and has {len(params)} parameters")
        groups.append(Group3d(number, kind, params, points, lines, track))
    return tuple(groups)


def _wireframe(source: _Source) -> Records:
    return source.rows(source.count(), EDGE_3D)


def _with_line_ids(images: tuple[Structure2d, ...], lines: Lines3d) -> tuple[Structure2d, ...]:
    """Fill in the 3D line of every 2D line, which text files leave out, from the tracks."""
    row = {image.image_id: row for row, image in enumerate(images)}
    tables = [image.lines.copy() for image in images]
    owners = np.repeat(lines.ids, np.diff(lines.start))
    for (image_id, idx), owner in zip(lines.track.tolist(), owners.tolist(), strict=True):
        if image_id in row and idx < len(tables[row[image_id]]):
            tables[row[image_id]]["line_id"][idx] = owner
    return tuple(replace(image, lines=table) for image, table in zip(images, tables, strict=True))


# Writing


def write_files(structures: Structures, folder: Path, form: Form) -> None:
    """Write the four files into an existing folder."""
    writers = (_put_images, _put_lines, _put_groups, _put_wireframe)
    for name, put in zip(NAMES, writers, strict=True):
        target: _Target = _TextTarget() if form == "text" else _BinaryTarget()
        put(structures, target)
        (folder / (name + SUFFIX[form])).write_bytes(target.content())


class _BinaryTarget:
    text = False

    def __init__(self) -> None:
        self.parts: list[bytes] = []

    def put(self, codes: str, *values: float) -> None:
        self.parts.append(struct.pack("<" + codes, *values))

    def rows(self, array: npt.NDArray[Any]) -> None:
        self.parts.append(np.ascontiguousarray(array).tobytes())

    def content(self) -> bytes:
        return b"".join(self.parts)


class _TextTarget:
    text = True

    def __init__(self) -> None:
        self.parts: list[str] = []

    def put(self, codes: str, *values: float) -> None:
        self.parts.append(" ".join(map(_word, values)))

    def rows(self, array: npt.NDArray[Any]) -> None:
        columns = [
            (array[name] if place is None else array[name][:, place]).tolist()
            for name, place, _ in _columns(array.dtype)
        ]
        self.parts += [" ".join(map(_word, row)) for row in zip(*columns, strict=True)]

    def content(self) -> bytes:
        return ("\n".join(self.parts) + "\n").encode("ascii")


def _word(value: float) -> str:
    """Return every digit of a number, and no more."""
    return repr(value).removesuffix(".0")


_Target = _BinaryTarget | _TextTarget


def _put_images(structures: Structures, target: _Target) -> None:
    target.put("Q", len(structures.images))
    for image in structures.images:
        if target.text:
            target.put("I", image.image_id)
            target.put("IQQQ", image.num_points, len(image.lines), len(image.groups), len(image.wireframe))
            target.rows(image.lines[["ends", "score"]])
        else:
            target.put("IIQ", image.image_id, image.num_points, len(image.lines))
            target.rows(image.lines)
            target.put("Q", len(image.groups))
        for group in image.groups:
            _put_group_2d(group, target)
        target.put("Q", len(image.wireframe))
        target.rows(image.wireframe)


def _put_group_2d(group: Group2d, target: _Target) -> None:
    if target.text:
        target.put("iQQQ", group.kind, len(group.points), len(group.lines), group.group_id)
        target.rows(group.points)
        target.rows(group.lines)
    else:
        target.put("iQ", group.kind, len(group.points))
        target.rows(group.points)
        target.put("Q", len(group.lines))
        target.rows(group.lines)
        target.put("Q", group.group_id)


def _put_lines(structures: Structures, target: _Target) -> None:
    lines = structures.lines
    target.put("Q", len(lines.ids))
    starts = lines.start.tolist()
    uncertainty = lines.uncertainty.tolist()
    for row, (number, ends) in enumerate(zip(lines.ids.tolist(), lines.segments.reshape(-1, 6).tolist(), strict=True)):
        track = lines.track[starts[row] : starts[row + 1]]
        target.put("Q", number)
        target.put("6d", *ends)
        target.put("Q", len(track))
        target.rows(track)
        target.put("d", uncertainty[row])


def _put_groups(structures: Structures, target: _Target) -> None:
    target.put("Q", len(structures.groups))
    for group in structures.groups:
        target.put("Q", group.id)
        if target.text:
            target.put("iQQ", group.kind, len(group.points), len(group.lines))
            target.rows(group.points)
            target.rows(group.lines)
        else:
            target.put("iQ", group.kind, len(group.points))
            target.rows(group.points)
            target.put("Q", len(group.lines))
            target.rows(group.lines)
        target.put("Q", len(group.track))
        target.rows(group.track)
        target.put(f"Q{len(group.params)}d", len(group.params), *group.params.tolist())


def _put_wireframe(structures: Structures, target: _Target) -> None:
    target.put("Q", len(structures.wireframe))
    target.rows(structures.wireframe)
