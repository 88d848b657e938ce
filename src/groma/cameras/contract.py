# SPDX-License-Identifier: BSD-3-Clause
r"""What a camera model is.

A camera model maps a point in the camera frame (x right, y down, z forward) to a pixel, in COLMAP's pixel convention
(the centre of the first pixel is (0.5, 0.5)), and a pixel back to a unit bearing. It depends on ``k`` parameters.

Compiled loops call the kernels through :mod:`groma.cameras.dispatch`, which says what kernels promise and whose names
are repeated here.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._numba import loop
from groma._typing import FloatArray
from groma.cameras.dispatch import (
    has_pinhole_kernels,
    has_wrap_kernel,
    pinhole_parameters,
    pinhole_parameters_jacobian,
    project,
    project_jacobian,
    unproject,
    wrap,
)
from groma.errors import InputError, ShapeError
from groma.geometry.algebra import as_rows

# --------------------------------------------------------------------------------------------------------- Kernels


@loop
def _project_all(model_tag, params, points, pixels):
    stride = 1 if params.shape[0] > 1 else 0
    for i in range(points.shape[0]):
        if not project(model_tag, params[i * stride], points[i], pixels[i]):
            pixels[i] = np.nan


@loop
def _project_jacobian_all(model_tag, params, points, pixels, J_points, J_params):
    stride = 1 if params.shape[0] > 1 else 0
    for i in range(points.shape[0]):
        if not project_jacobian(model_tag, params[i * stride], points[i], pixels[i], J_points[i], J_params[i]):
            pixels[i] = np.nan
            J_points[i] = np.nan
            J_params[i] = np.nan


@loop
def _unproject_all(model_tag, params, pixels, bearings):
    stride = 1 if params.shape[0] > 1 else 0
    for i in range(pixels.shape[0]):
        if not unproject(model_tag, params[i * stride], pixels[i], bearings[i]):
            bearings[i] = np.nan


@loop
def _wrap_all(model_tag, params, differences):
    stride = 1 if params.shape[0] > 1 else 0
    for i in range(differences.shape[0]):
        wrap(model_tag, params[i * stride], differences[i])


@loop
def _pinhole_parameters_all(model_tag, params, K):
    for i in range(params.shape[0]):
        pinhole_parameters(model_tag, params[i], K[i])


# ---------------------------------------------------------------------------------------------------------- Public


@dataclass(frozen=True)
class CameraModel:
    """A camera model: its name, its parameters, and batched projection.

    Batched methods take ``params`` as (k,), one camera for all rows, or (N, k), one row each.
    """

    #: Name, as options and files spell it.
    name: str
    #: Names of the k parameters, in order.
    parameter_names: tuple[str, ...]
    #: Which parameters are focal lengths in pixels: one, or two (x, y); none in a panorama.
    focal_indices: tuple[int, ...]
    #: Which parameters are the principal point in pixels: two (x, y), or none where it is fixed at (0, 0).
    principal_point_indices: tuple[int, ...]
    #: Which parameters are distortion coefficients. Parameters of no kind, such as the size of a panorama, are known.
    extra_indices: tuple[int, ...]
    #: COLMAP's name of the same model, or None.
    colmap_name: str | None = None
    #: Whether points at and behind the image plane may have an image of their own (fisheyes, panoramas), so that z > 0
    #: is no test: what the model projects is seen.
    sees_behind: bool = False
    #: Given by :func:`register_camera`, which sets it; it selects the kernels when loops are compiled.
    number: int = -1

    @property
    def num_parameters(self) -> int:
        """Number k of parameters."""
        return len(self.parameter_names)

    @property
    def tag(self) -> tuple[None, ...]:
        """What compiled loops take to select this model, see :mod:`groma.cameras.dispatch`."""
        if self.number < 0:
            raise InputError(
                f"The camera model {self.name!r} has no kernels yet. Use the model that "
                "groma.cameras.register_camera returns."
            )
        return (None,) * (self.number + 1)

    @property
    def known_indices(self) -> tuple[int, ...]:
        """Which parameters are known and never estimated: those of no kind, the width and height of a panorama."""
        estimated = {*self.focal_indices, *self.principal_point_indices, *self.extra_indices}
        return tuple(j for j in range(self.num_parameters) if j not in estimated)

    @property
    def is_planar(self) -> bool:
        """Whether the view can be shown in a plane, at least around its axis: all models but panoramas."""
        return bool(self.focal_indices)

    @property
    def has_pinhole_parameters(self) -> bool:
        """Whether the model is free of distortion by its form, so that straight lines have straight images."""
        return has_pinhole_kernels(self.number + 1)

    def project(self, params: FloatArray, points_in_cam: FloatArray) -> FloatArray:
        """Project points to pixels.

        Parameters
        ----------
        params : (k,) or (N, k) float64
            Camera parameters.
        points_in_cam : (N, 3) float64
            Points in the camera frame, scene units.

        Returns
        -------
        (N, 2) float64
            Pixels; rows of NaN where the model has no value (perspective: z = 0; fisheye: straight behind).

        Raises
        ------
        ShapeError
            If an array has another shape.

        Notes
        -----
        Perspective models also give a pixel for z < 0, the one of the opposite point.
        """
        points = as_rows(points_in_cam, (3,), "points_in_cam")
        pixels = np.empty((len(points), 2))
        _project_all(self.tag, self.check_parameters(params, len(points)), points, pixels)
        return pixels

    def project_jacobian(
        self, params: FloatArray, points_in_cam: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Project points and differentiate the pixels by point and parameters.

        Arguments as in :meth:`project`.

        Returns
        -------
        pixels : (N, 2) float64
        pixels_wrt_points : (N, 2, 3) float64
        pixels_wrt_params : (N, 2, k) float64
            All NaN where the model has no value.
        """
        points = as_rows(points_in_cam, (3,), "points_in_cam")
        count = len(points)
        pixels, by_point = np.empty((count, 2)), np.empty((count, 2, 3))
        by_params = np.empty((count, 2, self.num_parameters))
        _project_jacobian_all(self.tag, self.check_parameters(params, count), points, pixels, by_point, by_params)
        return pixels, by_point, by_params

    def unproject(self, params: FloatArray, pixels: FloatArray) -> FloatArray:
        """Find the unit bearings that project to pixels; the inverse of :meth:`project` in front of the camera.

        Parameters
        ----------
        params : (k,) or (N, k) float64
            Camera parameters.
        pixels : (N, 2) float64
            Pixels.

        Returns
        -------
        (N, 3) float64
            Unit bearings in the camera frame; rows of NaN where the pixel lies beyond the radius up to which the
            distortion is monotone, so that no bearing, or more than one, would fit.
        """
        rows = as_rows(pixels, (2,), "pixels")
        bearings = np.empty((len(rows), 3))
        _unproject_all(self.tag, self.check_parameters(params, len(rows)), rows, bearings)
        return bearings

    def pinhole_parameters(self, params: FloatArray) -> FloatArray:
        """Return fx, fy, cx, cy (N, 4) of a model without distortion, for ``params`` (k,) or (N, k).

        Raises
        ------
        InputError
            If the model has distortion, under which images of lines are curves.
        """
        self.require_pinhole()
        rows = self.check_parameters(params)
        K = np.empty((len(rows), 4))
        _pinhole_parameters_all(self.tag, rows, K)
        return K

    def require_pinhole(self) -> None:
        """Raise :class:`~groma.errors.InputError` unless the model is free of distortion by its form."""
        if not self.has_pinhole_parameters:
            raise InputError(
                f"Straight image lines need a camera model without distortion, such as PINHOLE; got {self.name}. "
                "Use the bearing factor for lines under distortion, or undistort the segments first."
            )

    def pixel_difference(self, params: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
        """Return ``first - second`` (N, 2), in a panorama the short way round; arguments as in :meth:`unproject`."""
        difference = as_rows(first, (2,), "first") - as_rows(second, (2,), "second")
        rows = self.check_parameters(params, len(difference))
        if has_wrap_kernel(self.number + 1):
            _wrap_all(self.tag, rows, difference)
        return difference

    def focal_length(self, params: FloatArray) -> FloatArray:
        """Mean focal length in pixels, shape () or (N,) for ``params`` (k,) or (N, k).

        Of a panorama, the pixels of a radian around its axis, where it looks like a camera of that focal length.
        """
        params = self._as_params(params)
        if self.is_planar:
            return params[..., list(self.focal_indices)].mean(axis=-1)
        rows = self.check_parameters(params)
        _, by_point, _ = self.project_jacobian(rows, np.tile([0.0, 0.0, 1.0], (len(rows), 1)))
        return (0.5 * (by_point[:, 0, 0] + by_point[:, 1, 1])).reshape(params.shape[:-1])

    def camera_matrix(self, params: FloatArray) -> FloatArray:
        r"""Return :math:`K = [f_x, 0, c_x;\ 0, f_y, c_y;\ 0, 0, 1]`, shape (3, 3) or (N, 3, 3), distortion left out.

        Raises
        ------
        InputError
            If the model is a panorama, which no plane can hold.
        """
        params = self._as_params(params)
        if not self.is_planar:
            raise InputError(
                f"A camera matrix needs a focal length; {self.name} has none, no plane holds its view. "
                "Work with bearings (unproject), or cut the panoramas into perspective views."
            )
        K = np.zeros((*params.shape[:-1], 3, 3))
        K[..., 0, 0] = params[..., self.focal_indices[0]]
        K[..., 1, 1] = params[..., self.focal_indices[-1]]
        K[..., 2, 2] = 1.0
        if self.principal_point_indices:
            K[..., :2, 2] = params[..., list(self.principal_point_indices)]
        return K

    def undistort_pixels(self, params: FloatArray, pixels: FloatArray) -> FloatArray:
        """Move pixels to where a camera of equal focal length and principal point, without distortion, sees them.

        Parameters
        ----------
        params : (k,) or (N, k) float64
            Camera parameters.
        pixels : (N, 2) float64
            Pixels as measured.

        Returns
        -------
        (N, 2) float64
            Pixels of the camera with matrix :meth:`camera_matrix`; NaN where :meth:`unproject` has no value or the
            bearing does not point forward.
        """
        bearings = self.unproject(params, pixels)
        bearings[~(bearings[:, 2] > 0.0)] = np.nan
        K = np.broadcast_to(self.camera_matrix(params), (len(bearings), 3, 3))
        return np.einsum("nij,nj->ni", K[:, :2], bearings / bearings[:, 2:])

    def bearing_jacobian(self, params: FloatArray, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        r"""Bearings and their derivative by the pixel.

        .. math::
            \frac{\partial f}{\partial u} = J^+ = J^\top (J J^\top)^{-1}, \qquad
            J = \frac{\partial\,\mathrm{project}}{\partial X}\Big|_{X=f}

        Projection does not depend on the length of its argument, so :math:`J f = 0` and the columns of the
        derivative lie in the tangent plane of the bearing: :math:`f^\top \partial f/\partial u = 0`.

        Parameters
        ----------
        params : (k,) or (N, k) float64
            Camera parameters.
        pixels : (N, 2) float64
            Pixels.

        Returns
        -------
        bearings : (N, 3) float64
        bearings_wrt_pixels : (N, 3, 2) float64
            In radians per pixel; NaN where there is no bearing or the derivative is singular.
        """
        bearings = self.unproject(params, pixels)
        _, J, _ = self.project_jacobian(params, bearings)
        (a, b), c = (J * J).sum(axis=-1).T, (J[:, 0] * J[:, 1]).sum(axis=-1)
        determinant = a * b - c * c
        determinant[~(determinant > 0.0)] = np.nan
        adjugate = np.stack([b, -c, -c, a], axis=-1).reshape(-1, 2, 2)
        return bearings, np.swapaxes(J, 1, 2) @ (adjugate / determinant[:, None, None])

    def check_parameters(self, params: FloatArray, count: int | None = None) -> FloatArray:
        """Return ``params`` as contiguous rows (1, k) or (N, k); raise ShapeError unless they fit ``count`` items."""
        rows = np.atleast_2d(self._as_params(params))
        if rows.ndim != 2 or (count is not None and len(rows) not in (1, count)):
            expected = f"({self.num_parameters},) or (N, {self.num_parameters})"
            raise ShapeError(f"params must have shape {expected} with N = {count}; got {np.shape(params)}.")
        return np.ascontiguousarray(rows)

    def _as_params(self, params: FloatArray) -> FloatArray:
        params = np.asarray(params, dtype=np.float64)
        if params.ndim == 0 or params.shape[-1] != self.num_parameters:
            raise ShapeError(
                f"{self.name} has the {self.num_parameters} parameters {', '.join(self.parameter_names)}; "
                f"got an array of shape {params.shape}. Pass them along the last axis, in this order."
            )
        return params


__all__ = [
    "CameraModel",
    "pinhole_parameters",
    "pinhole_parameters_jacobian",
    "project",
    "project_jacobian",
    "unproject",
    "wrap",
]
