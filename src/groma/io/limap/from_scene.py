# SPDX-License-Identifier: BSD-3-Clause
"""From a scene to LIMAP 2's structures; :mod:`groma.io.limap.structures` holds the mapping and the way back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._rows import numbered
from groma._typing import FloatArray, IntArray
from groma.errors import FileFormatError, InputError
from groma.io._numbering import numbered_keypoints
from groma.io.limap.files import (
    EDGE_2D,
    EDGE_3D,
    LINE_2D,
    MEMBER_2D,
    MEMBER_3D,
    NONE,
    PLANE,
    TRACK,
    VANISHING_POINT,
    Group2d,
    Group3d,
    Lines3d,
    Records,
    Structure2d,
    Structures,
)
from groma.scene import Scene


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
    plane_ids, direction_ids = group_ids(scene, tuple(group.id for group in others))
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


def _images_2d(scene: Scene, like: Structures) -> tuple[list[Structure2d], IntArray]:
    """Return the images with their 2D lines, and the number of each line observation within its image."""
    seen = scene.line_observations
    before = {image.image_id: image for image in like.images}
    order = np.argsort(seen.image_idx, kind="stable")
    ends = np.searchsorted(seen.image_idx[order], np.arange(scene.num_images + 1)).tolist()
    line_number = np.zeros(len(seen), np.int64)
    images = []
    counts = np.diff(numbered_keypoints(scene)[1]).tolist()
    for row, (number, num_points) in enumerate(zip(scene.images.ids.tolist(), counts, strict=True)):
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
    uncertainty = np.append(like.lines.uncertainty, -1.0)[RowsById(int_ids(like.lines.ids)).of(lines.ids)]
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
    row = RowsById(before["id"].astype(np.int64)).of(ids)
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
    point_row, line_row = RowsById(scene.points.ids), RowsById(scene.lines.ids)
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
        owner, inside = numbered(self.count[landmarks])
        return self.order[self.start[landmarks][owner] + inside]


# Identifiers


def group_ids(scene: Scene, taken: tuple[int, ...]) -> tuple[list[int], list[int]]:
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


class RowsById:
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


def int_ids(ids: npt.NDArray[np.uint64]) -> IntArray:
    """Return identifiers as signed integers; refuse those that do not fit."""
    if len(ids) and ids.max() > 2**63 - 1:
        raise FileFormatError(f"Identifier {ids.max()} is too large.")
    return ids.astype(np.int64)
