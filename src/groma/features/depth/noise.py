# SPDX-License-Identifier: BSD-3-Clause
r"""How uncertain depth is, and why its inverse is what everything here is fitted to.

Along the ray :math:`r = (x, y, 1)` of a pixel a plane :math:`n \cdot X + w = 0` has the inverse depth

.. math:: \rho = \frac{1}{z} = \theta \cdot r, \qquad \theta = -n / w ,

and a line, lying in planes, has one that is linear along its image. Rays are known well and depths are not, so these
are linear regressions with errors :math:`\sigma_\rho = \sigma_z / z^2`: no iteration, and their covariance is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._typing import FloatArray
from groma.errors import InputError, ShapeError


@dataclass(frozen=True)
class DepthNoise:
    r"""Standard deviation of depth, :math:`\sigma_z = c_0 + c_2 (z - z_0)^2`, metres; by default that of a Kinect.

    A stereo camera with focal length f, baseline b and disparities good to :math:`\sigma_d` has :math:`c_0 = z_0 = 0`
    and :math:`c_2 = \sigma_d / (f b)`.
    """

    #: c0, metres (convention: Nguyen et al. 2012).
    constant: float = 0.0012
    #: c2, one over metres (convention: Nguyen et al. 2012).
    quadratic: float = 0.0019
    #: z0, metres (convention: Nguyen et al. 2012).
    offset: float = 0.4
    #: Number of neighbouring pixels that err alike; covariances are multiplied by it.
    correlation: float = 1.0
    #: Nothing farther is used, metres.
    max_depth: float = 10.0
    #: What is common to all pixels of a surface, and no number of them averages out: standard deviations of the tilt of
    #: a plane about its centre, radians, and of its distance, metres.
    tilt: float = 0.003
    shift: float = 0.002

    def __post_init__(self) -> None:
        values = np.array([*self.numbers, self.correlation, self.tilt, self.shift])
        if not np.isfinite(values).all() or (values < 0).any() or self.constant + self.quadratic == 0:
            raise InputError(f"DepthNoise needs finite numbers that are not negative; got {self}.")
        if self.correlation < 1 or self.max_depth == 0:
            raise InputError(f"DepthNoise.correlation must be at least 1 and max_depth positive; got {self}.")

    def sigma(self, depth: npt.ArrayLike) -> FloatArray:
        """Return the standard deviation of depths (...), metres."""
        return self.constant + self.quadratic * (np.asarray(depth, np.float64) - self.offset) ** 2

    @property
    def numbers(self) -> FloatArray:
        """(4,) what compiled loops read: c0, c2, z0, largest depth."""
        return np.array([self.constant, self.quadratic, self.offset, self.max_depth])


def as_depth(depth: npt.NDArray[np.generic]) -> npt.NDArray[np.float32]:
    """Return a depth image (H, W) as contiguous float32, or raise a ShapeError."""
    image = np.asarray(depth)
    if image.ndim != 2 or 0 in image.shape or not (np.issubdtype(image.dtype, np.floating)):
        raise ShapeError(
            f"depth must be a floating-point image (H, W) in metres, 0 where unknown; got {image.shape} {image.dtype}."
        )
    return np.ascontiguousarray(image, np.float32)


def as_pinhole(params: npt.ArrayLike) -> FloatArray:
    """Return fx, fy, cx, cy of a pinhole camera, or raise."""
    pinhole = np.ascontiguousarray(params, np.float64)
    if pinhole.shape != (4,):
        raise ShapeError(f"pinhole must be (fx, fy, cx, cy); got shape {pinhole.shape}. Undistort the image first.")
    if not (np.isfinite(pinhole).all() and (pinhole[:2] > 0).all()):
        raise InputError(f"pinhole must be finite, with positive focal lengths; got {pinhole.tolist()}.")
    return pinhole
