# SPDX-License-Identifier: BSD-3-Clause
r"""Vanishing points of an image's segments.

A segment's end points become bearings :math:`f_1, f_2`, under any camera model, and the segment the plane with normal
:math:`n = \mathrm{unit}(f_1 \times f_2)`. Its 3D line runs in this plane. A vanishing point is therefore a direction
perpendicular to many normals: :mod:`groma.estimators.directions` finds several of them, with covariance, weighted by
what segments of their length and noise can tell. There is no difference between vanishing points inside the image,
outside and at infinity.

Noise: with :math:`a_k = n^\top \delta f_k` the displacement of an end point out of the plane, in radians,

.. math:: \delta n = -a_1\, \frac{f_2 \times n}{\sin\theta} - a_2\, \frac{n \times f_1}{\sin\theta},
          \qquad \sin\theta = \lVert f_1 \times f_2\rVert .
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.cameras import CameraModel
from groma.errors import ShapeError
from groma.estimators.directions import directions_from_normals
from groma.geometry.algebra import dot, norm, ratio, vectors

#: Segments whose ends are closer than this have no normal, radians.
_MIN_ANGLE = 1e-6


@dataclass(frozen=True)
class VanishingPoints:
    """Vanishing points of one image."""

    #: (V, 3) unit directions in the camera frame, towards the front (z >= 0), the strongest first.
    directions: FloatArray
    #: (V, 3, 3) covariances, square radians, rank 2.
    covariance: FloatArray
    #: (V,) base-10 logarithm of the expected number of false alarms.
    log10_false_alarms: FloatArray
    #: (N,) the vanishing point of each segment, -1 for none.
    label: IntArray
    #: (M, 2) pairs of vanishing points whose directions are orthogonal within their uncertainty.
    orthogonal: IntArray
    #: (N, 3) unit normals of the segments' planes, camera frame; zero for segments without one.
    normals: FloatArray
    #: (N, 3, 2) square roots of the normals' covariances, radians.
    factors: FloatArray

    def __len__(self) -> int:
        return len(self.directions)

    def pixels(self, model: CameraModel, params: FloatArray) -> FloatArray:
        """Return the vanishing points (V, 2) in pixels; NaN where a direction has no image."""
        return model.project(params, self.directions)


def segment_normals(
    ends: FloatArray, sigma: float | FloatArray, model: CameraModel, params: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Unit normals of the planes through camera centre and segments, with the square roots of their covariances.

    Parameters
    ----------
    ends : (N, 4) float64
        Segments u1 v1 u2 v2, pixels.
    sigma : float or (N,) float64
        Standard deviation of the end points across the segment, pixels.
    model : CameraModel
        Camera model; distortion is allowed.
    params : (k,) float64
        Its parameters.

    Returns
    -------
    normals : (N, 3) float64
        Camera frame; zero for segments without length or outside the model's range.
    factors : (N, 3, 2) float64
        F with covariance F Fᵀ, radians; zero where the normal is.

    Raises
    ------
    ShapeError
        If an array has another shape.
    """
    ends = vectors(ends, 4, "ends")
    spread = np.broadcast_to(np.asarray(sigma, dtype=np.float64), (len(ends),)) if np.ndim(sigma) == 0 else sigma
    spread = np.asarray(spread, dtype=np.float64)
    if ends.ndim != 2 or spread.shape != (len(ends),):
        raise ShapeError(f"ends and sigma must have shapes (N, 4) and (N,); got {ends.shape} and {spread.shape}.")
    first, first_by_pixel = model.bearing_jacobian(params, np.ascontiguousarray(ends[:, :2]))
    second, second_by_pixel = model.bearing_jacobian(params, np.ascontiguousarray(ends[:, 2:]))
    crossed = np.cross(first, second)
    sine = norm(crossed)
    usable = (sine > _MIN_ANGLE) & np.isfinite(first_by_pixel).all((1, 2)) & np.isfinite(second_by_pixel).all((1, 2))
    usable &= np.isfinite(spread) & (spread > 0.0)
    normals = ratio(crossed, sine[:, None], usable[:, None], 0.0)
    columns = []
    for across, by_pixel in ((np.cross(second, normals), first_by_pixel), (np.cross(normals, first), second_by_pixel)):
        slip = spread * norm(np.einsum("ni,nij->nj", normals, by_pixel))
        columns.append(ratio(across * slip[:, None], sine[:, None], usable[:, None], 0.0))
    return normals, np.stack(columns, axis=-1)


def find_vanishing_points(
    ends: FloatArray, sigma: float | FloatArray, model: CameraModel, params: FloatArray
) -> VanishingPoints:
    """Find the vanishing points of an image.

    Parameters
    ----------
    ends, sigma, model, params
        As for :func:`segment_normals`.

    Returns
    -------
    VanishingPoints
        The strongest first; empty where segments agree no more than by chance.

    Raises
    ------
    ShapeError
        If an array has another shape.
    """
    normals, factors = segment_normals(ends, sigma, model, params)
    good = np.flatnonzero(dot(normals, normals) > 0.0)
    found = directions_from_normals(normals[good], factors[good])
    label = np.full(len(normals), -1)
    label[good] = found.label
    front = np.where(found.vectors[:, 2:] < 0.0, -1.0, 1.0)
    return VanishingPoints(
        found.vectors * front, found.covariance, found.log10_false_alarms, label, found.orthogonal, normals, factors
    )
