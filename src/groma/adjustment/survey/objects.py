# SPDX-License-Identifier: BSD-3-Clause
"""Tables of measurements of any objects: distances, known planes and directions, poses, and held objects.

Points of the scene of which something was measured become control points without known coordinates: a distance ties
two objects that are estimated together, and points are too many for that. Their observations become marks.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from groma._counted import counted, first_of
from groma._image_names import rows_by_name, tell_partly
from groma._typing import FloatArray, IntArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.fit import noise_of
from groma.adjustment.pixel_residuals import squared_residuals_px
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.names import nearest
from groma.adjustment.survey.similarity import GATES as SIMILARITY
from groma.adjustment.terms.objects import GROUPS
from groma.errors import InputError
from groma.gates import NORMAL
from groma.geometry import quaternion
from groma.geometry.algebra import unit
from groma.io.survey import DirectionsFile, DistancesFile, PlanesFile, PosesFile
from groma.scene import CameraPoses, Distances, Held, KnownDirections, KnownPlanes, Marks, Scene
from groma.scene.survey import DIRECTED, LOCATED, Kind
from groma.scene.table import joined

_LANDMARK = re.compile(r"(point|line|plane|direction):(\d+)")
_KINDS = {"point": Kind.POINT, "line": Kind.LINE, "plane": Kind.PLANE, "direction": Kind.DIRECTION}


@dataclass(frozen=True, eq=False)
class Found:
    """Objects by name."""

    kind: IntArray
    idx: IntArray


def find(names: Sequence[str], scene: Scene, source: str, allowed: Sequence[Kind], missing: bool = False) -> Found:
    """Return the objects that names mean: control points, images, and landmarks such as ``line:5``.

    Parameters
    ----------
    names : sequence of str
        As a file has them.
    scene : Scene
        Its control points are those of the files.
    source : str
        Where they come from, for messages.
    allowed : sequence of Kind
        What may be meant.
    missing : bool
        Names that are none of these are left at -1.

    Raises
    ------
    InputError
        If a name means nothing, or something that is not allowed.
    """
    kind, idx = np.full(len(names), -1), np.full(len(names), -1)
    for known, number in ((scene.images.names, Kind.IMAGE), (scene.control_points.names, Kind.CONTROL_POINT)):
        if number in allowed:
            rows = rows_by_name(names, known)
            kind[rows >= 0], idx[rows >= 0] = number, rows[rows >= 0]
    for row, name in enumerate(names):
        if idx[row] < 0 and (said := _LANDMARK.fullmatch(name)):
            kind[row], idx[row] = _KINDS[said[1]], _landmark(scene, said[1], int(said[2]), source)
        if idx[row] < 0 and not missing:
            known = (*scene.control_points.names, *scene.images.names)
            raise InputError(
                f"{source}: {name!r} is neither a control point nor an image{nearest(name, known)}. Use the same "
                "names; landmarks are named line:5, plane:2, point:17 by their identifiers."
            )
        if idx[row] >= 0 and kind[row] not in allowed:
            words = ", ".join(GROUPS[one].replace("frames", "images").replace("_", " ") for one in allowed)
            raise InputError(f"{source}: {name} cannot be used here; it may be one of {words}.")
    return Found(kind, idx)


def _landmark(scene: Scene, kind: str, number: int, source: str) -> int:
    ids = getattr(scene, f"{kind}s").ids
    rows = np.flatnonzero(ids == number)
    if not len(rows):
        there = f"identifiers from {ids.min()} to {ids.max()}" if len(ids) else f"none; groma map finds {kind}s first"
        raise InputError(f"{source}: there is no {kind} {number} in the scene ({kind}s: {there}).")
    return int(rows[0])


def with_measured_points(scene: Scene, survey: Survey, notes: list[str]) -> Scene:
    """Return the scene in which the points that distances and planes name are control points."""
    names = [*(survey.distances.first + survey.distances.second if survey.distances else ())]
    names += survey.planes.names if survey.planes else ()
    named = dict.fromkeys(name for name in names if name.startswith("point:") and _LANDMARK.fullmatch(name))
    named = [name for name in named if name not in scene.control_points.names]
    if not named:
        return scene
    rows = np.array([_landmark(scene, "point", int(name[6:]), "a file of measurements") for name in named])
    seen, count = scene.point_observations, len(scene.control_points)
    of = np.full(scene.num_points, -1)
    of[rows] = count + np.arange(len(rows))
    mine = np.flatnonzero(of[seen.point_idx] >= 0)
    squares = squared_residuals_px(assemble(scene.keep(lines=[]), AssemblyOptions()))["points"]
    sigma = max(noise_of(squares), 0.05) * seen.sigma[mine]
    marked = Marks(seen.image_idx[mine], of[seen.point_idx[mine]], seen.pixel[mine], sigma)
    notes.append(f"Made control points, with their observations as marks: {', '.join(named)}.")
    points = scene.control_points.with_unmeasured(named, scene.points.xyz[rows])
    return scene.keep(points=of < 0).replace(control_points=points, marks=joined(scene.marks, marked))


def distance_table(scene: Scene, given: DistancesFile, stated: float | None, notes: list[str]) -> Distances:
    """Return the table of distances; the larger kind of each pair is the second."""
    sigma = _stated(given.sigma, stated, given.source, "distances", "--distance-sigma 0.001")
    one, two = (find(names, scene, given.source, LOCATED) for names in (given.first, given.second))
    swap = one.kind > two.kind
    first = Found(np.where(swap, two.kind, one.kind), np.where(swap, two.idx, one.idx))
    second = Found(np.where(swap, one.kind, two.kind), np.where(swap, one.idx, two.idx))
    if (same := (first.kind == second.kind) & (first.idx == second.idx)).any():
        row = int(np.argmax(same))
        raise InputError(f"{given.source}: {given.first[row]} and {given.second[row]} are the same. Drop that line.")
    is_shortest = np.zeros(len(first.kind), bool)
    for row, ends in enumerate(zip(first.kind, first.idx, second.kind, second.idx, strict=True)):
        if (apart := _from_parallel(scene, *ends)) > SIMILARITY.parallel_deg:
            words = f"{given.first[row]} and {given.second[row]} are {apart:.0f} degrees from parallel"
            if Kind.PLANE in (ends[0], ends[2]):
                raise InputError(f"{given.source}: {words}: they meet, so they have no distance. Measure from a mark.")
            if given.distance[row] < NORMAL.sure * sigma[row]:
                raise InputError(
                    f"{given.source}: {words} and as good as meet: {given.distance[row]:.3g} with a standard deviation "
                    f"of {sigma[row]:.3g} does not say on which side. Drop that line."
                )
            is_shortest[row] = True
            notes.append(f"{words}: their distance is the shortest one, of the lines without ends.")
    anchor = np.array([_middle(scene, *ends) for ends in zip(first.kind, first.idx, strict=True)]).reshape(-1, 3)
    return Distances(
        first.kind, first.idx, second.kind, second.idx, anchor, given.distance, sigma, is_shortest=is_shortest
    )


def _from_parallel(scene: Scene, kind: int, idx: int, other_kind: int, other_idx: int) -> float:
    """Return by how many degrees two lines or planes are not parallel; zero for anything else."""
    if kind not in (Kind.LINE, Kind.PLANE):
        return 0.0
    vectors = {Kind.LINE: scene.lines.plucker[:, 3:], Kind.PLANE: scene.planes.hesse[:, :3]}
    one, two = (unit(vectors[Kind(of)][row]) for of, row in ((kind, idx), (other_kind, other_idx)))
    cosine = abs(float(one @ two))
    return float(np.degrees(np.arcsin(min(1.0, cosine)) if kind != other_kind else np.arccos(min(1.0, cosine))))


def plane_table(scene: Scene, given: PlanesFile, stated: float | None) -> KnownPlanes:
    """Return the table of known planes: one row for a camera or point, two for a line, three for a plane."""
    sigma = _stated(given.sigma, stated, given.source, "known planes", "--plane-sigma 0.01")
    found = find(given.names, scene, given.source, LOCATED)
    rows, anchors = [], []
    for row, (kind, idx) in enumerate(zip(found.kind, found.idx, strict=True)):
        if kind == Kind.LINE:
            places = scene.lines.segments[idx]
        elif kind == Kind.PLANE:
            places = _spread_on(scene, int(idx))
        else:
            places = np.zeros((1, 3))
        anchors.append(places)
        rows += [row] * len(places)
    return KnownPlanes(found.kind[rows], found.idx[rows], np.concatenate(anchors), given.hesse[rows], sigma[rows])


def direction_table(scene: Scene, given: DirectionsFile, stated: float | None, notes: list[str]) -> KnownDirections:
    """Return the table of known directions."""
    sigma = _stated(given.sigma_deg, stated, given.source, "directions", "--direction-sigma 1 (degrees)")
    found = find(given.names, scene, given.source, DIRECTED, missing=True)
    known = found.idx >= 0
    if not known.any():
        found = find(given.names, scene, given.source, DIRECTED)
    if missing := [given.names[row] for row in np.flatnonzero(~known)]:
        notes.append(f"{given.source}: not in the scene: {first_of(missing, 3)}.")
    in_world = np.where((found.kind == Kind.IMAGE)[:, None], given.in_world, given.vectors)
    return KnownDirections(
        found.kind[known], found.idx[known], in_world[known], given.vectors[known], np.radians(sigma[known])
    )


def pose_table(scene: Scene, given: PosesFile, stated: tuple[float, ...], notes: list[str]) -> CameraPoses:
    """Return the table of poses, with covariances in the axes of the cameras."""
    rows = rows_by_name(given.names, scene.images.names)
    notes += tell_partly(rows, given.names, scene.images.names, given.source)
    known = np.flatnonzero(rows >= 0)
    if not len(known):
        find(given.names, scene, given.source, (Kind.IMAGE,))
    if len(known) < len(rows):
        notes.append(f"{given.source}: {counted(int((rows < 0).sum()), 'poses')} of images that are not in the scene.")
    covariance = given.covariance[known]
    open_ = np.isnan(covariance).any(axis=(1, 2))
    if open_.any() and len(stated) != 2:
        raise InputError(
            f"{given.source} states no accuracy of its poses. Pass it: --pose-sigma 0.05,0.5 (position, degrees)."
        )
    if open_.any():
        covariance[open_] = np.diag([stated[0] ** 2] * 3 + [np.radians(stated[1]) ** 2] * 3)
    turn = quaternion.conjugate(given.world_from_cam[known, 3:])
    center = given.world_from_cam[known, :3]
    axes = np.zeros((len(known), 6, 6))
    axes[:, :3, :3] = axes[:, 3:, 3:] = quaternion.to_matrix(turn)
    poses = np.hstack([turn, -quaternion.rotate(turn, center)])
    return CameraPoses(rows[known], poses, axes @ covariance @ np.swapaxes(axes, 1, 2))


def held_table(scene: Scene, names: Sequence[str]) -> Held:
    """Return the table of held objects, given by name or by patterns of images and control points."""
    kind, idx = [], []
    for name in names:
        known = ((scene.images.names, Kind.IMAGE), (scene.control_points.names, Kind.CONTROL_POINT))
        rows = [(number, row) for list_, number in known for row, one in enumerate(list_) if fnmatchcase(one, name)]
        if not rows:
            found = find([name], scene, "--hold", tuple(Kind))
            rows = [(int(found.kind[0]), int(found.idx[0]))]
        kind += [one for one, _ in rows]
        idx += [one for _, one in rows]
    pairs = np.unique(np.column_stack([kind, idx]), axis=0)
    return Held(pairs[:, 0], pairs[:, 1])


def _stated(sigma: FloatArray, stated: float | None, source: str, what: str, option: str) -> FloatArray:
    """Return standard deviations as a file has them, else as stated."""
    found = np.where(np.isfinite(sigma), sigma, np.nan if stated is None else stated)
    if not np.isfinite(found).all():
        raise InputError(f"{source} states no accuracy of its {what}. Pass it: {option}.")
    return found


def _middle(scene: Scene, kind: int, idx: int) -> FloatArray:
    """Return a place near a line or plane that is typical of it; zero for others."""
    if kind == Kind.LINE:
        return scene.lines.segments[idx].mean(axis=0)
    return _spread_on(scene, idx).mean(axis=0) if kind == Kind.PLANE else np.zeros(3)


def _spread_on(scene: Scene, plane: int) -> FloatArray:
    """Return three places (3, 3) on a plane, around what lies on it or else around the points and cameras."""
    relations = scene.relations
    on = [scene.points.xyz[relations.point_on_plane[relations.point_on_plane[:, 1] == plane, 0]]]
    on.append(scene.lines.segments[relations.line_on_plane[relations.line_on_plane[:, 1] == plane, 0]].reshape(-1, 3))
    places = np.concatenate(on)
    if len(places) < 3:
        places = np.concatenate([scene.points.xyz, scene.cam_centers_in_world])
    middle = np.median(places, axis=0)
    n, w = scene.planes.hesse[plane, :3], scene.planes.hesse[plane, 3]
    middle = middle - (middle @ n + w) * n
    size = max(float(np.median(np.linalg.norm(places - middle, axis=1))), 1e-12)
    first = np.cross(n, np.eye(3)[np.argmin(np.abs(n))])
    first /= np.linalg.norm(first)
    angles = 2.0 * np.pi / 3.0 * np.arange(3)[:, None]
    return middle + size * (np.cos(angles) * first + np.sin(angles) * np.cross(n, first))
