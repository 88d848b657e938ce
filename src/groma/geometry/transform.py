# SPDX-License-Identifier: BSD-3-Clause
r"""Rigid, similarity and projective maps of points, lines and planes, with their derivatives.

=============  ================================================  ==================================================
map            given as                                          points
=============  ================================================  ==================================================
rigid          pose (..., 7) = [qx qy qz qw tx ty tz], or        :math:`X_b = R X_a + t`
               a pair (R (..., 3, 3), t (..., 3))
similarity     (..., 8) = [qx qy qz qw tx ty tz s], s > 0        :math:`X_b = s R X_a + t`; :mod:`~groma.geometry.sim3`
projective     homography H (..., 4, 4)                          :math:`\tilde X_b \sim H \tilde X_a`, homogeneous
=============  ================================================  ==================================================

A point map fixes the others: lines move with a 6x6 matrix on (m; d), planes with the inverse transpose of the 4x4
matrix. These matrices *are* the derivatives with respect to the object, so ``*_line_matrix`` and ``*_plane_matrix`` are
public. Derivatives with respect to the pose are for the left twist :math:`\xi = (\rho, \omega)`,
:math:`T \leftarrow \mathrm{Exp}(\xi)\,T`, and take the object *after* the map. Leading axes broadcast.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.geometry import line3, quaternion, sim3
from groma.geometry.algebra import apply, matrices, vectors
from groma.geometry.so3 import hat

#: A pose (..., 7), or the pair (R, t).
Rigid: TypeAlias = FloatArray | tuple[FloatArray, FloatArray]


def rotation_and_translation(b_from_a: Rigid) -> tuple[FloatArray, FloatArray]:
    """R (..., 3, 3) and t (..., 3) of a pose (..., 7), the quaternion of any length; a pair (R, t) passes through."""
    if isinstance(b_from_a, tuple):
        return matrices(b_from_a[0], 3, 3, "rotation"), vectors(b_from_a[1], 3, "translation")
    pose = vectors(b_from_a, 7, "b_from_a")
    return quaternion.to_matrix(quaternion.normalize(pose[..., :4])), pose[..., 4:]


# --------------------------------------------------------------------------------------------------------------- Rigid
def rigid_points(b_from_a: Rigid, points_in_a: FloatArray) -> FloatArray:
    """Points (..., 3) in the frame b, R X + t. The derivative with respect to the point is R."""
    rotation, translation = rotation_and_translation(b_from_a)
    return apply(rotation, vectors(points_in_a, 3, "points_in_a")) + translation


def rigid_line_matrix(b_from_a: Rigid) -> FloatArray:
    r"""Matrix (..., 6, 6) that moves lines (m; d).

    .. math:: \begin{bmatrix} m_b \\ d_b \end{bmatrix} =
              \begin{bmatrix} R & [t]_\times R \\ 0 & R \end{bmatrix} \begin{bmatrix} m_a \\ d_a \end{bmatrix}

    It is the adjoint of the pose for twists (rho, omega).

    References
    ----------
    Plücker notes, eq. (65), (83).
    """
    rotation, translation = rotation_and_translation(b_from_a)
    return _line_matrix(np.ones(()), rotation, translation)


def rigid_lines(b_from_a: Rigid, lines_in_a: FloatArray) -> FloatArray:
    """Lines (..., 6) in the frame b: m' = R m + t x R d, d' = R d; Plücker notes, eq. (65)."""
    rotation, translation = rotation_and_translation(b_from_a)
    return apply(_line_matrix(np.ones(()), rotation, translation), vectors(lines_in_a, 6, "lines_in_a"))


def rigid_plane_matrix(b_from_a: Rigid) -> FloatArray:
    r"""Matrix (..., 4, 4) that moves planes, :math:`T^{-\top} = \begin{bmatrix} R & 0 \\ -t^\top R & 1 \end{bmatrix}`.

    References
    ----------
    Point-line-plane notes, section on planes, :math:`\pi_w = T^\top \pi_c`.
    """
    rotation, translation = rotation_and_translation(b_from_a)
    return _plane_matrix(np.ones(()), rotation, translation)


def rigid_planes(b_from_a: Rigid, planes_in_a: FloatArray) -> FloatArray:
    """Planes (..., 4) in the frame b: n' = R n, w' = w - t·R n. The length of n is kept."""
    rotation, translation = rotation_and_translation(b_from_a)
    return apply(_plane_matrix(np.ones(()), rotation, translation), vectors(planes_in_a, 4, "planes_in_a"))


def rigid_points_wrt_twist(points_in_b: FloatArray) -> FloatArray:
    r"""Derivative (..., 3, 6) of points in b by the left twist of b_from_a, :math:`[\,I,\; -[X_b]_\times\,]`.

    References
    ----------
    Point-line-plane notes, eq. (4), whose columns are printed in this order although declared as (omega, rho).
    """
    points_in_b = vectors(points_in_b, 3, "points_in_b")
    out = np.zeros((*points_in_b.shape, 6))
    out[..., :, :3] = np.eye(3)
    out[..., :, 3:] = -hat(points_in_b)
    return out


def rigid_lines_wrt_twist(lines_in_b: FloatArray) -> FloatArray:
    r"""Derivative (..., 6, 6) of lines in b by the left twist of b_from_a.

    .. math:: \begin{bmatrix} -[d_b]_\times & -[m_b]_\times \\ 0 & -[d_b]_\times \end{bmatrix}

    References
    ----------
    Plücker notes, eq. (85), and point-line-plane notes, eq. (10), both with columns (omega, rho).
    """
    lines_in_b = vectors(lines_in_b, 6, "lines_in_b")
    moment, direction = -hat(lines_in_b[..., :3]), -hat(lines_in_b[..., 3:])
    return np.concatenate(
        [np.concatenate([direction, moment], axis=-1), np.concatenate([np.zeros_like(direction), direction], axis=-1)],
        axis=-2,
    )


def rigid_planes_wrt_twist(planes_in_b: FloatArray) -> FloatArray:
    r"""Derivative (..., 4, 6) of planes in b by the left twist of b_from_a.

    .. math:: \begin{bmatrix} 0 & -[n_b]_\times \\ -n_b^\top & 0 \end{bmatrix}

    The point-line-plane notes differentiate the inverse map, from the camera to the world; this is the forward one.
    """
    planes_in_b = vectors(planes_in_b, 4, "planes_in_b")
    out = np.zeros((*planes_in_b.shape, 6))
    out[..., :3, 3:] = -hat(planes_in_b[..., :3])
    out[..., 3, :3] = -planes_in_b[..., :3]
    return out


# ---------------------------------------------------------------------------------------------------------- Similarity
def similarity_points(b_from_a: FloatArray, points_in_a: FloatArray) -> FloatArray:
    """Points (..., 3) in b, s R X + t. The derivative with respect to the point is s R."""
    scale, rotation, translation = sim3.to_parts(b_from_a)
    return scale[..., None] * apply(rotation, vectors(points_in_a, 3, "points_in_a")) + translation


def similarity_line_matrix(b_from_a: FloatArray) -> FloatArray:
    r"""Matrix (..., 6, 6) on (m; d), :math:`\begin{bmatrix} sR & [t]_\times R \\ 0 & R \end{bmatrix}`.

    The common factor is chosen to keep the length of d.
    """
    return _line_matrix(*sim3.to_parts(b_from_a))


def similarity_lines(b_from_a: FloatArray, lines_in_a: FloatArray) -> FloatArray:
    """Lines (..., 6) in b: m' = s R m + t x R d, d' = R d."""
    return apply(similarity_line_matrix(b_from_a), vectors(lines_in_a, 6, "lines_in_a"))


def similarity_plane_matrix(b_from_a: FloatArray) -> FloatArray:
    r"""Matrix (..., 4, 4) on planes, :math:`\begin{bmatrix} R & 0 \\ -t^\top R & s \end{bmatrix}`.

    The common factor is chosen to keep the length of n.
    """
    return _plane_matrix(*sim3.to_parts(b_from_a))


def similarity_planes(b_from_a: FloatArray, planes_in_a: FloatArray) -> FloatArray:
    """Planes (..., 4) in b: n' = R n, w' = s w - t·R n."""
    return apply(similarity_plane_matrix(b_from_a), vectors(planes_in_a, 4, "planes_in_a"))


def _line_matrix(scale: FloatArray, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    shear = hat(translation) @ rotation
    leading = np.broadcast_shapes(scale.shape, shear.shape[:-2])
    out = np.zeros((*leading, 6, 6))
    out[..., :3, :3] = scale[..., None, None] * rotation
    out[..., :3, 3:] = shear
    out[..., 3:, 3:] = rotation
    return out


def _plane_matrix(scale: FloatArray, rotation: FloatArray, translation: FloatArray) -> FloatArray:
    leading = np.broadcast_shapes(scale.shape, rotation.shape[:-2], translation.shape[:-1])
    out = np.zeros((*leading, 4, 4))
    out[..., :3, :3] = rotation
    out[..., 3, :3] = -np.einsum("...i,...ij->...j", translation, rotation)
    out[..., 3, 3] = scale
    return out


# ---------------------------------------------------------------------------------------------------------- Projective
def projective_points(b_from_a: FloatArray, points_in_a: FloatArray) -> FloatArray:
    """Homogeneous points (..., 4) in b, H X. The derivative with respect to the point is H."""
    return apply(matrices(b_from_a, 4, 4, "b_from_a"), vectors(points_in_a, 4, "points_in_a"))


def projective_primal_matrix(b_from_a: FloatArray, primal_in_a: FloatArray) -> FloatArray:
    """Primal Plücker matrices (..., 4, 4) in b, H L Hᵀ; Plücker notes, section 3.4.1. H may be singular."""
    homography = matrices(b_from_a, 4, 4, "b_from_a")
    return homography @ matrices(primal_in_a, 4, 4, "primal_in_a") @ np.swapaxes(homography, -1, -2)


def projective_dual_matrix(b_from_a: FloatArray, dual_in_a: FloatArray) -> FloatArray:
    r"""Dual Plücker matrices (..., 4, 4) in b, :math:`H^{-\top} L^* H^{-1}`.

    Equal to the dual matrix of the line moved by :func:`projective_lines`, divided by det H.

    References
    ----------
    Plücker notes, section 4.1.1, where the star on the right-hand side is missing.
    """
    inverse = _inverse(b_from_a)
    return np.swapaxes(inverse, -1, -2) @ matrices(dual_in_a, 4, 4, "dual_in_a") @ inverse


def projective_line_matrix(b_from_a: FloatArray) -> FloatArray:
    """Matrix (..., 6, 6) on (m; d) of a homography (..., 4, 4): its 2x2 minors, by linearity of H L Hᵀ in L."""
    homography = matrices(b_from_a, 4, 4, "b_from_a")[..., None, :, :]
    basis = line3.primal_matrix(np.eye(6))
    columns = line3.from_primal_matrix(homography @ basis @ np.swapaxes(homography, -1, -2))
    return np.swapaxes(columns, -1, -2)


def projective_lines(b_from_a: FloatArray, lines_in_a: FloatArray) -> FloatArray:
    """Lines (..., 6) in b under a homography (..., 4, 4)."""
    return apply(projective_line_matrix(b_from_a), vectors(lines_in_a, 6, "lines_in_a"))


def projective_plane_matrix(b_from_a: FloatArray) -> FloatArray:
    r"""Matrix (..., 4, 4) on planes, :math:`H^{-\top}`.

    Raises
    ------
    InputError
        If a homography is singular.
    """
    return np.swapaxes(_inverse(b_from_a), -1, -2)


def projective_planes(b_from_a: FloatArray, planes_in_a: FloatArray) -> FloatArray:
    """Planes (..., 4) in b under a homography (..., 4, 4)."""
    return apply(projective_plane_matrix(b_from_a), vectors(planes_in_a, 4, "planes_in_a"))


def _inverse(homography: FloatArray) -> FloatArray:
    homography = matrices(homography, 4, 4, "b_from_a")
    try:
        return np.asarray(np.linalg.inv(homography), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise InputError(
            "b_from_a must hold homographies of rank 4; got a singular one, under which planes have no image. Leave "
            "that item out."
        ) from error
