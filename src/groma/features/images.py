# SPDX-License-Identifier: BSD-3-Clause
"""What the front-end accepts as an image: grey 8 bit, made from what callers have."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from groma.errors import InputError, ShapeError
from groma.gates import gate

GrayImage = npt.NDArray[np.uint8]
#: Grey levels (H, W), smoothed.
SmoothImage = npt.NDArray[np.float32]

#: Smaller images show no segment, pixels: a detector needs a few gradients (derived from their support).
MIN_SIDE = 8
#: Largest level in the format of 12 bits.
_FULL_12_BITS = 4095


@dataclass(frozen=True)
class ImageGates:
    """What grey levels are taken to be."""

    noise: float = gate(2.0, "grey levels", "noise of a pixel", "convention: a photograph of 8 bits in good light")
    blur: float = gate(0.8, "px", "of images that are measured", "derived from cubic interpolation: exact to 0.01 px")


#: The numbers in use.
IMAGES = ImageGates()


def smoothed(image: GrayImage) -> SmoothImage:
    """Return a grey image (H, W) as edges and patches are measured in it, with less noise."""
    levels = image.astype(np.float32)
    return np.asarray(cv2.GaussianBlur(levels, (0, 0), IMAGES.blur, borderType=cv2.BORDER_REPLICATE), np.float32)


def to_gray(image: npt.NDArray[np.generic]) -> GrayImage:
    """Grey 8-bit image (H, W), contiguous.

    Parameters
    ----------
    image : (H, W), (H, W, 1), (H, W, 3) or (H, W, 4) uint8, uint16, bool or float
        Grey, or colour in OpenCV's order blue, green, red (, alpha). Floats are grey levels from 0 to 1 where nothing
        exceeds 1, otherwise 0 to 255; 16 bits are divided by 257, or, where nothing exceeds 12 bits, as many cameras
        store them, taken as 12.

    Raises
    ------
    ShapeError
        If it is not an image of at least one pixel.
    InputError
        If its numbers are of another type or not finite.
    """
    image = np.asarray(image)
    if image.ndim not in (2, 3) or 0 in image.shape or (image.ndim == 3 and image.shape[2] not in (1, 3, 4)):
        raise ShapeError(
            f"image must have shape (H, W) or (H, W, 3), at least one pixel; got {image.shape}. "
            "Did the file open? cv2.imread gives None for files it cannot read."
        )
    if image.dtype == np.bool_:
        image = image.astype(np.uint8) * 255
    elif image.dtype == np.uint16:
        full = _FULL_12_BITS if image.max() <= _FULL_12_BITS else 65535
        levels = np.round(np.arange(full + 1) * (255.0 / full)).astype(np.uint8)
        image = levels[np.asarray(image, np.uint16)]
    elif np.issubdtype(image.dtype, np.floating):
        levels = image.astype(np.float64)
        if not np.isfinite(levels).all():
            raise InputError("image must be finite; got NaN or infinity. Replace them, e.g. with numpy.nan_to_num.")
        image = np.clip(np.round(levels * (255.0 if levels.max() <= 1.0 else 1.0)), 0, 255).astype(np.uint8)
    elif image.dtype != np.uint8:
        raise InputError(f"image must be uint8, uint16, bool or float; got {image.dtype}. Convert it with astype.")
    if image.ndim == 3:
        if image.shape[2] == 1:
            image = image[..., 0]
        else:
            code = cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
            image = cv2.cvtColor(np.ascontiguousarray(image, dtype=np.uint8), code)
    return np.ascontiguousarray(image, dtype=np.uint8)


def one_opencv_thread() -> None:
    """Let OpenCV work in the calling thread from now on.

    Where photographs, or the work on a frame, are shared out among threads, OpenCV's own would come on top of them.
    """
    cv2.setNumThreads(1)
