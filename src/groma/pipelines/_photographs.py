# SPDX-License-Identifier: BSD-3-Clause
"""The folder of photographs: which files there are, how they are read, whether they fit their cameras."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from groma.errors import InputError
from groma.scene import Scene

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")


def image_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder of images. Check the path.")
    files = sorted(path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES)
    if not files:
        raise InputError(f"{folder} holds no images ({', '.join(IMAGE_SUFFIXES)}). Check the path.")
    return files


def read_gray(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise InputError(f"{path} cannot be read as an image. Replace it, or leave it out of the model.")
    return image


def check_images(folder: Path, scene: Scene) -> None:
    """Check that every image can be read and has the size of its camera."""
    for i, name in enumerate(scene.images.names):
        camera = scene.images.camera_idx[i]
        size = (int(scene.cameras.width[camera]), int(scene.cameras.height[camera]))
        image = read_gray(folder / name)
        if size != (0, 0) and (image.shape[1], image.shape[0]) != size:
            raise InputError(
                f"{folder / name} has {image.shape[1]}x{image.shape[0]} pixels, its camera {size[0]}x{size[1]}. "
                "Pass the images the model was made from."
            )
