# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP 2's ``structures`` folder beside a COLMAP model: lines, planes, vanishing directions, points on lines.

:class:`Structures` holds everything in the files and nothing else; reading and writing it gives the same bytes. A
scene holds what groma works with:

===========================  ======================================================================================
LIMAP                        scene
===========================  ======================================================================================
3D line, its track           line, line observations (a 2D line of each track element)
group of kind plane          plane, ``point_on_plane``, ``line_on_plane``
group of kind VP             direction, ``line_along_direction``
3D wireframe                 ``point_on_line``
2D lines without a 3D line,  nothing: pass the structures as ``like`` when the scene is written back, and they stay,
scores, uncertainties,       where images and 2D points are still the same
weights, other groups
===========================  ======================================================================================

Quirks of the files, all survived: images without a pose have structures too; text has six digits and no 3D line on
2D lines; binary 2D lines may name a 3D line whose track left them out (the track counts); tracks and groups may name
images, points and lines that were deleted; segments may have no length, or ends that are not numbers (left out with
a warning unless groma wrote them); planes and directions share one sequence of identifiers. LIMAP demands a structure
for every image, with its number of 2D points, and indices within bounds; it is written so. In text it cannot read 2D
groups that have points (its own neither), so beside a text model 2D groups are written without them; their 3D groups
have them.

A line of which intervals are supported becomes one 3D line for each interval, with the segments that cover it as its
track (:func:`groma.scene.line_intervals.one_line_per_interval`); read back, they are lines of their own.

Two things of a scene have no place in these files: a line's Plücker vector, where it is not exactly that of its end
points, and identifiers of planes and directions that occur in both. Where they matter ``groma.npz`` lies beside,
a groma archive of the bare landmarks; it counts for a line only while its end points are unchanged.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.bounded.names import existing
from groma.errors import FileFormatError, InputError
from groma.io.archive import archive_in, read_archive, write_archive
from groma.io.atomic import atomic_output
from groma.io.colmap.files import find_model, is_model
from groma.io.limap.files import (
    NAMES,
    PLANE,
    SUFFIX,
    VANISHING_POINT,
    Form,
    Group2d,
    Group3d,
    Lines3d,
    Structure2d,
    Structures,
)
from groma.io.limap.from_scene import RowsById, from_scene, group_ids, int_ids
from groma.io.limap.read import read_files
from groma.io.limap.write import write_files
from groma.io.reading import reading
from groma.scene import Directions, LineObservations, Lines, Planes, Relations, Scene
from groma.scene.line_intervals import one_line_per_interval

_KIND = "folder of LIMAP structures"
_EXACT = "groma.npz"
#: A normal or direction farther than this from length one is scaled.
_UNIT_TOLERANCE = 1e-9


# Files


def read_limap(path: str | os.PathLike[str]) -> Structures:
    """Read a ``structures`` folder; binary files are preferred, as LIMAP does.

    Parameters
    ----------
    path : path
        The folder itself, or the folder of the COLMAP model it lies in.

    Raises
    ------
    FileFormatError
        If files are missing, damaged or truncated.
    """
    folder = existing(path)
    if (folder / "structures").is_dir():
        folder = folder / "structures"
    form = _form(folder)
    if form is None:
        raise FileFormatError(f"No LIMAP structures in {folder}: expected {', '.join(NAMES)}, all .bin or all .txt.")
    with reading(folder, _KIND):
        return read_files(folder, form)


def structures_of(source: str | os.PathLike[str]) -> Structures | None:
    """Return the LIMAP structures beside the COLMAP model that a scene is read from; None where there are none.

    Parameters
    ----------
    source : path
        What :func:`groma.io.read_scene` read: the folder of a model, or the folder it lies in. Nothing else has them;
        of a result with ``scene.npz``, which is read in its place, they are made anew.

    Raises
    ------
    FileFormatError
        If the structures are damaged.
    """
    place = Path(source)
    if not place.is_dir() or not is_model(place) or archive_in(place) is not None:
        return None
    folder = find_model(source)[0] / "structures"
    return read_limap(folder) if folder.is_dir() and _form(folder) is not None else None


def write_limap(
    structures: Structures, path: str | os.PathLike[str], form: Form = "binary", force: bool = False
) -> None:
    """Write structures as a new folder, named ``structures`` in the folder of a COLMAP model."""
    if form not in SUFFIX:
        raise InputError(f"form must be 'binary' or 'text'; got {form!r}.")
    with atomic_output(path, force) as draft:
        draft.mkdir()
        write_files(structures, draft, form)


