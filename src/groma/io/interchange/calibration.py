# SPDX-License-Identifier: BSD-3-Clause
r"""Which camera model holds the lens of another program.

Lenses come as focal lengths, principal point and coefficients, in pixels of ours: the centre of the first pixel is
(0.5, 0.5). The smallest model of COLMAP that holds them exactly is taken.

**The inverse polynomial** of VisualSFM goes from distorted to undistorted, :math:`x' = x_d\,(1 + r\,\|x_d\|^2)`. The
other way :math:`x_d = g\,x'` with a function :math:`g` of :math:`s = \|x'\|^2`. Places :math:`x_d` within the image
give pairs of g and s, and linear least squares the rational function of FULL_OPENCV through them,

.. math:: 1 + k_1 s + k_2 s^2 + k_3 s^3 = g\,(1 + k_4 s + k_5 s^2 + k_6 s^3) .
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma import cameras as camera_models
from groma.errors import FileFormatError
from groma.scene import Cameras

_Pair = tuple[float, float]
#: Largest difference between the inverse polynomial and the model that stands for it, pixels (convention: below
#: what is measured).
SLIP_PX = 0.01


@dataclass(frozen=True)
class Calibration:
    """A camera: its model by our name, the parameters, and the size of its images (0 where unknown)."""

    model: str
    params: tuple[float, ...]
    size: tuple[int, int] = (0, 0)


def polynomial(
    focal: _Pair, center: _Pair, radial: Sequence[float], tangential: _Pair | None, size: tuple[int, int]
) -> Calibration:
    """Return a perspective camera with coefficients k1, k2, ... and (p1, p2), in the order and sense of OpenCV.

    Trailing coefficients that are given but zero are kept where the model has them, so that they can be estimated;
    k3 is not, because the model with k3 has three more.
    """
    radial = list(radial)
    while len(radial) > 2 and radial[-1] == 0.0:
        radial.pop()
    if len(radial) > 3:
        raise FileFormatError(f"a perspective lens with k4 = {radial[3]:g} is not known; expected k1 to k3")
    k1, k2, k3 = [*radial, 0.0, 0.0, 0.0][:3]
    p1, p2 = tangential or (0.0, 0.0)
    if k3:
        return Calibration("FULL_OPENCV", (*focal, *center, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0), size)
    if tangential is not None or (focal[0] != focal[1] and any(radial)):
        return Calibration("OPENCV", (*focal, *center, k1, k2, p1, p2), size)
    if focal[0] != focal[1]:
        return Calibration("PINHOLE", (*focal, *center), size)
    name = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")[len(radial)]
    return Calibration(name, (focal[0], *center, *radial), size)


def fisheye(focal: _Pair, center: _Pair, radial: Sequence[float], size: tuple[int, int]) -> Calibration:
    """Return an equidistant fisheye with up to four coefficients of odd powers of the angle."""
    if len(radial) > 2 or focal[0] != focal[1]:
        return Calibration("OPENCV_FISHEYE", (*focal, *center, *[*radial, 0.0, 0.0, 0.0, 0.0][:4]), size)
    name = ("SIMPLE_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")[len(radial)]
    return Calibration(name, (focal[0], *center, *radial), size)


def panorama(size: tuple[int, int]) -> Calibration:
    """Return a 360-degree camera whose pixels are as high as wide; FileFormatError unless width = 2 height."""
    if size[0] != 2 * size[1]:
        raise FileFormatError(f"expected a panorama twice as wide as high; got {size[0]}x{size[1]}. Crop or pad it")
    return Calibration("EQUIRECTANGULAR", (float(size[0]), float(size[1])), size)


def inverse_polynomial(
    focal: float, center: _Pair, coefficient: float, reach: float, size: tuple[int, int]
) -> Calibration:
    """Return the camera of VisualSFM, distorted by the inverse polynomial; see the module.

    Parameters
    ----------
    focal, center : float, (float, float)
        Pixels.
    coefficient : float
        r, for pixels divided by the focal length.
    reach : float
        Radius of the image that is used, in focal lengths.
    size : (int, int)
        Width and height, pixels.

    Raises
    ------
    FileFormatError
        If the image folds within its reach, or the model does not hold the distortion to ``SLIP_PX``.
    """
    if coefficient == 0.0 or reach == 0.0:
        return Calibration("SIMPLE_PINHOLE", (focal, *center), size)
    squared = (reach * np.linspace(0.0, 1.0, 200)) ** 2
    stretch = 1.0 + coefficient * squared
    ray = squared * stretch**2
    unit = ray[-1]
    powers = (ray / unit)[:, None] ** np.arange(1, 4)
    found = np.linalg.lstsq(np.hstack([powers, -powers / stretch[:, None]]), 1.0 / stretch - 1.0, rcond=1e-13)[0]
    ratio = (1.0 + powers @ found[:3]) / (1.0 + powers @ found[3:])
    slip = focal * float((np.sqrt(ray) * np.abs(ratio - 1.0 / stretch)).max())
    # derived from the derivative of coefficient * r^3
    if not (1.0 + 3.0 * coefficient * squared > 0.0).all() or not slip <= SLIP_PX:
        raise FileFormatError(
            f"a lens with the distortion {coefficient:g} folds the image within the {reach:.2g} focal lengths that are "
            "used. Leave the image out, or undistort it"
        )
    k1, k2, k3, k4, k5, k6 = (found / unit ** np.array([1, 2, 3, 1, 2, 3])).tolist()
    return Calibration("FULL_OPENCV", (focal, focal, *center, k1, k2, 0.0, 0.0, k3, k4, k5, k6), size)


def camera_table(calibrations: Sequence[Calibration], path: object) -> Cameras:
    """Return calibrations as a table with identifiers 1, 2, ...; FileFormatError if a focal length is not positive."""
    for row, one in enumerate(calibrations):
        if any(not one.params[index] > 0.0 for index in camera_models.model(one.model).focal_indices):
            raise FileFormatError(f"{path}: expected positive focal lengths; camera {row + 1} has {one.params[:2]}.")
    if not all(math.isfinite(value) for one in calibrations for value in one.params):
        raise FileFormatError(f"{path}: the numbers of a camera are too large. Correct the file.")
    return Cameras.of(
        ids=np.arange(len(calibrations)) + 1,
        models=[one.model for one in calibrations],
        params=[one.params for one in calibrations],
        sizes=[one.size for one in calibrations],
    )


def shared(calibrations: Sequence[Calibration]) -> tuple[list[Calibration], list[int]]:
    """Return calibrations without repetition, and the row of each of those given."""
    rows: dict[Calibration, int] = {}
    index = [rows.setdefault(one, len(rows)) for one in calibrations]
    return list(rows), index
