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
images, points and lines that were deleted; segments may have no length (left out unless groma wrote them); planes
and directions share one sequence of identifiers. LIMAP demands a structure for every image, with its number of 2D
points, and indices within bounds; it is written so. In text it cannot read 2D groups that have points (its own
neither), so beside a text model 2D groups are written without them; their 3D groups have them.

Two things of a scene have no place in these files: a line's Plücker vector, where it is not exactly that of its end
points, and identifiers of planes and directions that occur in both. Where they matter ``groma.npz`` lies beside,
a groma archive of the bare landmarks; it counts for a line only while its end points are unchanged.
"""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import FileFormatError, InputError
from groma.io._atomic import atomic_output
from groma.io._limap_files import (
    EDGE_2D,
    EDGE_3D,
    LINE_2D,
    MEMBER_2D,
    MEMBER_3D,
    NAMES,
    NONE,
    PLANE,
    SUFFIX,
    TRACK,
    VANISHING_POINT,
    Form,
    Group2d,
    Group3d,
    Lines3d,
    Records,
    Structure2d,
    Structures,
    read_files,
    write_files,
)
from groma.io._numbering import numbered_keypoints
from groma.io._reading import existing, reading
from groma.io.archive import read_archive, write_archive
from groma.scene import Directions, LineObservations, Lines, Planes, Relations, Scene

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


def write_limap(
    structures: Structures, path: str | os.PathLike[str], form: Form = "binary", force: bool = False
) -> None:
    """Write structures as a new folder, which goes beside a COLMAP model under the name ``structures``."""
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
    """Return the scene with the structures beside its COLMAP model, where there are any."""
    folder = model / "structures"
    form = _form(folder)
    if form is None:
        return scene
    with reading(folder, _KIND):
        structures = read_files(folder, form)
        exact = read_archive(folder / _EXACT) if (folder / _EXACT).is_file() else Scene()
        return with_structures(scene, structures, exact)


def write_beside(scene: Scene, model: Path, form: Form, like: Structures | None = None) -> None:
    """Write what a COLMAP model cannot hold into its folder, where there is any of it."""
    if like is None and not (scene.num_lines or scene.num_planes or scene.num_directions):
        return
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
    point_row = _Rows(scene.points.ids)
    line_row = _Rows(lines.ids)
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
    ids = _int_ids(stored.ids)
    known = _Rows(exact.ids).of(stored.ids)
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
    row = _Rows(np.array([image.image_id for image in structures.images], np.int64)).of(track["image_id"])
    image_idx = _Rows(scene.images.ids).of(track["image_id"])
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


def _members(groups: list[Group3d], kind: str, rows: _Rows) -> IntArray:
    """Return the pairs (member, group) whose member is in the scene."""
    pairs = [np.zeros((0, 2), np.int64)]
    for column, group in enumerate(groups):
        found = rows.of(getattr(group, kind)["id"])
        found = found[found >= 0]
        pairs.append(np.column_stack([found, np.full(len(found), column)]))
    return np.concatenate(pairs)


def _own_ids(planes: list[Group3d], directions: list[Group3d], exact: Scene) -> list[IntArray]:
    """Return the identifiers of planes and directions: those of the groups, or as groma had them before writing."""
    written = _group_ids(exact, ())
    result = []
    for groups, numbers, table in zip((planes, directions), written, (exact.planes, exact.directions), strict=True):
        before = dict(zip(numbers, table.ids.tolist(), strict=True))
        ids = _int_ids(np.array([group.id for group in groups], np.uint64)).tolist()
        restored = [before.get(number, number) for number in ids]
        result.append(np.array(restored if len(set(restored)) == len(ids) else ids, np.int64))
    return result


def _group_ids(scene: Scene, taken: tuple[int, ...]) -> tuple[list[int], list[int]]:
    """Return identifiers of groups for planes and directions: their own where they are free, else new ones."""
    used = set(taken)
    result: list[list[int]] = []
    highest = max([*taken, *scene.planes.ids.tolist(), *scene.directions.ids.tolist()], default=0)
    for ids in (scene.planes.ids.tolist(), scene.directions.ids.tolist()):
        numbers = []
        for number in ids:
            if number in used:
                highest += 1
                number = highest
            used.add(number)
            numbers.append(number)
        result.append(numbers)
    return result[0], result[1]


class _Rows:
    """Rows by identifier."""

    def __init__(self, ids: IntArray) -> None:
        self.order = np.argsort(ids, kind="stable")
        self.ids = ids[self.order]

    def of(self, wanted: npt.NDArray[Any]) -> IntArray:
        """Return the row of each identifier, -1 where there is none."""
        if len(self.ids) == 0:
            return np.full(len(wanted), -1, np.int64)
        number = wanted.astype(np.int64)  # beyond 2^63 it turns negative, and is not found
        place = np.minimum(np.searchsorted(self.ids, number), len(self.ids) - 1)
        return np.where(self.ids[place] == number, self.order[place], -1)


def _int_ids(ids: npt.NDArray[np.uint64]) -> IntArray:
    if len(ids) and ids.max() > 2**63 - 1:
        raise FileFormatError(f"Identifier {ids.max()} is too large.")
    return ids.astype(np.int64)


# From a scene


def from_scene(scene: Scene, like: Structures | None = None) -> Structures:
    """Return the LIMAP structures of a scene that is written as a COLMAP model beside.

    2D lines are the line observations, in their order within each image. 2D groups and 2D wireframes are made from
    the relations, of members that the image sees; the tracks of the groups name them.

    Parameters
    ----------
    scene : Scene
        What to write.
    like : Structures, optional
        The structures that the scene came from: 2D lines without a 3D line, scores, weights, uncertainties, 2D groups
        and wireframes, and groups that a scene cannot hold stay as they are there.

    Raises
    ------
    InputError
        If an identifier is negative or too large for the files.
    """
    if like is None:
        like = Structures()
    _check_ids(scene)
    others = tuple(group for group in like.groups if group.kind not in (PLANE, VANISHING_POINT))
    images, line_number = _images_2d(scene, like)
    plane_ids, direction_ids = _group_ids(scene, tuple(group.id for group in others))
    groups = [
        *_groups_3d(scene, PLANE, plane_ids, scene.planes.hesse, like),
        *_groups_3d(scene, VANISHING_POINT, direction_ids, scene.directions.vectors, like),
    ]
    images, tracks = _groups_2d(scene, images, groups, line_number, like)
    groups = [replace(group, track=tracks[group.id]) for group in groups]
    return Structures(images, _lines_3d(scene, line_number, like), (*groups, *others), _wireframe_3d(scene, like))


def _check_ids(scene: Scene) -> None:
    tables = {"images": scene.images, "points": scene.points, "lines": scene.lines}
    tables |= {"planes": scene.planes, "directions": scene.directions}
    for name, table in tables.items():
        limit = 2**32 - 2 if name == "images" else 2**63 - 1
        if len(table) and not (table.ids.min() >= 0 and table.ids.max() <= limit):
            raise InputError(f"LIMAP files hold identifiers of {name} from 0 to {limit}. Renumber them.")


def _num_points(scene: Scene) -> IntArray:
    return np.diff(numbered_keypoints(scene)[1])


def _images_2d(scene: Scene, like: Structures) -> tuple[list[Structure2d], IntArray]:
    """Return the images with their 2D lines, and the number of each line observation within its image."""
    seen = scene.line_observations
    before = {image.image_id: image for image in like.images}
    order = np.argsort(seen.image_idx, kind="stable")
    ends = np.searchsorted(seen.image_idx[order], np.arange(scene.num_images + 1)).tolist()
    line_number = np.zeros(len(seen), np.int64)
    images = []
    for row, (number, num_points) in enumerate(
        zip(scene.images.ids.tolist(), _num_points(scene).tolist(), strict=True)
    ):
        mine = order[ends[row] : ends[row + 1]]
        old = before.get(number, Structure2d(number))
        free: dict[bytes, list[int]] = {}
        for place in range(len(old.lines) - 1, -1, -1):
            free.setdefault(old.lines["ends"][place].tobytes(), []).append(place)
        added = []
        for observation in mine.tolist():
            places = free.get(seen.segment[observation].tobytes())
            if places:
                line_number[observation] = places.pop()
            else:
                line_number[observation] = len(old.lines) + len(added)
                added.append(observation)
        new = np.zeros(len(added), LINE_2D)
        new["ends"], new["score"] = seen.segment[added], -1.0
        lines = np.concatenate([old.lines, new])
        lines["line_id"] = NONE
        lines["line_id"][line_number[mine]] = scene.lines.ids[seen.line_idx[mine]]
        kept = old if old.num_points == num_points else Structure2d(number)
        images.append(Structure2d(number, num_points, lines, kept.groups, kept.wireframe))
    return images, line_number


def _lines_3d(scene: Scene, line_number: IntArray, like: Structures) -> Lines3d:
    seen, lines = scene.line_observations, scene.lines
    order = np.argsort(seen.line_idx, kind="stable")
    track = np.zeros(len(seen), TRACK)
    track["image_id"] = scene.images.ids[seen.image_idx[order]]
    track["idx"] = line_number[order]
    uncertainty = np.append(like.lines.uncertainty, -1.0)[_Rows(_int_ids(like.lines.ids)).of(lines.ids)]
    start = np.searchsorted(seen.line_idx[order], np.arange(len(lines) + 1))
    return Lines3d(lines.ids.astype("<u8"), lines.segments, uncertainty, start, track)


def _groups_3d(scene: Scene, kind: int, ids: list[int], params: FloatArray, like: Structures) -> list[Group3d]:
    """Return planes or directions as groups with their members; weights as they were, else one."""
    before = {group.id: group for group in like.groups if group.kind == kind}
    relations = scene.relations
    points, lines = (
        (relations.point_on_plane, relations.line_on_plane)
        if kind == PLANE
        else (np.zeros((0, 2), np.int64), relations.line_along_direction)
    )
    groups = []
    for column, number in enumerate(ids):
        old = before.get(number, Group3d(number, kind, params[column]))
        groups.append(
            Group3d(
                number,
                kind,
                params[column],
                _weighted(scene.points.ids[points[points[:, 1] == column, 0]], old.points),
                _weighted(scene.lines.ids[lines[lines[:, 1] == column, 0]], old.lines),
            )
        )
    return groups


def _weighted(ids: IntArray, before: Records) -> Records:
    members = np.zeros(len(ids), MEMBER_3D)
    members["id"] = ids
    row = _Rows(before["id"].astype(np.int64)).of(ids)
    members["weight"] = np.append(before["weight"], 1.0)[row]
    return members


def _wireframe_3d(scene: Scene, like: Structures) -> Records:
    point, line = scene.relations.point_on_line.T
    edges = np.zeros(len(point), EDGE_3D)
    edges["point"], edges["line"] = scene.points.ids[point], scene.lines.ids[line]
    before = {(p, ln): weight for p, ln, weight in like.wireframe.tolist()}
    edges["weight"] = [before.get((p, ln), 1.0) for p, ln, _ in edges.tolist()]
    return edges


def _groups_2d(
    scene: Scene, images: list[Structure2d], groups: list[Group3d], line_number: IntArray, like: Structures
) -> tuple[tuple[Structure2d, ...], dict[int, Records]]:
    """Return the images with their groups and wireframes, and the tracks of the groups.

    Groups that were known before keep their 2D groups; for new ones they are made of the members that an image sees.
    """
    row = {image.image_id: place for place, image in enumerate(images)}
    tracks: dict[int, list[tuple[int, int]]] = {group.id: [] for group in groups}
    added: list[list[Group2d]] = [list(image.groups) for image in images]
    for place, image in enumerate(images):
        added[place] = [group if group.group_id in tracks else replace(group, group_id=NONE) for group in image.groups]
    known = {group.id for group in like.groups if len(group.track)}
    for group in like.groups:
        for image_id, idx in group.track.tolist():
            if group.id in tracks and image_id in row and idx < len(images[row[image_id]].groups):
                tracks[group.id].append((image_id, idx))
    points, seen = scene.point_observations, scene.line_observations
    number = numbered_keypoints(scene)[2][: len(points)]
    by_point = _Inverse(points.point_idx, scene.num_points)
    by_line = _Inverse(seen.line_idx, scene.num_lines)
    point_row, line_row = _Rows(scene.points.ids), _Rows(scene.lines.ids)
    for group in groups:
        if group.id in known:
            continue
        p, ln = by_point.rows(point_row.of(group.points["id"])), by_line.rows(line_row.of(group.lines["id"]))
        members = {}
        for kind, image_idx, numbers in (
            ("points", points.image_idx[p], number[p]),
            ("lines", seen.image_idx[ln], line_number[ln]),
        ):
            order = np.lexsort((numbers, image_idx))
            found, start = np.unique(image_idx[order], return_index=True)
            for image, chunk in zip(found.tolist(), np.split(numbers[order], start[1:]), strict=False):
                table = np.ones(len(chunk), MEMBER_2D)
                table["idx"] = chunk
                members.setdefault(image, {})[kind] = table
        for image in sorted(members):
            tracks[group.id].append((images[image].image_id, len(added[image])))
            added[image].append(Group2d(group.kind, group_id=group.id, **members[image]))
    edges = _wireframes_2d(scene, by_point, by_line, number, line_number)
    before = {image.image_id: image.num_points for image in like.images}
    result = tuple(
        replace(image, groups=tuple(found), wireframe=image.wireframe if same else edge)
        for image, found, edge in zip(images, added, edges, strict=True)
        for same in [before.get(image.image_id) == image.num_points]
    )
    return result, {name: np.array(track, TRACK) for name, track in tracks.items()}


def _wireframes_2d(
    scene: Scene, by_point: _Inverse, by_line: _Inverse, number: IntArray, line_number: IntArray
) -> list[Records]:
    """Return, for each image, the 2D points and 2D lines it sees of points on lines."""
    point, line = scene.relations.point_on_line.T
    first = by_point.rows(point)
    pair = np.repeat(np.arange(len(point)), by_point.count[point])
    second = by_line.rows(line[pair])
    first = np.repeat(first, by_line.count[line[pair]])
    image_idx = scene.point_observations.image_idx[first]
    same = image_idx == scene.line_observations.image_idx[second]
    order = np.flatnonzero(same)[np.argsort(image_idx[same], kind="stable")]
    edges = np.ones(len(order), EDGE_2D)
    edges["point"], edges["line"] = number[first[order]], line_number[second[order]]
    ends = np.searchsorted(image_idx[order], np.arange(scene.num_images + 1)).tolist()
    return [edges[ends[row] : ends[row + 1]] for row in range(scene.num_images)]


class _Inverse:
    """From landmarks to the rows that observe them."""

    def __init__(self, landmark_idx: IntArray, size: int) -> None:
        self.order = np.argsort(landmark_idx, kind="stable")
        self.count = np.bincount(landmark_idx, minlength=size)
        self.start = np.cumsum(self.count) - self.count

    def rows(self, landmarks: IntArray) -> IntArray:
        """Return the rows of several landmarks, one landmark after the other."""
        count = self.count[landmarks]
        inside = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return self.order[np.repeat(self.start[landmarks], count) + inside]


__all__ = [
    "Group2d",
    "Group3d",
    "Lines3d",
    "Structure2d",
    "Structures",
    "from_scene",
    "read_limap",
    "with_structures",
    "write_limap",
]
