# SPDX-License-Identifier: BSD-3-Clause
"""A scene brought into the frame of another one, or of measurements, by a similarity: nothing is adjusted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._image_names import rows_by_name
from groma._typing import BoolArray, FloatArray
from groma.adjustment.survey.attach import with_survey
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.names import require_some
from groma.adjustment.survey.similarity import robust_similarity
from groma.errors import InputError
from groma.evaluation.alignment import camera_centers, pose_alignment
from groma.geometry import quaternion
from groma.scene import Scene, Similarity
from groma.scene.checks import check_scene_given


@dataclass(frozen=True, eq=False)
class Alignment:
    """An aligned scene, and the residuals of the alignment."""

    scene: Scene
    #: ``new_from_old``.
    similarity: Similarity
    #: (N,) names of the places that are known in both frames: images or control points.
    names: tuple[str, ...]
    #: (N, 3) reference less scene there, after the alignment; units of the reference.
    residuals: FloatArray
    #: (N,) whether the similarity was fitted to a place; the others are too far off.
    inliers: BoolArray
    #: (N,) angles between the orientations, radians; None where the reference has none.
    angles: FloatArray | None = None
    #: Sentences.
    notes: tuple[str, ...] = ()

    @property
    def rmse(self) -> float:
        """Root mean squared distance of the places that the similarity was fitted to."""
        return float(np.sqrt(np.mean(np.sum(self.residuals[self.inliers] ** 2, axis=1))))

    def to_dict(self) -> dict[str, Any]:
        """Return plain values, for JSON."""
        return {
            "scale": self.similarity.scale,
            "rotation": self.similarity.rotation.tolist(),
            "translation": self.similarity.translation.tolist(),
            "num_places": len(self.names),
            "num_used": int(self.inliers.sum()),
            "rmse": self.rmse,
            "residuals": {name: row.tolist() for name, row in zip(self.names, self.residuals, strict=True)},
            "left_out": [name for name, used in zip(self.names, self.inliers, strict=True) if not used],
            "angles_deg": None if self.angles is None else np.degrees(self.angles).tolist(),
            "notes": list(self.notes),
        }


def align(scene: Scene, reference: Scene | Survey) -> Alignment:
    """Align a scene with a reference by a robust similarity.

    Parameters
    ----------
    scene : Scene
        In any frame.
    reference : Scene or Survey
        A scene with images of the same names; orientations are used too if their centres do not determine the rotation.
        Or measured positions or control points; they are not added to the scene.

    Raises
    ------
    InputError
        If fewer than three positions are known in both frames, or these are mirror images of each other.
    """
    check_scene_given(scene)
    check_scene_given(reference, "reference", Survey)
    if isinstance(reference, Survey):
        return _to_survey(scene, reference)
    rows = rows_by_name(scene.images.names, reference.images.names)
    require_some(rows, scene.images.names, reference.images.names, "the scene")
    mine = np.flatnonzero(rows >= 0)
    names = tuple(scene.images.names[row] for row in mine)
    source, target = scene.cam_from_world[mine], reference.cam_from_world[rows[mine]]
    similarity, inliers, notes = _of_poses(source, target)
    moved = similarity.poses(source)
    residuals = camera_centers(target) - camera_centers(moved)
    turn = quaternion.multiply(target[:, :4], quaternion.conjugate(moved[:, :4]))
    angles = 2.0 * np.arctan2(np.linalg.norm(turn[:, :3], axis=1), np.abs(turn[:, 3]))
    return Alignment(scene.transformed(similarity), similarity, names, residuals, inliers, angles, notes)


def _of_poses(source: FloatArray, target: FloatArray) -> tuple[Similarity, BoolArray, tuple[str, ...]]:
    centers = camera_centers(source), camera_centers(target)
    inliers = np.ones(len(source), bool)
    if len(source) >= 3:
        try:
            inliers = robust_similarity(*centers).inliers
        except InputError as error:
            if "mirror" in str(error):
                raise
    if inliers.sum() == 1:
        raise InputError(
            "Only one image is known in both frames, which does not determine the scale. Three are needed."
        )
    found = pose_alignment(source[inliers], target[inliers])
    words = "The camera centres alone do not determine the rotation well: orientations were used too."
    return found.similarity, inliers, (words,) if found.by_orientations else ()


def _to_survey(scene: Scene, survey: Survey) -> Alignment:
    found = with_survey(scene, survey)
    if found.alignment is None:
        raise InputError("Positions or control points are needed to align with; the scene may hold some already.")
    fit, moved = found.alignment, scene.transformed(found.similarity)
    return Alignment(moved, found.similarity, found.names, fit.residuals, fit.inliers, None, found.notes)
