# SPDX-License-Identifier: BSD-3-Clause
"""How far camera poses are from reference poses."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from groma._image_names import rows_by_name, tell_partly
from groma._typing import FloatArray
from groma.errors import InputError
from groma.evaluation.alignment import align_poses, camera_centers
from groma.evaluation.gates import SCORES
from groma.gates import NORMAL
from groma.geometry import quaternion
from groma.geometry.algebra import numbers
from groma.scene import Scene, Similarity
from groma.scene.checks import check_scene_given

#: Thresholds of the area under the curve of pairwise errors, degrees.
THRESHOLDS_DEG = SCORES.pose_angles_deg


@dataclass(frozen=True)
class PoseScores:
    """Errors of poses after alignment to the reference."""

    #: Root mean square distance of the camera centres, units of the reference.
    center_rmse: float
    #: Largest distance of a camera centre, units of the reference.
    center_max: float
    #: Mean angle between the orientations, degrees.
    rotation_deg_mean: float
    #: Largest angle between the orientations, degrees.
    rotation_deg_max: float
    #: Area under the curve of pairwise errors up to each threshold (degrees), from 0 to 1. Needs no alignment.
    auc: dict[float, float]
    #: Number of images found in both scenes.
    num_images: int
    #: Number of images of the reference that the estimate lacks; their pairs count as wrong in ``auc``.
    num_missing: int
    #: Sentences about what makes the scores unreliable.
    warnings: tuple[str, ...] = ()
    #: ``reference_from_estimate``: the alignment that was applied.
    alignment: Similarity = field(default_factory=Similarity, repr=False, compare=False)

    def to_dict(self) -> dict[str, object]:
        """Return the scores for a machine-readable report."""
        return as_numbers(self, "alignment")


def as_numbers(scores: Any, *left_out: str) -> dict[str, object]:
    """Return the fields of scores for a machine-readable report, without some; thresholds are written out."""
    result = {item.name: getattr(scores, item.name) for item in fields(scores) if item.name not in left_out}
    for name, value in result.items():
        if isinstance(value, dict):
            result[name] = {f"{threshold:g}": number for threshold, number in value.items()}
        elif isinstance(value, tuple):
            result[name] = list(value)
    return result


def evaluate_poses(estimate: Scene, reference: Scene) -> PoseScores:
    """Compare the camera poses of two scenes, aligned by a similarity.

    Images are matched by name, without folder or suffix where that is unique.

    Parameters
    ----------
    estimate, reference : Scene
        The scene to judge, and the one taken for true.

    Raises
    ------
    InputError
        If a scene has no image, no image is in both, or a name occurs twice in one scene.
    """
    check_scene_given(estimate, "estimate")
    check_scene_given(reference, "reference")
    for name, scene in (("estimate", estimate), ("reference", reference)):
        if len(set(scene.images.names)) != scene.num_images:
            raise InputError(f"Image names of the {name} are not unique; images are matched by name. Rename them.")
        if not scene.num_images:
            raise InputError(f"The {name} holds no images, so there are no poses to compare. Pass a scene with images.")
    wanted, known = reference.images.names, estimate.images.names
    found = rows_by_name(wanted, known)
    common = np.flatnonzero(found >= 0)
    rows = found[common]
    if not len(common) or len(np.unique(rows)) < len(common):
        which = "No image is in both scenes" if not len(common) else "More than one image of the reference fits another"
        raise InputError(
            f"{which}; names are for example {known[0]!r} and {wanted[0]!r}. "
            "Images are matched by name: rename those of one scene."
        )
    estimated, true = estimate.cam_from_world[rows], reference.cam_from_world[common]
    scores = score_poses(estimated, true, num_missing=reference.num_images - len(common))
    scores = replace(scores, warnings=(*tell_partly(found, wanted, known, "reference"), *scores.warnings))
    least = min(scene.num_images for scene in (estimate, reference))
    if len(common) >= NORMAL.majority * least:
        return scores
    few = (
        f"Only {len(common):,} of {estimate.num_images:,} and {reference.num_images:,} images have a name that is in "
        "both scenes: the scores are of these alone. Are these the same photographs, with the same names?"
    )
    return replace(scores, warnings=(few, *scores.warnings))


def score_poses(
    estimated: npt.ArrayLike, true: npt.ArrayLike, with_scale: bool = True, num_missing: int = 0
) -> PoseScores:
    """Compare corresponding poses after alignment; see :func:`evaluate_poses`.

    Parameters
    ----------
    estimated, true : (N, 7) float64
        Poses cam_from_world, row by row of the same image.
    with_scale : bool
        Whether the alignment may scale.
    num_missing : int
        Images of the reference without an estimate; their pairs count as wrong in the area under the recall curve.

    Raises
    ------
    ShapeError
        If the shapes are not (N, 7) twice.
    InputError
        If there is no pose.
    """
    estimate, reference = numbers(estimated, "estimated"), numbers(true, "true")
    alignment = align_poses(estimate, reference, with_scale)
    moved = alignment.poses(estimate)
    distance = np.linalg.norm(camera_centers(moved) - camera_centers(reference), axis=1)
    angle = np.rad2deg(rotation_angle(moved[:, :4], reference[:, :4]))
    doubt = unrelated(distance, camera_centers(reference), angle)
    return PoseScores(
        center_rmse=float(np.sqrt(np.mean(distance**2))),
        center_max=float(distance.max()),
        rotation_deg_mean=float(angle.mean()),
        rotation_deg_max=float(angle.max()),
        auc=pairwise_auc(estimate, reference, num_missing),
        num_images=len(estimate),
        num_missing=num_missing,
        warnings=(doubt,) if doubt else (),
        alignment=alignment,
    )


def unrelated(distance: FloatArray, centers: FloatArray, angle_deg: FloatArray) -> str | None:
    """Return a sentence where poses agree no better after alignment than those of different scenes would.

    A similarity takes any two paths near each other, but not the orientations along them.

    Parameters
    ----------
    distance : (N,) float
        Of the aligned camera centres from the reference.
    centers : (N, 3) float
        Camera centres of the reference.
    angle_deg : (N,) float
        Between the orientations.
    """
    if len(distance) < 3 or float(angle_deg.mean()) <= SCORES.unrelated_deg:
        return None
    spread = float(np.sum((centers - centers.mean(axis=0)) ** 2))
    left = 100.0 * (float(np.sum(distance**2)) / spread if spread > 0.0 else 1.0)
    return (
        f"The alignment leaves {angle_deg.mean():.0f} deg between the orientations on average, and {left:.2g} % of the "
        "spread of the centres: the two seem unrelated (another scene, other frames), or their cameras have other axes."
    )


def rotation_angle(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the angle between rotations given as quaternions (..., 4), radians; accurate near zero and near pi."""
    relative = quaternion.multiply(first, quaternion.conjugate(second))
    return 2 * np.arctan2(np.linalg.norm(relative[..., :3], axis=-1), np.abs(relative[..., 3]))


