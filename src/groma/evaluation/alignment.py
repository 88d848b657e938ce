# SPDX-License-Identifier: BSD-3-Clause
"""Similarity and rigid alignment of points and of camera poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.errors import InputError, ShapeError
from groma.evaluation.gates import SCORES
from groma.geometry import quaternion, so3
from groma.geometry.algebra import finite_rows, numbers
from groma.scene import Similarity

#: Second singular value of the centred points, relative to the first, below which they count as collinear.
_COLLINEAR = 1e-8


def align_points(source: npt.ArrayLike, target: npt.ArrayLike, with_scale: bool = True) -> Similarity:
    r"""Return the similarity (or rigid motion) that takes source points closest to target points.

    .. math:: \min_{s, R, t} \sum_i \| y_i - (s R x_i + t) \|^2

    Parameters
    ----------
    source, target : (N, 3) float
        Corresponding points.
    with_scale : bool
        Estimate the scale too; otherwise it is one.

    Returns
    -------
    Similarity
        ``target_from_source``.

    Raises
    ------
    ShapeError
        If the shapes are not equal or not (N, 3).
    InputError
        If there are fewer than three points, or one of the sets is collinear: the rotation is then not determined.

    References
    ----------
    S. Umeyama, *Least-squares estimation of transformation parameters between two point patterns*, 1991, eqs. 40-42.
    """
    x, y = finite_rows("source", source, (3,)), finite_rows("target", target, (3,))
    if x.shape != y.shape:
        raise ShapeError(f"source and target must have the same shape; got {x.shape} and {y.shape}.")
    for name, points in (("source", x), ("target", y)):
        if len(points) < 3 or _rank(points) < 2:
            raise InputError(
                f"Alignment needs three points that are not on one line; the {len(points)} {name} points do not "
                "fix the rotation. Use align_poses, which looks at the orientations too."
            )
    x0, y0 = x - x.mean(0), y - y.mean(0)
    return _with_rotation(x, y, so3.nearest(y0.T @ x0), with_scale)


@dataclass(frozen=True, eq=False)
class PoseAlignment:
    """A similarity of two worlds, and the data of its estimate."""

    #: ``target_from_source``.
    similarity: Similarity
    #: Whether the orientations took part: the camera centres alone do not determine the rotation.
    by_orientations: bool


def align_poses(source: npt.ArrayLike, target: npt.ArrayLike, with_scale: bool = True) -> Similarity:
    """Return the similarity that takes the camera centres of source closest to those of target.

    Where the centres do not determine the rotation, the orientations take part: see :func:`pose_alignment`.

    Parameters
    ----------
    source, target : (N, 7) float
        Corresponding poses cam_from_world [qx qy qz qw tx ty tz].
    with_scale : bool
        Estimate the scale too; otherwise, and where all centres coincide, it is one.

    Returns
    -------
    Similarity
        ``target_from_source`` of the two worlds.

    Raises
    ------
    ShapeError
        If the shapes are not (N, 7) twice.
    InputError
        If there is no pose, or one that is not finite.
    """
    return pose_alignment(source, target, with_scale).similarity


def pose_alignment(source: npt.ArrayLike, target: npt.ArrayLike, with_scale: bool = True) -> PoseAlignment:
    r"""Return the alignment of two worlds by the poses of the same cameras, and whether orientations took part.

    The camera centres alone (:func:`align_points`) know the rotation to

    .. math:: \sigma_p / \sqrt{\lambda_{\min}(\Lambda)}, \qquad
        \Lambda = s^2 \sum_i (\lVert x_i \rVert^2 I - x_i x_i^\top),

    with the centred :math:`x_i` and the noise :math:`\sigma_p` that the alignment leaves on a coordinate. On a straight
    road, or of a camera that turns on the spot, that is little. Where it is worse than a degree, and worse than the
    scatter :math:`\sigma_r` of single orientations about their mean, both take part, weighted by their noise:

    .. math:: \min_{s, R, t} \sum_i \frac{\| y_i - (s R x_i + t) \|^2}{\sigma_p^2}
        + \frac{1}{N} \sum_i \frac{\| V_i - R \|_F^2}{2 \sigma_r^2}, \qquad V_i = R_{y,i}^\top R_{x,i}.

    All orientations together count as one: what a camera and its reference differ by is mostly common to them. So they
    decide about the directions in which the centres say nothing, and about little else.

    With fewer than three centres, or all on one line, the orientations alone give the rotation. Parameters and errors
    are those of :func:`align_poses`.
    """
    from_source, from_target = numbers(source, "source"), numbers(target, "target")
    if from_source.shape != from_target.shape or from_source.ndim != 2 or from_source.shape[1] != 7:
        raise ShapeError(f"Poses must have shape (N, 7), twice; got {from_source.shape} and {from_target.shape}.")
    if len(from_source) == 0:
        raise InputError("Alignment needs at least one pose; got none.")
    for name, poses in (("source", from_source), ("target", from_target)):
        if not np.isfinite(poses).all():
            row = int(np.argwhere(~np.isfinite(poses))[0, 0])
            raise InputError(f"Poses must be finite; row {row} of {name} is {poses[row].tolist()}. Leave it out.")
    x, y = camera_centers(from_source), camera_centers(from_target)
    votes = quaternion.to_matrix(from_target[:, :4]).transpose(0, 2, 1) @ quaternion.to_matrix(from_source[:, :4])
    mean = so3.nearest(votes.sum(0))
    if len(x) < 3 or min(_rank(x), _rank(y)) < 2:
        return PoseAlignment(_with_rotation(x, y, mean, with_scale), True)
    by_centers = align_points(x, y, with_scale)
    x0, y0 = x - x.mean(0), y - y.mean(0)
    noise = np.sqrt(np.sum((y - by_centers.points(x)) ** 2) / (3 * len(x) - (7 if with_scale else 6)))
    lever = by_centers.scale * np.sqrt(np.linalg.eigvalsh(np.sum(x0**2) * np.eye(3) - x0.T @ x0)[0])
    scatter = np.sqrt(np.sum((votes - mean) ** 2) / 2 / (3 * len(x) - 3))
    if noise <= lever * max(scatter, SCORES.known_rotation):
        return PoseAlignment(by_centers, False)
    # Orientations that agree to rounding are as good as those that agree to a part in a million.
    weight = 2 * len(x) * by_centers.scale * max(scatter, 1e-6) ** 2 / noise**2
    rotation = so3.nearest(weight * (y0.T @ x0) + votes.sum(0))
    return PoseAlignment(_with_rotation(x, y, rotation, with_scale), True)


def camera_centers(cam_from_world: npt.ArrayLike) -> FloatArray:
    r"""Return the camera centres :math:`-R^\top t` of poses (N, 7), (N, 3) in the world."""
    poses = np.asarray(cam_from_world, float)
    return -quaternion.rotate(quaternion.conjugate(poses[:, :4]), poses[:, 4:])


def _with_rotation(x: FloatArray, y: FloatArray, rotation: FloatArray, with_scale: bool) -> Similarity:
    """Return the best scale and translation for a given rotation."""
    x0, y0 = x - x.mean(0), y - y.mean(0)
    scale = 1.0
    if with_scale and min(_rank(x), _rank(y)) > 0:
        fitted = float(np.einsum("ij,ij->", y0, x0 @ rotation.T)) / float((x0**2).sum())
        scale = fitted if fitted > 0 else 1.0
    return Similarity(scale, rotation, y.mean(0) - scale * rotation @ x.mean(0))


def _rank(points: FloatArray) -> int:
    """Return 0, 1, 2 or 3: the dimension that points span, with rounding relative to their distance to the origin."""
    singular = np.linalg.svd(points - points.mean(0), compute_uv=False)
    noise = max(_COLLINEAR * singular[0], 1e-13 * np.abs(points).max() * np.sqrt(len(points)))
    return int((singular > noise).sum())
