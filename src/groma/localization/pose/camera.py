# SPDX-License-Identifier: BSD-3-Clause
"""The camera of a query: one calibration, and its pixels without distortion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma import cameras
from groma._typing import FloatArray
from groma.cameras import CameraModel
from groma.errors import InputError, check_kind
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.scene import Cameras

#: How to get one.
CAMERA_WAY = "Make one: groma.QueryCamera(model, params, width, height)."


@dataclass(frozen=True, eq=False)
class QueryCamera:
    """A calibrated camera: model, parameters and image size."""

    #: A name of :func:`groma.cameras.models` whose images a plane can hold.
    model: str
    #: (k,) parameters in the order of the model.
    params: FloatArray
    #: Size of the image, pixels.
    width: int
    height: int

    def __post_init__(self) -> None:
        kind = cameras.model(self.model)
        params = np.ascontiguousarray(self.params, dtype=np.float64).ravel()
        object.__setattr__(self, "params", params)
        if len(params) != kind.num_parameters:
            raise InputError(
                f"Camera model {kind.name} has {kind.num_parameters} parameters ({', '.join(kind.parameter_names)}); "
                f"got {len(params)}. Pass them in this order."
            )
        if not np.isfinite(params).all() or not all(params[i] > 0 for i in kind.focal_indices):
            raise InputError(f"Camera parameters must be finite, focal lengths positive; got {params.tolist()}.")
        if min(self.width, self.height) < 1:
            raise InputError(f"The size of an image must be positive, pixels; got {self.width} x {self.height}.")
        if not kind.is_planar:
            raise InputError(f"{kind.name} images are panoramas; cut them into perspective views to localise them.")

    @property
    def kind(self) -> CameraModel:
        """The camera model."""
        return cameras.model(self.model)

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) camera matrix of the image without distortion."""
        return self.kind.camera_matrix(self.params)

    @property
    def area(self) -> float:
        """Pixels of the image."""
        return float(self.width * self.height)

    def straight(self, pixels: npt.ArrayLike) -> FloatArray:
        """Pixels (N, 2) without distortion; NaN where the model has none."""
        return self.kind.undistort_pixels(self.params, np.ascontiguousarray(pixels, dtype=np.float64).reshape(-1, 2))

    def project(self, cam_from_world: FloatArray, points: FloatArray) -> FloatArray:
        """Pixels (N, 2) of points in the world; NaN behind the camera and where the model has none."""
        inside = seen_from(cam_from_world, points)
        pixels = self.kind.project(self.params, np.ascontiguousarray(inside))
        if not self.kind.sees_behind:
            pixels[inside[:, 2] <= 0.0] = np.nan
        return pixels

    def inside(self, pixels: FloatArray, margin: float = 0.0) -> npt.NDArray[np.bool_]:
        """Which pixels (N, 2) lie in the image, grown by a margin."""
        with np.errstate(invalid="ignore"):
            inside = (pixels >= -margin) & (pixels <= np.array([self.width, self.height]) + margin)
        return inside[:, 0] & inside[:, 1]

    def table(self) -> Cameras:
        """The camera as the only row of a table."""
        return Cameras.of([1], [self.model], [self.params], [self.width, self.height])

    @staticmethod
    def of(table: Cameras, row: int) -> QueryCamera:
        """One camera of a scene."""
        check_kind(table, Cameras, "table", "Pass scene.cameras.")
        return QueryCamera(table.models[row], table.params_of(row), int(table.width[row]), int(table.height[row]))


def pose_matrix(cam_from_world: FloatArray) -> FloatArray:
    """Matrix [R | t] (3, 4) of one pose (7,)."""
    return POSE_CHARTS["left"].ambient(cam_from_world[None]).reshape(3, 4)


def seen_from(cam_from_world: FloatArray, points: FloatArray) -> FloatArray:
    """Points (..., 3) of the world as a camera with this pose (7,) has them."""
    R_t = pose_matrix(cam_from_world)
    return points @ R_t[:, :3].T + R_t[:, 3]
