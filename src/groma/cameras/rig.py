# SPDX-License-Identifier: BSD-3-Clause
r"""Rigs: several sensors fixed to one body.

A sensor sits on the rig at ``sensor_from_rig`` (for a camera :math:`T_{CB}`), and the rig moves as ``rig_from_world``
(:math:`T_{BW}`), so

.. math:: T_{CW} = T_{CB}\, T_{BW} .

With left increments, a derivative :math:`J_{CW}` by the camera's pose chains as

.. math:: J_{CB} = J_{CW}, \qquad J_{BW} = J_{CW}\, \mathrm{Ad}(T_{CB}) .

Poses are (..., 7) = quaternion x, y, z, w and translation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.errors import ShapeError
from groma.geometry import se3

# ---------------------------------------------------------------------------------------------------------- Public


def cam_from_world(cam_from_rig: FloatArray, rig_from_world: FloatArray) -> FloatArray:
    r"""Compose the poses of rig cameras, :math:`T_{CW} = T_{CB} T_{BW}`.

    Parameters
    ----------
    cam_from_rig : (..., 7) float64
        Extrinsics of the cameras.
    rig_from_world : (..., 7) float64
        Poses of the rigs; the leading axes broadcast against those of `cam_from_rig`.

    Returns
    -------
    (..., 7) float64
        Poses of the cameras.

    Raises
    ------
    ShapeError
        If a last axis is not 7, or the leading axes do not broadcast.
    """
    return se3.compose(*_broadcast(cam_from_rig, rig_from_world, "rig_from_world"))


def rig_from_world(cam_from_rig: FloatArray, cam_from_world: FloatArray) -> FloatArray:
    r"""Return the rig's poses from those of its cameras, :math:`T_{BW} = T_{CB}^{-1} T_{CW}`.

    The inverse of :func:`cam_from_world` in its second argument; arguments and shapes as there.
    """
    extrinsics, poses = _broadcast(cam_from_rig, cam_from_world, "cam_from_world")
    return se3.compose(se3.inverse(extrinsics), poses)


@dataclass(frozen=True)
class Rig:
    """Sensors fixed to one body."""

    #: (S, 7) float64, pose of each sensor on the rig; the reference sensor, if there is one, is the identity.
    sensor_from_rig: FloatArray

    def __post_init__(self) -> None:
        poses = np.array(self.sensor_from_rig, dtype=np.float64)
        if poses.ndim != 2 or poses.shape[1] != 7:
            raise ShapeError(f"sensor_from_rig must have shape (S, 7); got {poses.shape}.")
        poses.flags.writeable = False
        object.__setattr__(self, "sensor_from_rig", poses)

    def __len__(self) -> int:
        return len(self.sensor_from_rig)

    @classmethod
    def single(cls) -> Rig:
        """Return the rig of one sensor that coincides with the body."""
        return cls(np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]))

    def cam_from_world(self, rig_from_world: FloatArray) -> FloatArray:
        """Poses of all sensors (..., S, 7) for rig poses (..., 7)."""
        return cam_from_world(self.sensor_from_rig, _poses(rig_from_world, "rig_from_world")[..., None, :])


def _broadcast(first: FloatArray, second: FloatArray, second_name: str) -> tuple[FloatArray, FloatArray]:
    first, second = _poses(first, "cam_from_rig"), _poses(second, second_name)
    try:
        shape = np.broadcast_shapes(first.shape, second.shape)
    except ValueError as error:
        raise ShapeError(
            f"cam_from_rig and {second_name} must broadcast; got {first.shape} and {second.shape}. "
            f"Add an axis of length 1 to combine each with each."
        ) from error
    return np.broadcast_to(first, shape), np.broadcast_to(second, shape)


def _poses(array: FloatArray, name: str) -> FloatArray:
    poses = np.asarray(array, dtype=np.float64)
    if poses.ndim == 0 or poses.shape[-1] != 7:
        raise ShapeError(f"{name} must have shape (..., 7) = quaternion xyzw and translation; got {poses.shape}.")
    return poses
