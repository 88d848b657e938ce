# SPDX-License-Identifier: BSD-3-Clause
r"""Similarity transforms of the world, :math:`X' = s R X + t`, and what they do to everything in a scene."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.errors import InputError, ShapeError
from groma.geometry import quaternion, sim3


@dataclass(frozen=True, eq=False)
class Similarity:
    """``new_from_old``: a point moves to ``scale * rotation @ X + translation``."""

    #: Positive factor.
    scale: float = 1.0
    #: (3, 3) rotation.
    rotation: FloatArray = field(default_factory=lambda: np.eye(3))
    #: (3,) translation, new units.
    translation: FloatArray = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        rotation, translation = np.asarray(self.rotation, float), np.asarray(self.translation, float)
        if rotation.shape != (3, 3) or translation.shape != (3,):
            raise ShapeError(f"Similarity needs shapes (3, 3) and (3,); got {rotation.shape} and {translation.shape}.")
        object.__setattr__(self, "scale", float(self.scale))
        object.__setattr__(self, "rotation", rotation)
        object.__setattr__(self, "translation", translation)
        if not (np.isfinite(rotation).all() and np.isfinite(translation).all() and 0 < self.scale < np.inf):
            raise InputError(f"Similarity needs a positive scale and finite numbers; got scale {self.scale}.")
        if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-6 or np.linalg.det(rotation) < 0:
            raise InputError("Similarity.rotation must be a rotation matrix. Orthonormalise it first.")

    @classmethod
    def from_array(cls, new_from_old: npt.ArrayLike) -> Self:
        """Return that of an array (8,) [qx qy qz qw tx ty tz s], the form of :mod:`groma.geometry.sim3`."""
        array = np.asarray(new_from_old, float)
        if array.shape != (8,):
            raise ShapeError(f"One similarity must have shape (8,), quaternion, translation, scale; got {array.shape}.")
        scale, rotation, translation = sim3.to_parts(array)
        return cls(float(scale), rotation, translation)

    def to_array(self) -> FloatArray:
        """Return (8,) [qx qy qz qw tx ty tz s], the form of :mod:`groma.geometry.sim3`."""
        return sim3.from_parts(self.scale, self.rotation, self.translation)

    def inverse(self) -> Self:
        """Return ``old_from_new``."""
        return type(self)(1 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale)

    def after(self, first: Self) -> Self:
        """Return the similarity that does another one first, and then this one."""
        rotation, translation = self.rotation @ first.rotation, self.points(first.translation)
        return type(self)(self.scale * first.scale, rotation, translation)

    def points(self, xyz: npt.ArrayLike) -> FloatArray:
        """Move points, (..., 3)."""
        return self.scale * (np.asarray(xyz, float) @ self.rotation.T) + self.translation

    def directions(self, vectors: npt.ArrayLike) -> FloatArray:
        """Turn directions, (..., 3)."""
        return np.asarray(vectors, float) @ self.rotation.T

    def covariances(self, matrices: npt.ArrayLike) -> FloatArray:
        r"""Return covariances of points, (..., 3, 3), in the new world: :math:`s^2 R \Sigma R^\top`."""
        return self.scale**2 * (self.rotation @ np.asarray(matrices, float) @ self.rotation.T)

    def lines(self, plucker: npt.ArrayLike) -> FloatArray:
        r"""Move Plücker lines, (..., 6); unit directions stay unit.

        .. math:: d' = R d, \qquad m' = s R m + t \times R d
        """
        old = np.asarray(plucker, float)
        direction = self.directions(old[..., 3:])
        moment = self.scale * self.directions(old[..., :3]) + np.cross(self.translation, direction)
        return np.concatenate([moment, direction], -1)

    def planes(self, hesse: npt.ArrayLike) -> FloatArray:
        r"""Move planes, (..., 4); unit normals stay unit.

        .. math:: n' = R n, \qquad w' = s w - n' \cdot t
        """
        old = np.asarray(hesse, float)
        normal = self.directions(old[..., :3])
        return np.concatenate([normal, (self.scale * old[..., 3] - normal @ self.translation)[..., None]], -1)

    def poses(self, cam_from_world: npt.ArrayLike) -> FloatArray:
        r"""Return ``cam_from_new`` for poses ``cam_from_old``, (..., 7).

        .. math:: R'_{cw} = R_{cw} R^\top, \qquad t'_{cw} = s\,t_{cw} - R'_{cw}\,t
        """
        old = np.asarray(cam_from_world, float)
        if old.shape[-1:] != (7,):
            raise ShapeError(f"cam_from_world must have shape (..., 7); got {old.shape}.")
        inverse = np.broadcast_to(quaternion.from_matrix(self.rotation.T), old[..., :4].shape)
        turned = quaternion.multiply(old[..., :4], inverse)
        turned = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        moved = self.scale * old[..., 4:] - quaternion.rotate(
            turned, np.broadcast_to(self.translation, old[..., 4:].shape)
        )
        return np.concatenate([turned, moved], -1)
