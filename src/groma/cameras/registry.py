# SPDX-License-Identifier: BSD-3-Clause
"""All camera models by name."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace

from groma.cameras.contract import CameraModel
from groma.cameras.dispatch import kernel_module, set_kernels
from groma.errors import InputError, check_kind, did_you_mean

_MODELS: dict[str, CameraModel] = {}
#: One for every registration of this process.
_NUMBERS = itertools.count()


def register_camera(
    camera: CameraModel,
    project: Callable[..., bool],
    project_jacobian: Callable[..., bool],
    unproject: Callable[..., bool],
    pinhole_parameters: Callable[..., None] | None = None,
    pinhole_parameters_jacobian: Callable[..., None] | None = None,
    wrap: Callable[..., None] | None = None,
) -> CameraModel:
    """Make a camera model known by name, and its kernels to compiled loops.

    Parameters
    ----------
    camera : CameraModel
        The model.
    project, project_jacobian, unproject : callable
        Kernels (decorated with :func:`groma.compiled.kernel`) as described in :mod:`groma.cameras.dispatch`, without
        the tag.
    pinhole_parameters, pinhole_parameters_jacobian : callable, optional
        For models without distortion only.
    wrap : callable, optional
        For panoramas, of which opposite borders are the same place.

    Returns
    -------
    CameraModel
        The model with the number that selects its kernels.

    Raises
    ------
    InputError
        If the name belongs to a model of another module.
    """
    check_kind(camera, CameraModel, "camera", "Pass a CameraModel, the first argument, then its kernels.")
    known = _MODELS.get(camera.name)
    if known is not None and kernel_module(known.number + 1) != project.__module__:
        raise InputError(
            f"A camera model named {camera.name!r} is registered already, by {kernel_module(known.number + 1)}. "
            "Choose another name."
        )
    camera = _MODELS[camera.name] = replace(camera, number=next(_NUMBERS))
    kernels = project, project_jacobian, unproject, pinhole_parameters, pinhole_parameters_jacobian, wrap
    set_kernels(camera.number + 1, *kernels)
    return camera


def model(name: str) -> CameraModel:
    """Return the camera model of the given name, for example ``"PINHOLE"``; InputError lists the names if unknown."""
    check_kind(name, str, "name", "Pass the name of a camera model, such as PINHOLE.")
    if name not in _MODELS:
        known = ", ".join(other.name for other in models())
        raise InputError(
            f"Camera model must be one of {known}; got {name!r}.{did_you_mean(name, _MODELS)} "
            "Convert the images to one of these models first, or register it with groma.cameras.register_camera."
        )
    return _MODELS[name]


def models() -> tuple[CameraModel, ...]:
    """All registered camera models, in the order of their registration."""
    return tuple(_MODELS.values())