def _form(folder: Path) -> Form | None:
    """Return the form in which all four files are there; None when there is none of them."""
    found = {form: [name for name in NAMES if (folder / (name + suffix)).is_file()] for form, suffix in SUFFIX.items()}
    for form in ("binary", "text"):
        if len(found[form]) == len(NAMES):
            return form
    for form, names in found.items():
        if names:
            missing = next(name for name in NAMES if name not in names)
            raise FileFormatError(
                f"{folder} is incomplete: {names[0]}{SUFFIX[form]} is there, {missing}{SUFFIX[form]} is missing."
            )
    return None


def read_beside(scene: Scene, model: Path) -> Scene:
    """Return the scene with the structures beside its COLMAP model, where there are any; warn of lines left out."""
    folder = model / "structures"
    form = _form(folder)
    if form is None:
        return scene
    with reading(folder, _KIND):
        structures = read_files(folder, form)
        exact = read_archive(folder / _EXACT) if (folder / _EXACT).is_file() else Scene()
        scene = with_structures(scene, structures, exact)
    count = len(structures.lines.ids)
    if scene.num_lines < count:
        warnings.warn(
            f"{count - scene.num_lines} of {count} lines in {folder} have no direction (their end points coincide, or "
            "are not finite) and were left out, with what was observed of them.",
            stacklevel=2,
        )
    return scene


def write_beside(scene: Scene, model: Path, form: Form, like: Structures | None = None) -> None:
    """Write what a COLMAP model cannot hold into its folder, where there is any of it."""
    if like is None and not (scene.num_lines or scene.num_planes or scene.num_directions):
        return
    scene = one_line_per_interval(scene)
    folder = model / "structures"
    folder.mkdir()
    structures = from_scene(scene, like)
    write_files(_readable_text(structures) if form == "text" else structures, folder, form)
    if _needs_exact(scene):
        write_archive(Scene(lines=scene.lines, planes=scene.planes, directions=scene.directions), folder / _EXACT)


def _readable_text(structures: Structures) -> Structures:
    """Return the structures without the points of 2D groups, which LIMAP 2.0 cannot read in text."""
    bare = [
        replace(image, groups=tuple(replace(group, points=group.points[:0]) for group in image.groups))
        for image in structures.images
    ]
    return replace(structures, images=tuple(bare))


def _needs_exact(scene: Scene) -> bool:
    lines = scene.lines
    if len(np.intersect1d(scene.planes.ids, scene.directions.ids)) or not _has_length(lines.segments).all():
        return True
    return not np.array_equal(Lines.through(lines.segments).plucker, lines.plucker)


# To a scene


def with_structures(scene: Scene, structures: Structures, exact: Scene | None = None) -> Scene:
    """Return the scene with its lines, planes, directions and relations replaced by those of LIMAP structures.

    Rows that refer to images, points or lines that are not there are left out; see the module for the mapping.

    Parameters
    ----------
    scene : Scene
        Images and points, as in the COLMAP model that the structures belong to.
    structures : Structures
        What to put into it.
    exact : Scene, optional
        Landmarks with the Plücker vectors and identifiers that the structures cannot hold.

    Raises
    ------
    FileFormatError
        If a track refers to a 2D line that its image does not have, or a group has no normal or direction.
    """
    exact = Scene() if exact is None else exact
    lines, owner = _lines(structures.lines, exact.lines)
    observations = _observations(scene, structures, owner)
    point_row = RowsById(scene.points.ids)
    line_row = RowsById(lines.ids)
    planes = [group for group in structures.groups if group.kind == PLANE]
    directions = [group for group in structures.groups if group.kind == VANISHING_POINT]
    plane_ids, direction_ids = _own_ids(planes, directions, exact)
    edges = structures.wireframe
    pairs = np.column_stack([point_row.of(edges["point"]), line_row.of(edges["line"])])
    return scene.replace(
        lines=lines,
        line_observations=observations,
        planes=Planes(plane_ids, _unit(planes, 4)),
        directions=Directions(direction_ids, _unit(directions, 3)),
        relations=Relations(
            point_on_plane=_members(planes, "points", point_row),
            line_on_plane=_members(planes, "lines", line_row),
            line_along_direction=_members(directions, "lines", line_row),
            point_on_line=pairs[(pairs >= 0).all(1)],
        ),
    )


