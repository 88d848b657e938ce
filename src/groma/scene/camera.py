# SPDX-License-Identifier: BSD-3-Clause
"""Cameras (calibrations), and the rigs that hold them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma import cameras as camera_models
from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError
from groma.scene.table import Table, check_sigma, check_unique, column, text_column

#: Kinds of sensors in a rig.
CAMERA, OTHER = 0, 1


@dataclass(frozen=True, eq=False)
class Cameras(Table, noun="camera"):
    """Calibrations: model, parameters and image size. Several images may share one."""

    #: (C,) identifiers.
    ids: IntArray = column(np.int64, check=check_unique)
    #: (C,) names of camera models, see :func:`groma.cameras.models`.
    models: tuple[str, ...] = text_column()
    #: (C, K) parameters, K that of the longest model; the rest of a row is zero. Pixels and pure numbers.
    params: FloatArray = column(np.float64, None)
    #: (C,) image width, pixels; 0 where unknown.
    width: IntArray = column(np.int64)
    #: (C,) image height, pixels; 0 where unknown.
    height: IntArray = column(np.int64)

    def _check(self) -> None:
        for row, count in enumerate(self.num_params):
            if count > self.params.shape[1]:
                raise ShapeError(
                    f"Camera {self.ids[row]} has model {self.models[row]}, which takes {count} parameters; "
                    f"got {self.params.shape[1]}."
                )
            if self.params[row, count:].any():
                raise ShapeError(
                    f"Camera {self.ids[row]} has model {self.models[row]}, which takes {count} parameters; "
                    f"the rest of the row must be zero, got {self.params[row].tolist()}."
                )
        if len(self) and min(self.width.min(), self.height.min()) < 0:
            raise InputError("Cameras.width and height must not be negative; use 0 where the size is unknown.")
        if len(half := np.flatnonzero((self.width == 0) != (self.height == 0))):
            row = half[0]
            raise InputError(
                f"Camera {self.ids[row]} has {self.width[row]} x {self.height[row]} pixels; width and height must "
                "both be positive, or both 0."
            )

    @classmethod
    def of(
        cls, ids: npt.ArrayLike, models: Sequence[str], params: Sequence[npt.ArrayLike], sizes: npt.ArrayLike
    ) -> Cameras:
        """Return cameras with their parameters, of any numbers, and sizes (C, 2) as width and height."""
        padded = np.zeros((len(params), max(map(np.size, params), default=0)))
        for row, values in enumerate(params):
            padded[row, : np.size(values)] = values
        width, height = np.reshape(np.asarray(sizes, np.int64), (-1, 2)).T
        return cls(np.asarray(ids, np.int64), tuple(models), padded, width, height)

    @property
    def num_params(self) -> list[int]:
        """Number of parameters of each camera's model."""
        known = {name: camera_models.model(name).num_parameters for name in set(self.models)}
        return [known[name] for name in self.models]

    def by_model(self) -> dict[str, IntArray]:
        """Return the rows of the cameras of each model."""
        models = np.array(self.models, dtype=object)
        return {str(name): np.flatnonzero(models == name) for name in dict.fromkeys(models)}

    def rows_by_model(self, camera_idx: IntArray) -> Iterator[tuple[camera_models.CameraModel, IntArray, FloatArray]]:
        """Yield (model, rows (n,) of ``camera_idx`` of its cameras, their parameters (n, k)) for each camera model."""
        models = np.array(self.models, dtype=object)
        for name in dict.fromkeys(self.models):
            rows = np.flatnonzero((models == name)[camera_idx])
            if len(rows):
                model = camera_models.model(name)
                yield model, rows, np.ascontiguousarray(self.params[camera_idx[rows], : model.num_parameters])

    def with_model(self, name: str) -> Cameras:
        """Return the same cameras in another model that can hold them; parameters that it adds are zero.

        Raises
        ------
        InputError
            If there is no such model, or a camera would see the world at other pixels.
        """
        new, size = camera_models.model(name), np.stack([self.width, self.height], axis=1).astype(float)
        rows = [
            camera_models.in_model(self.params_of(row), camera_models.model(old), new, size[row])
            for row, old in enumerate(self.models)
        ]
        return self.replace(models=(new.name,) * len(self), params=np.array(rows).reshape(-1, new.num_parameters))

    def params_of(self, camera_idx: int) -> FloatArray:
        """Return the parameters of one camera, without padding."""
        return self.params[camera_idx, : self.num_params[camera_idx]].copy()


@dataclass(frozen=True, eq=False)
class PrincipalPointPriors(Table, noun="principal point", optional=True):
    """Where principal points are expected, of cameras whose calibration was not given; that is then estimated."""

    #: (N,) the camera, each once.
    camera_idx: IntArray = column(np.int64, refers="cameras", check=check_unique)
    #: (N, 2) where its principal point is expected, and the standard deviation of a coordinate, pixels.
    pixel: FloatArray = column(np.float64, 2)
    sigma: FloatArray = column(np.float64, check=check_sigma)


@dataclass(frozen=True, eq=False)
class Rigs(Table, noun="rig"):
    """Bodies that carry sensors. A single camera is a rig with one sensor."""

    #: (G,) identifiers.
    ids: IntArray = column(np.int64, check=check_unique)


@dataclass(frozen=True, eq=False)
class Sensors(Table, noun="sensor"):
    """What is mounted on the rigs; the reference sensor of a rig defines the rig's frame."""

    #: (S,) the rig it is mounted on.
    rig_idx: IntArray = column(np.int64, refers="rigs")
    #: (S,) ``CAMERA`` (0) or ``OTHER`` (1, for example an inertial unit; carried along, not used).
    kind: IntArray = column(np.int64)
    #: (S,) identifier; for cameras that of the camera.
    sensor_ids: IntArray = column(np.int64)
    #: (S,) the camera; -1 for other sensors.
    camera_idx: IntArray = column(np.int64)
    #: (S, 7) pose [qx qy qz qw tx ty tz]; the identity for reference sensors and where unknown.
    cam_from_rig: FloatArray = column(np.float64, 7, length=(0, 0, 0, 0, 1, 1, 1))
    #: (S,) 1 for the reference sensor of its rig.
    is_reference: IntArray = column(np.int64)
    #: (S,) 1 where ``cam_from_rig`` is known.
    has_pose: IntArray = column(np.int64)
