# SPDX-License-Identifier: BSD-3-Clause
r"""What an image of a map sees of it, as the other images have it: the map without what this image measured.

A landmark :math:`X` with the covariance :math:`\Sigma` was estimated from several images with held poses. Of one of
them, with the residual :math:`r`, its derivative :math:`J` and the weight :math:`W`, the part is taken out again,

.. math:: \Sigma'^{-1} = \Sigma^{-1} - J^\top W J, \qquad X' = X + \Sigma'\, J^\top W r ,

which is what the others alone would have given, to first order. Lines move in their four degrees of freedom.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.matches import Matches
from groma.localization.pose.pose_problem import problem_of
from groma.localization.pose.records import LANDMARK_LOSS, motions_of_lines

#: A landmark whose information falls below this share in some direction hung on the image that was left out.
_LEFT = 1e-2
#: Eigenvalues are known to about this share of the largest (derived from the precision of doubles).
_ROUNDING = 4.0 * np.finfo(np.float64).eps


def without_image(camera: QueryCamera, matches: Matches, pose: FloatArray) -> Matches:
    """Return the matches of an image of a map with the landmarks that the other images give.

    Parameters
    ----------
    camera, matches, pose
        The image: its calibration, what it sees of landmarks that it had a part in, and its pose in the map. Standard
        deviations are those that the landmarks were estimated with.

    Returns
    -------
    Matches
        Without those of landmarks that the other images do not determine.
    """
    one = problem_of(camera, matches, pose)
    points3d, point_covariance = matches.points3d.copy(), matches.point_covariance.copy()
    segments3d, line_covariance = matches.segments3d.copy(), matches.line_covariance.copy()
    good, good_lines = np.zeros(matches.num_points, bool), np.zeros(matches.num_lines, bool)
    for part in one.parts:
        rows, landmarks = part.row, part.landmarks[part.row]
        white = one.whitened(part, "landmark")
        if part.kind == "points":
            step, covariance, kept = _downdated(white, point_covariance[rows], np.eye(3)[None])
            points3d[rows], point_covariance[rows], good[rows] = points3d[rows] + step, covariance, kept
        else:
            step, covariance, kept = _downdated(white, line_covariance[rows], motions_of_lines(landmarks))
            segments3d[rows] = _moved(landmarks + step, segments3d[rows])
            line_covariance[rows], good_lines[rows] = covariance, kept
    moved = replace(
        matches, points3d=points3d, point_covariance=point_covariance, segments3d=segments3d,
        line_covariance=line_covariance,
    )  # fmt: skip
    return moved.take(good, good_lines)


def _downdated(white: FloatArray, covariance: FloatArray, free: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Steps (n, k), covariances (n, k, k) and which are still determined, without one observation each.

    Steps and covariances of the others are zero.
    ``white`` are whitened records (n, 2, k + 1), ``free`` bases (n, k, m) of what the landmarks can do.
    """
    J, r = white[..., :-1] @ free, white[..., -1]
    weight = LANDMARK_LOSS.evaluate((r**2).sum(axis=1))[1]
    values, vectors = np.linalg.eigh(np.swapaxes(free, 1, 2) @ covariance @ free)
    known = values[:, 0] > _ROUNDING * values[:, -1]  # beside what is hardly determined, the rest is rounding
    root = vectors * np.sqrt(np.where(known[:, None], values, 1.0))[:, None, :]  # inside it, information is one
    inside = J @ root
    left, axes = np.linalg.eigh(np.eye(inside.shape[2]) - np.einsum("n,nki,nkj->nij", weight, inside, inside))
    good = known & (left[:, 0] > _LEFT)
    root = good[:, None, None] * (root @ axes / np.sqrt(np.where(good[:, None], left, 1.0))[:, None, :])
    after = root @ np.swapaxes(root, 1, 2)
    step = np.einsum("nij,nkj,n,nk->ni", after, J, weight, r)
    wide = np.broadcast_to(free, (len(J), *free.shape[1:]))
    return np.einsum("nij,nj->ni", wide, step), wide @ after @ np.swapaxes(wide, 1, 2), good


def _moved(plucker: FloatArray, places: FloatArray) -> FloatArray:
    """Places (n, 2, 3) on lines (n, 6) (moment, direction), the nearest to places where they were."""
    length = np.linalg.norm(plucker[:, 3:], axis=1, keepdims=True)
    d = plucker[:, 3:] / length
    foot = np.cross(d, plucker[:, :3] / length)
    along = np.einsum("nki,ni->nk", places - foot[:, None], d)
    return foot[:, None] + along[..., None] * d[:, None]
