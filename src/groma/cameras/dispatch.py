# SPDX-License-Identifier: BSD-3-Clause
r"""How compiled code calls the kernels of the right camera model.

Loops that project points (the factors) do not know the model. They take :attr:`groma.cameras.CameraModel.tag` as an
argument, a tuple of ``None`` whose length is one more than the number of the model. Numba compiles a loop per argument
type, and the length is part of the type, so the loop calls the model's kernel directly: no branch, no function
pointer, and Numba's disk cache works. Without the compiler the same names are plain Python functions::

    from groma.compiled import loop

    @loop
    def project_all(model_tag, params, points, pixels):
        for i in range(points.shape[0]):
            project(model_tag, params[i], points[i], pixels[i])

The kernels return False, and write zeros, where the model has no value. Residuals in pixels are passed through
:func:`wrap`, which does nothing but in panoramas whose left and right border are the same place.

**Cheirality.** Perspective models evaluate their formula as written for z < 0 too and refuse only
:math:`|z| \le 10^{-12} (|x| + |y| + |z|)`. Whether a point behind the camera may take part is the caller's decision.
Models that see behind the image plane (:attr:`groma.cameras.CameraModel.sees_behind`) decide themselves: what they
project is seen.
"""

from __future__ import annotations

from collections.abc import Callable

from numba.extending import overload

from groma._kernels.digest import ByLength
from groma._numba import kernel

# --------------------------------------------------------------------------------------------------------- Kernels
# Kernels by length of the tag. Filled by set_kernels. Compiled code on disk depends on the kernels that it was compiled
# with, so a number may mean another model in another process.

_PROJECT: ByLength[Callable[..., bool]] = ByLength()
_PROJECT_JACOBIAN: ByLength[Callable[..., bool]] = ByLength()
_UNPROJECT: ByLength[Callable[..., bool]] = ByLength()
_PINHOLE: ByLength[Callable[..., None]] = ByLength()
_PINHOLE_JACOBIAN: ByLength[Callable[..., None]] = ByLength()
_WRAP: ByLength[Callable[..., None]] = ByLength()


def project(model_tag, params, X, uv):
    """Write the pixel ``uv`` (2,) of the point ``X`` (3,) in the camera frame; False and zeros if it has none."""
    return _PROJECT[len(model_tag)](params, X, uv)


def project_jacobian(model_tag, params, X, uv, J_point, J_params):
    """Write pixel ``uv`` (2,), its derivatives ``J_point`` (2, 3) and ``J_params`` (2, k); False and zeros if none."""
    return _PROJECT_JACOBIAN[len(model_tag)](params, X, uv, J_point, J_params)


def unproject(model_tag, params, uv, bearing):
    """Write the unit ``bearing`` (3,) of the pixel ``uv`` (2,); False and zeros if the model does not reach it."""
    return _UNPROJECT[len(model_tag)](params, uv, bearing)


def pinhole_parameters(model_tag, params, K):
    """Write ``K`` (4,) = fx, fy, cx, cy of a model without distortion."""
    _PINHOLE[len(model_tag)](params, K)


def pinhole_parameters_jacobian(model_tag, params, J):
    """Write ``J`` (4, k), the derivative of fx, fy, cx, cy by the parameters of a model without distortion."""
    _PINHOLE_JACOBIAN[len(model_tag)](params, J)


def wrap(model_tag, params, difference):
    """Take a ``difference`` (2,) of two pixels the short way, where borders of the image are the same place."""
    _WRAP[len(model_tag)](params, difference)


@overload(project)
def _project(model_tag, params, X, uv):
    kernel = _PROJECT[model_tag.count]
    return lambda model_tag, params, X, uv: kernel(params, X, uv)


@overload(project_jacobian)
def _project_jacobian(model_tag, params, X, uv, J_point, J_params):
    kernel = _PROJECT_JACOBIAN[model_tag.count]
    return lambda model_tag, params, X, uv, J_point, J_params: kernel(params, X, uv, J_point, J_params)


@overload(unproject)
def _unproject(model_tag, params, uv, bearing):
    kernel = _UNPROJECT[model_tag.count]
    return lambda model_tag, params, uv, bearing: kernel(params, uv, bearing)


@overload(pinhole_parameters)
def _pinhole_parameters(model_tag, params, K):
    kernel = _PINHOLE[model_tag.count]
    return lambda model_tag, params, K: kernel(params, K)


@overload(pinhole_parameters_jacobian)
def _pinhole_parameters_jacobian(model_tag, params, J):
    kernel = _PINHOLE_JACOBIAN[model_tag.count]
    return lambda model_tag, params, J: kernel(params, J)


@overload(wrap)
def _wrap(model_tag, params, difference):
    kernel = _WRAP[model_tag.count]
    return lambda model_tag, params, difference: kernel(params, difference)


@kernel
def _leave(params, difference):
    """Wrap nothing: opposite borders of the image are different places."""


# ---------------------------------------------------------------------------------------------------------- Public


def set_kernels(
    length: int,
    project: Callable[..., bool],
    project_jacobian: Callable[..., bool],
    unproject: Callable[..., bool],
    pinhole_parameters: Callable[..., None] | None = None,
    pinhole_parameters_jacobian: Callable[..., None] | None = None,
    wrap: Callable[..., None] | None = None,
) -> None:
    """Say which kernels a tag of ``length`` selects."""
    _WRAP[length] = _leave if wrap is None else wrap
    _PROJECT[length], _PROJECT_JACOBIAN[length], _UNPROJECT[length] = project, project_jacobian, unproject
    if pinhole_parameters is not None and pinhole_parameters_jacobian is not None:
        _PINHOLE[length], _PINHOLE_JACOBIAN[length] = pinhole_parameters, pinhole_parameters_jacobian


def kernel_module(length: int) -> str:
    """Name the module that holds the kernels a tag of ``length`` selects."""
    return _PROJECT[length].__module__


def has_wrap_kernel(length: int) -> bool:
    """Whether a tag of ``length`` selects a model in whose images opposite borders are the same place."""
    return _WRAP[length] is not _leave


def has_pinhole_kernels(length: int) -> bool:
    """Whether a tag of ``length`` selects a model without distortion."""
    return length in _PINHOLE