def pairwise_auc(
    estimated: FloatArray, true: FloatArray, num_missing: int = 0, thresholds_deg: tuple[float, ...] = THRESHOLDS_DEG
) -> dict[float, float]:
    r"""Return the area under the recall curve of relative poses, per threshold.

    The error of a pair of images is the larger of two angles: of the relative rotations, and of the directions of the
    baselines. Up to the threshold :math:`\tau` the area is

    .. math:: \mathrm{AUC}_\tau = \frac{1}{n} \sum_i \max(0,\ 1 - e_i / \tau)

    over all pairs of the reference; pairs with a missing image have an infinite error. Where the reference's baseline
    is zero only the rotation counts. No alignment takes part. Poses are cam_from_world, (N, 7); thresholds are in
    degrees. NaN where there is no pair.
    """
    count = len(true) + num_missing
    pairs = count * (count - 1) // 2
    if pairs == 0:
        return dict.fromkeys(thresholds_deg, float("nan"))
    sums = dict.fromkeys(thresholds_deg, 0.0)
    centers = [camera_centers(poses) for poses in (estimated, true)]
    size = np.abs(centers[1] - centers[1].mean(0)).max() if len(true) else 0.0
    for row in range(len(true) - 1):
        rest = slice(row + 1, None)
        turns, rays = [], []
        for poses, center in zip((estimated, true), centers, strict=True):
            turns.append(quaternion.multiply(poses[rest, :4], quaternion.conjugate(poses[row : row + 1, :4])))
            away = center[rest] - center[row]
            rays.append(quaternion.rotate(np.broadcast_to(poses[row, :4], (len(away), 4)), away))
        error = rotation_angle(*turns)
        cross = np.linalg.norm(np.cross(*rays), axis=1)
        ray_angle = np.arctan2(cross, np.einsum("ij,ij->i", *rays))
        ray_angle[np.linalg.norm(rays[0], axis=1) == 0] = np.pi
        ray_angle[np.linalg.norm(rays[1], axis=1) <= 1e-12 * size] = 0.0
        degrees = np.rad2deg(np.maximum(error, ray_angle))
        for threshold in thresholds_deg:
            sums[threshold] += float(np.maximum(0, 1 - degrees / threshold).sum())
    return {threshold: total / pairs for threshold, total in sums.items()}
