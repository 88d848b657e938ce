# SPDX-License-Identifier: BSD-3-Clause
r"""Lines, planes and directions seen by a pinhole or affine camera.

A camera is a 3x4 matrix :math:`P = [\,N\,|\,p_4\,]`, for a pinhole camera :math:`K\,[\,R\,|\,t\,]`. An image line is a
3-vector l with :math:`l^\top [u, v, 1] = 0`. The image of the 3D line L = (m; d) is

.. math:: l = \mathcal{P} L, \qquad \mathcal{P} = [\;\mathrm{cof}(N) \;|\; [p_4]_\times N\;], \qquad
          l^\wedge = P L P^\top

with the cofactor matrix :math:`\mathrm{cof}(N) = \det(N) N^{-\top}`, which also exists where N is singular (affine
cameras). A line through the camera centre is seen as a point: its l is zero. Lens distortion bends lines; undistort
the pixels first, or work with bearings (K = I).
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.geometry import line3
from groma.geometry.algebra import apply, cofactor, cross, matrices, norm, not_negative, ratio, stack, vectors
from groma.geometry.so3 import hat, vee
from groma.geometry.transform import Rigid, rotation_and_translation


class LineVisibility(IntEnum):
    """Whether a line has an image line."""

    #: It has.
    SEEN = 0
    #: It passes through the camera centre: its image is a point.
    THROUGH_CENTER = 1
    #: Line and camera centre span the plane z = 0: its image is the line at infinity.
    IN_PRINCIPAL_PLANE = 2
    #: The line has no points (d = 0), or a number is not finite.
    INVALID = 3


def camera_matrix(intrinsic_matrix: FloatArray, cam_from_world: Rigid) -> FloatArray:
    """Camera matrices K [R | t], shape (..., 3, 4), from K (..., 3, 3) and a pose (..., 7) or a pair (R, t)."""
    rotation, translation = rotation_and_translation(cam_from_world)
    return matrices(intrinsic_matrix, 3, 3, "intrinsic_matrix") @ np.concatenate(
        [rotation, translation[..., None]], axis=-1
    )


def line_intrinsics(intrinsic_matrix: FloatArray) -> FloatArray:
    r"""Intrinsic matrix of lines (..., 3, 3), :math:`\mathcal{K} = \det(K) K^{-\top}`: l is :math:`\mathcal{K} m_c`.

    .. math:: \mathcal{K} = \begin{bmatrix} f_y & 0 & 0 \\ 0 & f_x & 0 \\ -f_y c_x & -f_x c_y & f_x f_y \end{bmatrix}

    without skew.

    References
    ----------
    Plücker notes, eq. (66), (67), where two entries are printed one row too high; (82) is right.
    """
    return cofactor(matrices(intrinsic_matrix, 3, 3, "intrinsic_matrix"))


def line_projection_matrix(camera: FloatArray) -> FloatArray:
    r"""Matrix (..., 3, 6) that projects (m; d), :math:`[\,\mathrm{cof}(N) \,|\, [p_4]_\times N\,]`.

    References
    ----------
    Plücker notes, eq. (55)-(57). Deviation: the cofactor matrix in place of :math:`\det(N) N^{-\top}`, so affine
    cameras are not excluded.
    """
    camera = matrices(camera, 3, 4, "camera")
    left = camera[..., :3]
    return np.concatenate([cofactor(left), hat(camera[..., 3]) @ left], axis=-1)


def line_projection_matrix_from_rows(camera: FloatArray) -> FloatArray:
    r"""The same matrix from the rows of the camera matrix, read as planes.

    Row i is the line in which the other two planes meet, in the order (d, m):
    :math:`[\,n_j \times n_k,\; w_j n_k - w_k n_j\,]`.

    References
    ----------
    Plücker notes, eq. (58)-(60). The wedge there must list d first. The first two planes hold the camera centre and an
    image axis; the third is the principal plane.
    """
    first, second, third = np.moveaxis(matrices(camera, 3, 4, "camera"), -2, 0)
    rows = [line3.from_planes(*pair) for pair in ((second, third), (third, first), (first, second))]
    return np.stack([stack(row[..., 3:], row[..., :3]) for row in rows], axis=-2)


def project_lines(camera: FloatArray, line: FloatArray) -> FloatArray:
    """Image lines (..., 3) of lines (..., 6), not normalised; zero for lines through the camera centre.

    References
    ----------
    Plücker notes, eq. (57), (63); for lines in the camera frame and P = K [I | 0] it is (66).
    """
    return apply(line_projection_matrix(camera), vectors(line, 6, "line"))


def project_primal_matrix(camera: FloatArray, primal: FloatArray) -> FloatArray:
    r"""Skew matrix of the image line (..., 3, 3), :math:`l^\wedge = P L P^\top`.

    References
    ----------
    Plücker notes, eq. (54): holds for the block form (29) of L; with L = A Bᵀ - B Aᵀ the result is -l^.
    """
    camera = matrices(camera, 3, 4, "camera")
    return camera @ matrices(primal, 4, 4, "primal") @ np.swapaxes(camera, -1, -2)


def visibility(line_in_cam: FloatArray, min_distance: float = 1e-9, min_sine: float = 1e-9) -> IntArray:
    """Find out which lines have an image line, and why others have none.

    Parameters
    ----------
    line_in_cam : (..., 6) float64
        Lines, camera frame, scene units.
    min_distance : float
        Distance from the camera centre up to which a line counts as passing through it, scene units.
    min_sine : float
        Sine of the angle between the plane of line and centre and the plane z = 0 up to which they count as one.

    Returns
    -------
    (...) int
        Members of :class:`LineVisibility`.

    Raises
    ------
    ShapeError, InputError
        If the last axis is not 6, or a tolerance is negative.
    """
    line = vectors(line_in_cam, 6, "line_in_cam")
    moment = line[..., :3]
    usable = line3.is_finite(line)
    through = line3.distance_to_origin(line) <= not_negative(min_distance, "min_distance")
    flat = np.hypot(moment[..., 0], moment[..., 1]) <= not_negative(min_sine, "min_sine") * norm(moment)
    return np.select(
        [~usable, through, flat],
        [LineVisibility.INVALID, LineVisibility.THROUGH_CENTER, LineVisibility.IN_PRINCIPAL_PLANE],
        LineVisibility.SEEN,
    )


def normalize_image_lines(image_line: FloatArray) -> FloatArray:
    """Image lines (..., 3) scaled so that a dot product with [u, v, 1] is a signed distance in pixels.

    Zero where there is no such line: l is zero (a line seen end on) or the line at infinity (l1 = l2 = 0).

    References
    ----------
    Plücker notes, eq. (68).
    """
    image_line = vectors(image_line, 3, "image_line")
    length = np.hypot(image_line[..., 0], image_line[..., 1])[..., None]
    return ratio(image_line, length, length > 0.0, 0.0)


def back_project_lines(camera: FloatArray, image_line: FloatArray) -> FloatArray:
    r"""Planes (..., 4) through the camera centre and image lines (..., 3), :math:`\pi = P^\top l`."""
    return np.einsum("...ij,...i->...j", matrices(camera, 3, 4, "camera"), vectors(image_line, 3, "image_line"))


# ------------------------------------------------------------------------------------------- Points, lines in the image
def join_image_points(first: FloatArray, second: FloatArray) -> FloatArray:
    """Image line (..., 3) through two homogeneous image points (..., 3): a x b. Zero for equal points."""
    return cross(vectors(first, 3, "first"), vectors(second, 3, "second"))


def meet_image_lines(first: FloatArray, second: FloatArray) -> FloatArray:
    """Homogeneous image point (..., 3) on two image lines (..., 3): l x m; third entry 0 for parallel lines."""
    return cross(vectors(first, 3, "first"), vectors(second, 3, "second"))


def skew_of_join(first: FloatArray, second: FloatArray) -> FloatArray:
    r"""Skew matrix (..., 3, 3) of a x b, :math:`(a \times b)^\wedge = b a^\top - a b^\top`.

    The same for points (the line through them) and lines (the point on them); read it with :func:`line_of_skew`.

    References
    ----------
    Plücker notes, eq. (61), (62), both printed with the opposite sign.
    """
    first, second = vectors(first, 3, "first"), vectors(second, 3, "second")
    return second[..., :, None] * first[..., None, :] - first[..., :, None] * second[..., None, :]


def line_of_skew(skew: FloatArray) -> FloatArray:
    """3-vector (..., 3) of skew matrices (..., 3, 3), for example of the image line in P L Pᵀ."""
    return vee(matrices(skew, 3, 3, "skew"))


# ------------------------------------------------------------------------------------------- Vanishing points, horizons
def vanishing_points(camera: FloatArray, direction: FloatArray) -> FloatArray:
    """Homogeneous image points (..., 3) where lines of directions (..., 3) vanish, N d.

    The third entry is zero for directions parallel to the image plane; it is positive for directions pointing away
    from the camera (det N > 0).
    """
    return apply(matrices(camera, 3, 4, "camera")[..., :3], vectors(direction, 3, "direction"))


def horizons(camera: FloatArray, normal: FloatArray) -> FloatArray:
    r"""Image lines (..., 3) where planes with normals (..., 3) vanish, :math:`\mathrm{cof}(N)\, n`.

    They hold the vanishing points of all directions in the plane; for a plane [n, w] pass its n. For a plane parallel
    to the image plane it is the line at infinity.
    """
    return apply(cofactor(matrices(camera, 3, 4, "camera")[..., :3]), vectors(normal, 3, "normal"))
