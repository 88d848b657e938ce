# SPDX-License-Identifier: BSD-3-Clause
"""The same camera in another model: parameters go by their names, what the new model adds is zero."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.cameras.contract import CameraModel
from groma.errors import InputError, check_kind

#: A camera is the same in another model if no pixel of a grid moves by more, pixels.
SAME_PIXEL = 1e-6


def in_model(params: FloatArray, old: CameraModel, new: CameraModel, size: FloatArray | None = None) -> FloatArray:
    """Return the parameters of a camera in another model.

    Parameters
    ----------
    params : (k,) float64
        Of the model ``old``.
    old, new : CameraModel
        For example PINHOLE and OPENCV.
    size : (2,) float64, optional
        Width and height of the image, pixels; without it the principal point is taken for the middle.

    Raises
    ------
    InputError
        If the new model would see the world at other pixels.
    """
    for name, model in (("old", old), ("new", new)):
        check_kind(model, CameraModel, name, 'Pass a camera model: groma.cameras.model("PINHOLE").')
    values = {_word(name): value for name, value in zip(old.parameter_names, params, strict=True)}
    found = np.array([values.get(_word(name), 0.0) for name in new.parameter_names])
    focals = params[list(old.focal_indices)] if old.focal_indices else np.ones(1)
    found[list(new.focal_indices)] = focals if len(new.focal_indices) == len(focals) else focals.mean()
    center = params[list(old.principal_point_indices)] if old.principal_point_indices else np.zeros(2)
    if new.principal_point_indices:
        found[list(new.principal_point_indices)] = center
    low, high = (np.zeros(2), 2.0 * center) if size is None else (np.zeros(2), size)
    if not (high > low).all():
        low, high = center - focals.mean(), center + focals.mean()
    grid = np.stack(np.meshgrid(*np.linspace(low, high, 9).T), axis=-1).reshape(-1, 2)
    rays = old.unproject(params, grid)
    seen = np.isfinite(rays).all(axis=1)
    off = np.abs(new.project(found, rays[seen]) - grid[seen]).max(initial=0.0)
    if not off <= SAME_PIXEL:
        raise InputError(
            f"A camera of model {old.name} cannot be a {new.name}: its pixels would move by up to {off:.3g}. Take a "
            "model that adds parameters to the present one, such as OPENCV to PINHOLE or SIMPLE_RADIAL."
        )
    return found


def _word(name: str) -> str:
    """SIMPLE_RADIAL calls k what others call k1."""
    return "k1" if name == "k" else name
