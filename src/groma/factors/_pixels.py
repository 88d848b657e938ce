# SPDX-License-Identifier: BSD-3-Clause
"""What factors with a residual in pixels share: the parameters of the cameras, and the camera model.

All of one group have the same model, so that its kernels are chosen when the loop is compiled (see
:mod:`groma.cameras.dispatch`). Parameters change rarely from one observation to the next: loops keep the row they
read last.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel
from groma._typing import FloatArray
from groma.cameras import CameraModel, model
from groma.errors import InputError, ShapeError
from groma.factors._examples import make_example, visible_scene
from groma.factors._rig import CameraFactor
from groma.factors.contract import ANY_SIMILARITY, Example, Invariance, Ref, Slot
from groma.geometry.manifold import Euclidean

INTRINSICS = Slot("intrinsics", "intrinsics")


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def load_row(rows, k, previous, out):
    """Copy row ``k`` of ``rows`` to ``out`` unless it is there already; return k."""
    if k != previous:
        for j in range(out.shape[0]):
            out[j] = rows[k, j]
    return k


@kernel
def put_parameters(J_params, record, i, row, column):
    """Copy row ``row`` of ``J_params`` (m, k) into the record at ``column``."""
    for j in range(J_params.shape[1]):
        record[i, row, column + j] = J_params[row, j]


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, kw_only=True)
class PixelFactor(CameraFactor):
    """A factor that reads the parameters of a camera too."""

    #: Parameters of the cameras, all of one model.
    intrinsics: Ref
    #: The camera model, or its name; for factors of lines one without distortion, such as PINHOLE.
    camera_model: CameraModel | str

    #: Whether the formula holds without distortion only.
    pinhole_only: ClassVar[bool] = False
    invariance: ClassVar[Invariance] = ANY_SIMILARITY

    def __post_init__(self) -> None:
        """Look the model up."""
        super().__post_init__()
        object.__setattr__(self, "camera_model", as_camera_model(self.camera_model))
        if self.pinhole_only:
            self.camera.require_pinhole()

    @property
    def camera(self) -> CameraModel:
        """The camera model."""
        return as_camera_model(self.camera_model)

    @property
    def smallest_depth(self) -> float:
        """Points must lie further along the optical axis than this: 0 unless the model sees behind itself."""
        return -np.inf if self.camera.sees_behind else 0.0

    def arguments(self, inputs: tuple[Any, ...], landmark: Ref, *measured: Any) -> tuple[Any, ...]:
        """Return what loops take first: the model, the ``inputs`` of ``evaluate``, indices, what was measured.

        Raises ShapeError if the intrinsics do not fit the model.
        """
        camera, width = self.camera, inputs[-1].shape[1]
        if width != camera.num_parameters:
            raise ShapeError(
                f"{camera.name} has {camera.num_parameters} parameters; the group of intrinsics has {width}. "
                "Make one group of factors for each camera model."
            )
        return camera.tag, *inputs, landmark.index, self.intrinsics.index, *measured


@dataclass(frozen=True, kw_only=True)
class StereoFactor(PixelFactor):
    """A factor seen by a rectified stereo pair; the parameters are common to both of its cameras."""

    #: Distance of the right camera from the left one along x, scene units: a number, or (N,).
    baseline: float | FloatArray

    pinhole_only: ClassVar[bool] = True
    invariance: ClassVar[Invariance] = Invariance()

    def __post_init__(self) -> None:
        """Make the baseline a float or (N,); raise unless all are finite and positive."""
        super().__post_init__()
        baseline = np.ascontiguousarray(self.baseline, dtype=np.float64)
        if np.ndim(self.baseline) and baseline.shape != (len(self),):
            raise ShapeError(
                f"{type(self).__name__}.baseline must be a number or ({len(self)},); got {baseline.shape}."
            )
        if not (np.isfinite(baseline) & (baseline > 0.0)).all():
            raise InputError(
                f"{type(self).__name__}.baseline must be positive (the right camera's distance along x); got "
                f"{baseline.min()}. Swap left and right if it is negative."
            )
        object.__setattr__(self, "baseline", baseline if np.ndim(self.baseline) else float(baseline[0]))


def as_camera_model(camera: CameraModel | str) -> CameraModel:
    """Return the model itself, or the one of this name."""
    return model(camera) if isinstance(camera, str) else camera


def pixel_example(factor: PixelFactor, rng: np.random.Generator) -> Example:
    """Let two cameras see the points and lines of :func:`visible_scene`, for factors with a residual in pixels.

    They have the model PINHOLE or RADIAL, and their group is named ``"intrinsics"``.
    """
    parameters = np.array([[500.0, 520.0, 320.0, 240.0], [400.0, 380.0, 300.0, 200.0]])
    if factor.camera.name == "RADIAL":
        parameters = np.array([[500.0, 320.0, 240.0, -0.1, 0.02], [400.0, 300.0, 200.0, 0.05, -0.01]])
    manifolds = {"intrinsics": Euclidean(parameters.shape[1], "intrinsics")}
    return make_example(factor, rng, manifolds=manifolds, states={**visible_scene(rng), "intrinsics": parameters})