def _lines(stored: Lines3d, exact: Lines) -> tuple[Lines, IntArray]:
    """Return the usable lines and, for each track element, the row of its line (-1: left out)."""
    ids = int_ids(stored.ids)
    known = RowsById(exact.ids).of(stored.ids)
    same = known >= 0
    same[same] = (exact.segments[known[same]] == stored.segments[same]).all((1, 2))
    usable = same | _has_length(stored.segments)
    plucker = np.zeros((len(ids), 6))
    computed = usable & ~same
    plucker[computed] = Lines.through(stored.segments[computed]).plucker
    plucker[same] = exact.plucker[known[same]]
    new_row = np.where(usable, np.cumsum(usable) - 1, -1)
    lines = Lines(ids[usable], plucker[usable], stored.segments[usable])
    return lines, np.repeat(new_row, np.diff(stored.start))


def _has_length(segments: FloatArray) -> BoolArray:
    """Tell which segments have a direction that can be computed."""
    with np.errstate(over="ignore", under="ignore"):
        length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    return length > 1e-150


def _observations(scene: Scene, structures: Structures, line_idx: IntArray) -> LineObservations:
    """Return the observations of the tracks, in the order of the images and within them."""
    track = structures.lines.track
    row = RowsById(np.array([image.image_id for image in structures.images], np.int64)).of(track["image_id"])
    image_idx = RowsById(scene.images.ids).of(track["image_id"])
    number = track["idx"].astype(np.int64)
    tables = [image.lines["ends"] for image in structures.images]
    count = np.array([len(table) for table in tables] + [0], np.int64)
    wrong = (row >= 0) & (number >= count[row])
    if wrong.any():
        first = int(np.flatnonzero(wrong)[0])
        raise FileFormatError(
            f"A track refers to 2D line {number[first]} of image {track['image_id'][first]}, which has "
            f"{count[row[first]]}."
        )
    kept = np.flatnonzero((row >= 0) & (image_idx >= 0) & (line_idx >= 0))
    kept = kept[np.lexsort((number[kept], image_idx[kept]))]
    start = np.cumsum(count) - count
    ends = np.concatenate([*tables, np.zeros((0, 4))])
    return LineObservations(image_idx[kept], line_idx[kept], ends[start[row[kept]] + number[kept]])


def _unit(groups: list[Group3d], size: int) -> FloatArray:
    """Return the parameters of groups, scaled where the first three are not a unit vector."""
    params = np.array([group.params for group in groups], float).reshape(-1, size)
    if not np.isfinite(params).all():
        raise FileFormatError("A plane or direction is not finite.")
    with np.errstate(over="ignore"):
        length = np.linalg.norm(params[:, :3], axis=1)
    if len(length) and not (length.min() > 1e-12 and length.max() < np.inf):
        raise FileFormatError(f"Group {groups[int(length.argmin())].id} has no normal or direction.")
    off = np.abs(length - 1) > _UNIT_TOLERANCE
    params[off] /= length[off, None]
    return params


def _members(groups: list[Group3d], kind: str, rows: RowsById) -> IntArray:
    """Return the pairs (member, group) whose member is in the scene."""
    pairs = [np.zeros((0, 2), np.int64)]
    for column, group in enumerate(groups):
        found = rows.of(getattr(group, kind)["id"])
        found = found[found >= 0]
        pairs.append(np.column_stack([found, np.full(len(found), column)]))
    return np.concatenate(pairs)


def _own_ids(planes: list[Group3d], directions: list[Group3d], exact: Scene) -> list[IntArray]:
    """Return the identifiers of planes and directions: those of the groups, or as groma had them before writing."""
    written = group_ids(exact, ())
    result = []
    for groups, numbers, table in zip((planes, directions), written, (exact.planes, exact.directions), strict=True):
        before = dict(zip(numbers, table.ids.tolist(), strict=True))
        ids = int_ids(np.array([group.id for group in groups], np.uint64)).tolist()
        restored = [before.get(number, number) for number in ids]
        result.append(np.array(restored if len(set(restored)) == len(ids) else ids, np.int64))
    return result


__all__ = [
    "Group2d",
    "Group3d",
    "Lines3d",
    "Structure2d",
    "Structures",
    "from_scene",
    "read_limap",
    "structures_of",
    "with_structures",
    "write_limap",
]
