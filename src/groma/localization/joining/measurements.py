# SPDX-License-Identifier: BSD-3-Clause
"""What was measured of a map that is joined with another: carried over as far as it holds in the joint map.

Depths, marks and distances hold in every world; their unit of length goes with the world, unless both maps know it.
Places and directions in the world of the second map go along with it. Where the first map has measured places, too,
those of the second hold only if both worlds are one, and then stay as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from groma._counted import counted
from groma._typing import BoolArray, FloatArray, IntArray
from groma.gates import NORMAL, gate
from groma.scene import ControlPoints, PointDepths, PrincipalPointPriors, Scene, Similarity
from groma.scene.survey import CHECK, CONTROL, UNKNOWN
from groma.scene.table import Table, joined, moved_table, new_index_of

#: Measurements that hold in every world, and in that of their map.
_ANYWHERE = ("marks", "distances", "camera_motions")
_IN_THE_WORLD = ("camera_positions", "camera_poses", "known_planes", "known_directions", "pose_priors")
_MEASURED = ("role", "measured", "covariance")


@dataclass(frozen=True)
class CarriedGates:
    """Which measurements of one map hold in another."""

    same_place: float = gate(1.0, "px", "distance of an observation of the same feature", "convention: one pixel")


GATES = CarriedGates()


def with_measurements_of(
    scene: Scene, first: Scene, second: Scene, motion: Similarity, images: IntArray, fresh: BoolArray
) -> tuple[Scene, str]:
    """Return a joint map with what was measured of the second map, and a sentence about what is left out.

    Parameters
    ----------
    scene
        The joint map, in the world of the first, with what was measured of that.
    first, second
        The maps.
    motion
        first_from_second.
    images, fresh : (n,)
        The images of the second map in the joint one, and whether the first lacks them: it knows its own.
    """
    if first.has_scale and second.has_scale:
        motion = _with_unit_kept(motion, second.cam_centers_in_world)
    hold = True
    if first.is_surveyed and second.is_surveyed:
        hold = _is_same_world(first, second, motion)
        motion = Similarity() if hold else motion
    points, of_points = _control_points(scene, moved_table(second.control_points, motion), hold)
    landmarks, rows = _measured_landmarks(scene, second, motion)
    new_index = _new_rows(scene, second, np.where(fresh, images, -1)) | rows | {"control_points": of_points}
    tables = {
        "control_points": points,
        **landmarks,
        "principal_point_priors": _lenses(scene, first.num_cameras, second, images),
    }
    left = {"held": len(second.held)}
    for name in ("line_observations", "line_depths", "plane_observations"):
        table, here = moved_table(getattr(second, name), motion), getattr(scene, name)
        kept, rows = table.renumbered(new_index)
        new_index[name] = _after(here, rows, len(table))
        tables[name], left[name] = joined(here, kept), len(table) - len(kept)
    del left["line_observations"]  # of lines without depths
    for name in (*_IN_THE_WORLD, *_ANYWHERE):
        table = moved_table(getattr(second, name), motion)
        kept = table.renumbered(new_index)[0] if hold or name in _ANYWHERE else table.take([])
        tables[name], left[name] = joined(getattr(scene, name), kept), len(table) - len(kept)
    observation = _same_observations(scene, second, images, fresh)
    depths = _point_depths(scene, second, moved_table(second.point_depths, motion), observation)
    columns = moved_table(second.right_columns, motion).renumbered({"point_observations": observation})[0]
    for name, table in (("point_depths", depths), ("right_columns", columns)):
        tables[name], left[name] = joined(getattr(scene, name), table), len(getattr(second, name)) - len(table)
    return scene.replace(**tables), _about(left, hold)


def _with_unit_kept(motion: Similarity, centers: FloatArray) -> Similarity:
    """The motion of some places without its scale, about their middle."""
    middle = centers.mean(axis=0)
    return Similarity(1.0, motion.rotation, motion.points(middle[None])[0] - motion.rotation @ middle)


def _is_same_world(first: Scene, second: Scene, motion: Similarity) -> bool:
    """Whether a motion moves the cameras of the second map by no more than the noise of measured places."""
    centers = second.cam_centers_in_world
    variances = [_variance(first), _variance(second)]
    away = np.linalg.norm(motion.points(centers) - centers, axis=1)
    return bool(np.median(away) <= NORMAL.far * np.sqrt(sum(variances)))


def _variance(scene: Scene) -> float:
    """Median sum of the variances of measured places."""
    points = scene.control_points
    covariances = np.concatenate(
        [
            scene.camera_positions.covariance,
            scene.camera_poses.covariance[:, :3, :3],
            points.covariance[points.is_control],
        ]
    )
    return float(np.median(np.trace(covariances, axis1=1, axis2=2)))


def _control_points(scene: Scene, points: ControlPoints, hold: bool) -> tuple[ControlPoints, IntArray]:
    """Control points of the joint map with those of the second, and the row of each of these. Names tell which is
    which; the first map knows best where its own are.
    """
    if not hold:
        points = points.replace(role=np.full(len(points), UNKNOWN))
    known = {name: row for row, name in enumerate(scene.control_points.names)}
    new = np.array([name not in known for name in points.names], bool)
    rows = np.array([known.get(name, -1) for name in points.names], np.int64)
    rows[new] = len(known) + np.arange(int(new.sum()))
    role, measured, covariance = (getattr(scene.control_points, name).copy() for name in _MEASURED)
    for row, own in zip(rows[~new].tolist(), np.flatnonzero(~new).tolist(), strict=True):
        if role[row] == UNKNOWN and points.role[own] in (CONTROL, CHECK):
            role[row], measured[row], covariance[row] = (getattr(points, name)[own] for name in _MEASURED)
    mine = scene.control_points.replace(role=role, measured=measured, covariance=covariance)
    return joined(mine, points.take(new)), rows


def _new_rows(scene: Scene, second: Scene, images: IntArray) -> dict[str, IntArray]:
    """Rows of the joint map of what the second has; -1 for landmarks, which are mapped anew."""
    rows = {name: np.full(len(getattr(second, name)), -1) for name in ("points", "lines", "planes", "directions")}
    frames = np.full(second.num_frames, -1)
    if second.has_trivial_rigs:
        frames[second.images.frame_idx] = np.where(images >= 0, scene.images.frame_idx[images], -1)
    return rows | {"images": images, "frames": frames}


def _lenses(scene: Scene, num_known: int, second: Scene, images: IntArray) -> PrincipalPointPriors:
    """What is known of lenses whose calibration was not given: of the first ``num_known`` the first map says it."""
    mine, theirs = scene.principal_point_priors, second.principal_point_priors
    row = np.full(second.num_cameras, -1)
    row[second.images.camera_idx] = scene.images.camera_idx[images]
    row[row < num_known] = -1
    theirs = theirs.renumbered({"cameras": row})[0]
    return joined(mine, theirs.take(np.unique(theirs.camera_idx, return_index=True)[1]))


def _measured_landmarks(
    scene: Scene, second: Scene, motion: Similarity
) -> tuple[dict[str, Table], dict[str, IntArray]]:
    """Lines and planes with those of the second map that its cameras measured, and the rows of these; -1 for others."""
    tables, rows = {}, {}
    of_lines = second.line_observations.line_idx[second.line_depths.observation_idx]
    for name, measured in (("lines", of_lines), ("planes", second.plane_observations.plane_idx)):
        chosen, here, own = np.unique(measured), getattr(scene, name), moved_table(getattr(second, name), motion)
        ids = here.ids.max(initial=0) + 1 + np.arange(len(chosen))
        tables[name], rows[name] = joined(here, own.take(chosen).replace(ids=ids)), _after(here, chosen, len(own))
    return tables, rows


def _after(here: Table, chosen: IntArray, size: int) -> IntArray:
    """New rows of ``size`` old ones, of which the chosen ones follow those of a table; -1 for others."""
    row = new_index_of(chosen, size)
    return np.where(row >= 0, row + len(here), -1)


def _same_observations(scene: Scene, second: Scene, images: IntArray, fresh: BoolArray) -> IntArray:
    """The observation of the joint map (n,) that shows what an observation of the second does; -1 for none."""
    here, there = scene.point_observations, second.point_observations
    out = np.full(len(there), -1)
    for own in np.flatnonzero(fresh).tolist():
        rows = np.flatnonzero(there.image_idx == own)
        others = np.flatnonzero(here.image_idx == images[own])
        if not len(rows) or not len(others):
            continue
        near = KDTree(here.pixel[others]).query(there.pixel[rows], distance_upper_bound=GATES.same_place)
        distance, nearest = np.asarray(near[0]), np.asarray(near[1])
        order = np.argsort(distance, kind="stable")
        order = order[np.isfinite(distance[order])]
        order = order[np.unique(nearest[order], return_index=True)[1]]  # each of the joint map once, for the nearest
        out[rows[order]] = others[nearest[order]]
    return out


def _point_depths(scene: Scene, second: Scene, depths: PointDepths, observation: IntArray) -> PointDepths:
    """Depths of the second map as those of the points of the joint map that its observations show."""
    seen = second.point_observations
    number = {key: row for row, key in enumerate(zip(seen.image_idx.tolist(), seen.point_idx.tolist(), strict=True))}
    pairs = zip(depths.image_idx.tolist(), depths.point_idx.tolist(), strict=True)
    row = np.array([observation[number[key]] if key in number else -1 for key in pairs], np.int64)
    kept, row = np.flatnonzero(row >= 0), row[row >= 0]
    here = scene.point_observations
    return depths.take(kept).replace(image_idx=here.image_idx[row], point_idx=here.point_idx[row])


def _about(left: dict[str, int], hold: bool) -> str:
    """Say what is left out; nothing where that is nothing."""
    words = [
        counted(count, name.replace("_", " ").replace("held", "held objects")) for name, count in left.items() if count
    ]
    if not words and hold:
        return ""
    why = "" if hold else " Its places were not measured in the world of the first map."
    return f"Measurements of the second map that are left out: {', '.join(words)}.{why}"
