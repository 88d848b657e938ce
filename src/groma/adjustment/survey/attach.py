# SPDX-License-Identifier: BSD-3-Clause
"""From files of measurements to tables of a scene in their frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.in_frame import placing
from groma.adjustment.survey.objects import (
    direction_table,
    distance_table,
    held_table,
    plane_table,
    pose_table,
    with_measured_points,
)
from groma.adjustment.survey.similarity import GATES, RobustSimilarity
from groma.adjustment.survey.tables import control_tables, position_table
from groma.adjustment.survey.triangulate import triangulated
from groma.adjustment.terms.objects import name_of
from groma.gates import NORMAL, chi_square_gate
from groma.geometry import se3
from groma.io.survey import WorldFrame, common_frame
from groma.scene import Cameras, PosePriors, Scene, Similarity
from groma.scene.survey import diagonal_covariance, rejected_rows, with_rejected


@dataclass(frozen=True, eq=False)
class Surveyed:
    """A scene with its measurements, in their frame."""

    scene: Scene
    #: ``new_from_old``.
    similarity: Similarity
    #: What its coordinates mean.
    frame: WorldFrame
    #: What was read, assumed and left out, in sentences.
    notes: tuple[str, ...] = ()
    #: The fit of the similarity; None where the scene was not moved, or not by places.
    alignment: RobustSimilarity | None = field(default=None)
    #: Names of the places that it is a fit to.
    names: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        fit, held = self.alignment, self.scene.held
        return {
            "frame": self.frame.to_dict(),
            "scale": self.similarity.scale,
            "scatter": None if fit is None else fit.scatter,
            "num_used": None if fit is None else int(fit.inliers.sum()),
            "num_places": None if fit is None else len(fit.inliers),
            "held": [name_of(self.scene, *one) for one in zip(held.kind.tolist(), held.idx.tolist(), strict=True)],
            "notes": list(self.notes),
        }


def with_survey(scene: Scene, survey: Survey) -> Surveyed:
    """Bring a scene into the frame of measurements, and add these to it.

    Positions, poses and control points (not those kept back) determine a robust similarity; distances alone the scale,
    known directions the turn, known planes the turn and the height. A scene that holds such measurements already, or of
    which something is held, stays where it is. Marks that pass by where others of their point meet are rejected until
    they are tested against the result.

    Parameters
    ----------
    scene : Scene
        Cameras with poses.
    survey : Survey
        What was measured.

    Raises
    ------
    InputError
        If names are unknown, coordinate systems or axes do not fit, or accuracies are missing.
    """
    notes: list[str] = []
    measured, frame = _with_places(scene, survey, notes)
    measured = _with_objects(measured, survey, notes)
    found = placing(scene, measured, survey, frame, notes)
    moved = measured.transformed(found.similarity, measured=False)
    if len(moved.control_points):
        seen, agrees = triangulated(moved, moved.marks, len(moved.control_points))
        moved = _without_strays(moved, agrees)
        known: BoolArray = np.asarray(np.isfinite(seen).all(axis=1))
        points = moved.control_points
        moved = moved.replace(control_points=points.replace(xyz=np.where(known[:, None], seen, points.measured)))
    if found.fit is not None:
        moved = _with_shown_noise(moved, survey, found.fit, notes)
    if len(moved.pose_priors) and survey.poses is not None:
        moved = moved.replace(pose_priors=PosePriors())  # the same poses, with the noise that is known
    elif len(moved.pose_priors) and found.fit is not None:
        moved = moved.replace(pose_priors=PosePriors())
        notes.append(
            "The given poses are in another frame than the measurements: they placed the photographs, and weigh "
            "nothing beside the measurements."
        )
    return Surveyed(moved, found.similarity, frame, tuple(notes), found.fit, found.names)


def check_survey(survey: Survey, names: Sequence[str], sizes: npt.ArrayLike) -> None:
    """Refuse measurements that no scene of some images can hold, wherever its cameras are.

    Parameters
    ----------
    survey : Survey
        What was measured.
    names : sequence of N strings
        The images.
    sizes : (N, 2) int
        Their widths and heights, pixels.

    Raises
    ------
    InputError
        If no image has a name of a file, marks lie outside their images, coordinate systems do not fit, or accuracies
        are missing.
    """
    count = len(names)
    cameras = Cameras.of(np.arange(count) + 1, ["SIMPLE_PINHOLE"] * count, [(1.0, 0.0, 0.0)] * count, sizes)
    scene = Scene.from_images(cameras, names, np.arange(count), se3.identity(count))
    notes: list[str] = []
    _with_places(scene, survey, notes)
    if survey.poses is not None:
        pose_table(scene, survey.poses, survey.pose_sigma, notes)


def _with_places(scene: Scene, survey: Survey, notes: list[str]) -> tuple[Scene, WorldFrame]:
    """Return the scene with measured positions and control points, and the frame that these are in."""
    groups = [group for group in (survey.positions, survey.control and survey.control.places) if group is not None]
    places, frame = common_frame(groups, survey.crs)
    for group in groups:
        notes += group.notes
    tables: dict[str, Any] = {}
    if survey.positions is not None:
        tables["camera_positions"] = position_table(scene, survey, places[0], notes)
    if survey.control is not None:
        tables["control_points"], tables["marks"] = control_tables(scene, survey, survey.control, places[-1], notes)
    return scene.replace(**tables), frame


def _with_shown_noise(scene: Scene, survey: Survey, fit: RobustSimilarity, notes: list[str]) -> Scene:
    """Return the scene whose positions have the noise that they show about its cameras, where nobody stated any.

    What most of them agree on would be too little: receivers drift, and part of a flight is metres beside the rest. So
    all that the usual noise allows for count. An error that all of them have in common does not show: they keep the
    usual noise beside other measurements of where the scene is, and where they are too few, on a line or without
    heights.
    """
    given, table = survey.positions, scene.camera_positions
    if given is None or not given.usual_sigma or survey.position_sigma or np.isfinite(given.sigma).any():
        return scene
    residuals = fit.residuals[: len(table)]
    usual = ((residuals / given.usual_sigma) ** 2).sum(axis=1) <= chi_square_gate(NORMAL.gross, 3)
    residuals = residuals[usual]
    spare = len(residuals) - 3  # derived from a similarity of level places: of seven three for heights
    placed_otherwise = any(one is not None for one in (survey.control, survey.planes, survey.poses))
    if spare < GATES.spare or fit.on_line or placed_otherwise:
        return scene
    east, north, up = np.sqrt((residuals**2).sum(axis=0) / [spare + 1, spare + 1, spare])
    across = float(np.hypot(east, north) / np.sqrt(2.0))
    notes.append(
        f"{given.source} states no accuracy of the positions. They scatter about the cameras by {across:.2g} "
        f"horizontally and {up:.2g} in height, which is taken as their noise. An error that all of them share does "
        f"not show: the place of the whole scene is as uncertain as usual ({given.usual_sigma[0]:g}, "
        f"{given.usual_sigma[2]:g})."
    )
    sigma = np.tile([across, across, up], (len(table), 1))
    return scene.replace(camera_positions=table.replace(covariance=diagonal_covariance(sigma)))


def _without_strays(scene: Scene, agrees: BoolArray) -> Scene:
    """Return the scene without the marks whose rays pass by where two others of their point meet, for the time being.

    A robust loss is as content with a place behind all cameras, or at infinity, that is a little wrong for every mark.
    """
    marks = scene.marks
    meeting = np.bincount(marks.point_idx[agrees], minlength=len(scene.control_points))
    strays = np.flatnonzero(~agrees & (meeting[marks.point_idx] >= 2)).tolist()
    return with_rejected(scene, rejected_rows(scene) | {("marks", row) for row in strays}) if strays else scene


def _with_objects(scene: Scene, survey: Survey, notes: list[str]) -> Scene:
    """Return the scene with what was measured of its objects."""
    scene = with_measured_points(scene, survey, notes)
    tables: dict[str, Any] = {}
    if survey.distances is not None:
        tables["distances"] = distance_table(scene, survey.distances, survey.distance_sigma, notes)
    if survey.planes is not None:
        tables["known_planes"] = plane_table(scene, survey.planes, survey.plane_sigma)
    if survey.directions is not None:
        tables["known_directions"] = direction_table(scene, survey.directions, survey.direction_sigma_deg, notes)
    if survey.poses is not None:
        tables["camera_poses"] = pose_table(scene, survey.poses, survey.pose_sigma, notes)
    if survey.hold:
        tables["held"] = held_table(scene, survey.hold)
    return scene.replace(**tables)


__all__ = ["Survey", "Surveyed", "check_survey", "with_survey"]
