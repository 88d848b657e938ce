# SPDX-License-Identifier: BSD-3-Clause
"""What a sequence gives: frames one by one, their camera, and a reference trajectory if there is one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from groma import cameras
from groma._typing import BoolArray, FloatArray
from groma.errors import GromaError, InputError
from groma.io.trajectories import Trajectory

#: What the frames of a sequence hold: a depth image, a second rectified image, or neither.
Kind = Literal["rgbd", "stereo", "mono"]


@dataclass(frozen=True, eq=False)
class Frame:
    """One moment: an image, and what was measured with it. All images have the size of the camera."""

    #: Seconds.
    timestamp: float
    #: (H, W) uint8 grey image, undistorted.
    gray: npt.NDArray[np.uint8]
    #: (H, W) float32 depth along the optical axis, metres, registered to ``gray``; 0 where unknown.
    depth: npt.NDArray[np.float32] | None = None
    #: (H, W) uint8 right image, rectified: a point lies in the same row, at a column not greater than in ``gray``.
    right: npt.NDArray[np.uint8] | None = None
    #: Name of the image file, or the number of the frame.
    name: str = ""
    #: (H, W) bool, which pixels may be used; None: all.
    used: BoolArray | None = None


@dataclass(frozen=True, eq=False)
class SequenceCamera:
    """The camera of all frames of a sequence, as the frames are given (after undistortion and rectification)."""

    #: Name of a camera model of :mod:`groma.cameras`; ``PINHOLE`` for everything that ``open_sequence`` reads.
    model: str
    #: (k,) parameters of the model, pixels; the first pixel's centre is (0.5, 0.5).
    params: FloatArray
    #: Size of the images, pixels.
    width: int
    height: int
    #: Distance of the right camera from the left, metres; None without a right camera.
    baseline: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "params", checked_params(self.model, self.params, "camera"))
        if not (self.width > 0 and self.height > 0):
            raise InputError(f"camera: width and height must be positive pixels; got {self.width} x {self.height}.")
        if self.baseline is not None and not 0.0 < self.baseline < float("inf"):
            raise InputError(f"camera: the baseline must be positive metres, or None; got {self.baseline}.")


def checked_params(model: str, params: npt.ArrayLike, source: str) -> FloatArray:
    """Return the parameters of a camera model as an array (k,).

    Raises
    ------
    InputError
        If the model is unknown, or takes other parameters; ``source`` says where they are from.
    """
    try:
        known, numbers = cameras.model(model), np.array(params, np.float64)
    except (GromaError, TypeError, ValueError) as error:
        raise InputError(f"{source}: {error}") from error
    if numbers.shape != (known.num_parameters,) or not np.isfinite(numbers).all():
        raise InputError(
            f"{source}: {model} takes {known.num_parameters} finite numbers ({', '.join(known.parameter_names)}); "
            f"got {numbers.tolist()}."
        )
    if not known.is_planar:
        raise InputError(
            f"{source}: frames are followed in images that a plane can hold, and {model} images are panoramas. Cut a "
            "perspective view out of each, and pass its camera."
        )
    if not (numbers[list(known.focal_indices)] > 0).all():
        raise InputError(f"{source}: focal lengths must be positive; got {numbers.tolist()}.")
    return numbers


@runtime_checkable
class Sequence(Protocol):
    """Frames in temporal order, read on iteration, never all in memory. May be iterated repeatedly."""

    camera: SequenceCamera
    kind: Kind
    #: world_from_cam of the camera that took ``gray``, or None.
    reference: Trajectory | None
    #: What was left out or repaired, in sentences; grows while frames are read.
    warnings: list[str]
    #: Number of frames, unreadable ones included; None: unknown before reading (video).
    num_frames: int | None

    def __iter__(self) -> Iterator[Frame]: ...
