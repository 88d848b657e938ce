# SPDX-License-Identifier: BSD-3-Clause
"""The similarity that places a scene by measurements, before any adjustment.

Places determine a similarity that most of them agree on. Without places, known directions turn the scene, known planes
turn and lift it, distances scale it; the rest of the similarity is left unchanged.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groma._image_names import rows_by_name
from groma._typing import FloatArray
from groma.adjustment.survey.best_fit import measured_at_positions
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.level import check_directions, level
from groma.adjustment.survey.orientations import check_orientations
from groma.adjustment.survey.similarity import GATES, RobustSimilarity, robust_similarity, upright
from groma.adjustment.survey.tables import listed
from groma.adjustment.survey.triangulate import triangulated
from groma.adjustment.survey.units import check_lengths, check_places
from groma.errors import InputError
from groma.evaluation.alignment import camera_centers, pose_alignment
from groma.gates import NORMAL
from groma.io.survey import WorldFrame, common_frame
from groma.scene import Scene, Similarity
from groma.scene.survey import Kind


@dataclass(frozen=True, eq=False)
class Placing:
    """The placement of a scene."""

    similarity: Similarity
    #: How well places fit; None where none determined the similarity.
    fit: RobustSimilarity | None = None
    #: Names of these places.
    names: tuple[str, ...] = ()


def placing(before: Scene, scene: Scene, survey: Survey, frame: WorldFrame, notes: list[str]) -> Placing:
    """Return the placement of a scene by measurements.

    Parameters
    ----------
    before : Scene
        Without the measurements that are new.
    scene : Scene
        The same with them.
    survey, frame
        What was given, and the frame of its places.
    notes : list of str
        Sentences are added to it.

    Raises
    ------
    InputError
        If places are too few, or axes do not fit.
    """
    source, target, names = _correspondences(scene)
    if len(scene.held) or before.is_tied:
        held = "The scene stays where it is, because parts of it are held."
        notes.append(held if len(scene.held) else "The scene is placed by measurements already and stays where it is.")
        _check_near(scene, source, target, notes[-1])
        return Placing(Similarity())
    if len(source) == 0:
        scaled = _scaled(scene, notes)
        return Placing(level(scene.transformed(scaled, measured=False), notes).after(scaled))
    if len(source) < 3:
        raise InputError(
            f"Of the cameras and control points of the scene the measurements place only {len(source)}; three are "
            "needed. Add positions, or control points that two images show."
        )
    try:
        fit = robust_similarity(source, target)
    except InputError:
        _check_exchanged(scene, survey, source, None)
        check_orientations(scene, None)
        raise
    check_orientations(scene, None if fit.on_line else fit.similarity.rotation)
    _check_exchanged(scene, survey, source, fit)
    _check_units(scene, source, target, fit)
    if fit.on_line and len(scene.camera_poses) > 1:
        fit = _by_orientations(scene, fit, source, target)
    elif fit.on_line:
        fit = upright(fit, scene, target)
        notes.append(
            "The measured positions are collinear, which leaves the rotation about their line undetermined. It was "
            "chosen so that the cameras are upright."
        )
    check_directions(scene, fit.similarity.rotation)
    if len(far := np.flatnonzero(~fit.inliers)):
        rows = far[np.argsort(-np.linalg.norm(fit.residuals[far], axis=1))]
        told = [f"{names[row]} ({np.linalg.norm(fit.residuals[row]):.3g})" for row in rows]
        notes.append(f"Far from where the others put them, before the adjustment: {listed(told, 'places')}.")
    if _is_there(scene, fit):
        notes.append("The given poses are in the frame of the measurements already: the scene stays where it is.")
        return Placing(Similarity())
    into = "the frame of the measured poses" if len(source) == len(scene.camera_poses) else frame.description
    notes.append(
        f"The scene was brought into {into} by a similarity (scale {fit.similarity.scale:.6g}) to "
        f"{int(fit.inliers.sum())} of {len(fit.inliers)} measured places, which scatter by {fit.scatter:.3g} a "
        "coordinate."
    )
    return Placing(fit.similarity, fit, tuple(names))


def _correspondences(scene: Scene) -> tuple[FloatArray, FloatArray, Sequence[str]]:
    """Return places in the scene, where they were measured, and their names."""
    positions, poses, points = scene.camera_positions, scene.camera_poses, scene.control_points
    images = np.concatenate([positions.image_idx, poses.image_idx])
    seen, _ = triangulated(scene, scene.marks, len(points))
    usable = np.flatnonzero(points.is_control & np.isfinite(seen).all(axis=1))
    source = np.concatenate([scene.cam_centers_in_world[images], seen[usable]])
    target = np.concatenate([positions.xyz, camera_centers(poses.cam_from_world), points.measured[usable]])
    names = [scene.images.names[row] for row in images] + [points.names[row] for row in usable]
    return source, target, names


def _check_near(scene: Scene, source: FloatArray, target: FloatArray, stays: str) -> None:
    """Refuse places that are farther from where the scene has them than it is large: they are in another frame."""
    size = float(np.linalg.norm(np.ptp(np.concatenate([scene.cam_centers_in_world, scene.points.xyz]), axis=0)))
    away = float(np.median(np.linalg.norm(target - source, axis=1))) if len(source) else 0.0
    noise = np.trace(scene.camera_positions.covariance, axis1=1, axis2=2)
    if away > size + NORMAL.far * np.sqrt(noise.max(initial=0.0)):
        raise InputError(
            f"{stays} The measured places are {away:.3g} away from where it has them, farther than it is large "
            f"({size:.3g}). Pass measurements in its frame, or bring it into theirs first (groma align)."
        )


def _by_orientations(scene: Scene, fit: RobustSimilarity, source: FloatArray, target: FloatArray) -> RobustSimilarity:
    """Return a similarity to places on a line, with the rotation about it from measured poses."""
    table = scene.camera_poses
    found = pose_alignment(scene.cam_from_world[table.image_idx], table.cam_from_world).similarity
    return replace(fit, similarity=found, residuals=target - found.points(source), on_line=False)


def _is_there(scene: Scene, fit: RobustSimilarity) -> bool:
    """Whether given poses and measurements place the scene alike, within their uncertainty."""
    priors = scene.pose_priors
    if not len(priors):
        return False
    centers = scene.cam_centers_in_world
    moved = np.linalg.norm(fit.similarity.points(centers) - centers, axis=1)
    noise = np.hypot(fit.scatter, float(np.median(priors.sigma[:, :3])))
    return bool(np.median(moved) <= NORMAL.far * noise)


def _check_exchanged(scene: Scene, survey: Survey, source: FloatArray, fit: RobustSimilarity | None) -> None:
    """Refuse longitudes and latitudes that fit much better the other way round, or only so."""
    both = (survey.positions, survey.control and survey.control.places)
    groups = [group for group in both if group is not None]
    if len(groups) != 1 or not groups[0].system.is_geographic or len(source) < 4:
        return
    given = groups[0]
    swapped = replace(given, coordinates=given.coordinates[:, [1, 0, 2]])
    found = rows_by_name(given.names, scene.images.names) >= 0
    if survey.positions is None:
        found = np.isin(given.names, _correspondences(scene)[2])
    if np.nanmax(np.abs(swapped.coordinates[:, 1])) > 90.0 or int(found.sum()) != len(source):
        return
    try:
        other = robust_similarity(source, common_frame([swapped])[0][0][found])
    except InputError:
        return
    if fit is None or other.scatter * GATES.better < fit.scatter:
        raise InputError(
            f"{given.source}: its places fit the scene much better with longitude and latitude exchanged. x is the "
            "longitude; correct the order."
        )


def _check_units(scene: Scene, source: FloatArray, target: FloatArray, fit: RobustSimilarity) -> None:
    """Refuse places, heights and distances that are in different units."""
    positions = len(scene.camera_positions)
    check_places(source, target, fit, positions, len(source) - positions - len(scene.camera_poses))
    if len(ratios := _ratios(scene)):
        check_lengths(float(np.median(ratios)) / fit.similarity.scale, "The measured distances", "the measured places")


def _scaled(scene: Scene, notes: list[str]) -> Similarity:
    """Return the scaling of a scene to its measured distances."""
    if not len(ratios := _ratios(scene)):
        return Similarity()
    similarity = Similarity(float(np.median(ratios)))
    notes.append(f"The scene was scaled by {similarity.scale:.6g} to its measured distances.")
    return similarity


def _ratios(scene: Scene) -> FloatArray:
    """Return by which factors measured distances differ from those of the scene, where it has them."""
    table = measured_at_positions(scene)
    points, _ = triangulated(scene, scene.marks, len(scene.control_points))
    places = {Kind.IMAGE: scene.cam_centers_in_world, Kind.CONTROL_POINT: points}
    ratios = []
    for row, (kind, other) in enumerate(zip(table.first_kind, table.second_kind, strict=True)):
        first = places[kind][table.first_idx[row]] if kind in places else table.anchor[row]
        index = table.second_idx[row]
        if other in places:
            apart = np.linalg.norm(places[other][index] - first)
        elif other == Kind.LINE:
            line = scene.lines.plucker[index]
            apart = np.linalg.norm(np.cross(first, line[3:]) - line[:3])
        else:
            apart = abs(scene.planes.hesse[index] @ np.append(first, 1.0))
        ratios.append(table.distance[row] / apart if apart > 0.0 else np.nan)
    return np.array([ratio for ratio in ratios if np.isfinite(ratio)])
