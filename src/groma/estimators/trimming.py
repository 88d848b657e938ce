# SPDX-License-Identifier: BSD-3-Clause
r"""From a 3D line and an image segment to end points on the line.

An image segment fixes where on the line its end points lie, up to noise, in two ways:

closest to the ray
    the point of the line closest to the viewing ray of the end point; needs a ray only, so any camera will do:
    :math:`k = f \times (d \times f)`, :math:`X = (k \times m)/(k^\top d)`, :math:`k^\top d = \|d \times f\|^2`, in a
    frame whose origin is the camera.
in the image
    the end point is moved to its foot on the projected line, whose ray then meets the line exactly:
    :math:`l_\perp = x \times [l_1, l_2, 0]^\top`, :math:`\pi = P^\top l_\perp`, :math:`X = L\,\pi`. Consistent with a
    residual that is a distance in pixels.

Both fail where the ray runs along the line. No result is NaN without a status with the reason.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry import incidence, line3, projection
from groma.geometry.algebra import cofactor, dot, matrices, norm, not_negative, ratio, stack, unit, vectors
from groma.geometry.incidence import MIN_SINE


class TrimStatus(IntEnum):
    """The outcome for an end point."""

    #: A point in front of the camera.
    OK = 0
    #: The point is there, but not in front of the camera.
    BEHIND_CAMERA = 1
    #: The line is nearly parallel to the viewing ray: the point is undetermined, NaN.
    PARALLEL_TO_RAY = 2
    #: The line has no image line (it passes through the camera centre, or l1 = l2 = 0), or is no finite line: NaN.
    NO_IMAGE = 3


@dataclass(frozen=True)
class TrimmedPoints:
    """End points on lines; arrays with the leading axes of the inputs."""

    #: (..., 3) points on the lines, scene units; NaN where the status is PARALLEL_TO_RAY or NO_IMAGE.
    point: FloatArray
    #: (...) position along the unit viewing ray (closest to the ray) or depth z (in the image), scene units.
    depth: FloatArray
    #: (...) sine of the angle between line and viewing ray, 0 to 1.
    sine: FloatArray
    #: (...) :class:`TrimStatus`.
    status: IntArray


def trim_to_ray(
    line: FloatArray, ray_origin: FloatArray, ray_direction: FloatArray, min_sine: float = MIN_SINE
) -> TrimmedPoints:
    r"""Point of lines closest to viewing rays.

    Parameters
    ----------
    line : (..., 6) float64
        Lines, any frame.
    ray_origin : (..., 3) float64
        Camera centres in that frame; zero in the camera frame.
    ray_direction : (..., 3) float64
        Directions from the camera through the measured end point, in that frame, of any length.
    min_sine : float
        Smallest sine of the angle between line and ray.

    Returns
    -------
    TrimmedPoints
        The depth is measured along the unit ray to the ray's own closest point; OK requires it to be positive.

    References
    ----------
    Derived from the closest points of two lines: :func:`groma.geometry.incidence.closest_points` gives the same point.
    """
    line = vectors(line, 6, "line")
    origin, ray = vectors(ray_origin, 3, "ray_origin"), unit(vectors(ray_direction, 3, "ray_direction"))
    not_negative(min_sine, "min_sine")
    finite = line3.is_finite(line)
    along = np.where(finite[..., None], line3.normalize(line), 0.0)[..., 3:]
    moment = np.where(finite[..., None], line3.normalize(line), 0.0)[..., :3] - np.cross(origin, along)
    across = np.cross(ray, np.cross(along, ray))
    squared = dot(across, along)
    sine = np.sqrt(np.clip(squared, 0.0, 1.0))
    usable = finite & (norm(ray) > 0.0)
    determined = usable & (sine >= min_sine) & (squared > 0.0)
    local = ratio(np.cross(across, moment), squared[..., None], determined[..., None])
    depth = dot(local, ray)
    status = _status(usable, determined, depth)
    return TrimmedPoints(point=origin + local, depth=depth, sine=sine, status=status)


def trim_in_image(
    camera: FloatArray, line: FloatArray, pixel: FloatArray, min_sine: float = MIN_SINE, min_distance: float = 1e-9
) -> TrimmedPoints:
    r"""Point of lines whose image is the foot of a pixel on the projected line.

    Parameters
    ----------
    camera : (..., 3, 4) float64
        Camera matrices of pinhole cameras.
    line : (..., 6) float64
        Lines, world frame.
    pixel : (..., 2) float64
        Measured end points, pixels, undistorted.
    min_sine : float
        Smallest sine of the angle between the line and the ray of the foot.
    min_distance : float
        Distance from the camera centre up to which a line has no image, scene units.

    Returns
    -------
    TrimmedPoints
        The depth is z in the camera frame; OK requires it to be positive.

    References
    ----------
    Plücker notes, eq. (48) for the meet X = L pi and (63) for the projection; the perpendicular is derived.
    """
    camera, line = matrices(camera, 3, 4, "camera"), vectors(line, 6, "line")
    pixel = stack(vectors(pixel, 2, "pixel"), np.ones(1))
    not_negative(min_sine, "min_sine")
    finite = line3.is_finite(line)
    line = np.where(finite[..., None], line3.normalize(line), 0.0)
    left = camera[..., :3]
    adjugate = np.swapaxes(cofactor(left), -1, -2)
    determinant = dot(left[..., 0, :], adjugate[..., :, 0])
    center = ratio(
        -np.einsum("...ij,...j->...i", adjugate, camera[..., 3]),
        determinant[..., None],
        (determinant != 0.0)[..., None],
    )
    image_line = projection.normalize_image_lines(projection.project_lines(camera, line))
    off_center = norm(np.cross(center, line[..., 3:]) - line[..., :3])
    usable = finite & (norm(image_line) > 0.0) & (off_center > not_negative(min_distance, "min_distance"))
    normal = stack(image_line[..., :2], np.zeros(1))
    foot = pixel - dot(image_line, pixel)[..., None] * normal
    ray = unit(np.einsum("...ij,...j->...i", adjugate, foot))
    sine = norm(np.cross(line[..., 3:], ray))
    met = incidence.meet_line_plane(line, projection.back_project_lines(camera, np.cross(foot, normal)))
    determined = usable & (sine >= min_sine) & (met[..., 3] != 0.0)
    point = ratio(met[..., :3], met[..., 3:], determined[..., None])
    third = camera[..., 2, :]
    size = norm(third[..., :3]) * np.sign(determinant)
    depth = ratio(dot(third[..., :3], point) + third[..., 3], size, determined & (size != 0.0))
    status = _status(usable, determined, depth)
    return TrimmedPoints(point=point, depth=depth, sine=np.broadcast_to(sine, status.shape), status=status)


def trim_segments(
    camera: FloatArray, line: FloatArray, segment: FloatArray, min_sine: float = MIN_SINE
) -> TrimmedPoints:
    """Both end points of image segments (..., 4) on lines (..., 6), in the image.

    Returns
    -------
    TrimmedPoints
        ``point`` has shape (..., 2, 3), the other arrays (..., 2): first and second end point.
    """
    camera = matrices(camera, 3, 4, "camera")
    line = vectors(line, 6, "line")
    segment = vectors(segment, 4, "segment")
    ends = segment.reshape(*segment.shape[:-1], 2, 2)
    return trim_in_image(camera[..., None, :, :], line[..., None, :], ends, min_sine)


def _status(usable: BoolArray, determined: BoolArray, depth: FloatArray) -> IntArray:
    return np.select(
        [~usable, ~determined, ~(depth > 0.0)],
        [TrimStatus.NO_IMAGE, TrimStatus.PARALLEL_TO_RAY, TrimStatus.BEHIND_CAMERA],
        TrimStatus.OK,
    )
