# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a page: found by name, read at reduced size, written as data URLs."""

from __future__ import annotations

import base64
import json
import os
import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from groma._counted import counted
from groma._typing import IntArray
from groma.bounded.images import decoded
from groma.bounded.names import outside, stays_inside
from groma.bounded.text import read_text
from groma.errors import FileFormatError
from groma.io.survey.exif import quarter_turns

Picture = npt.NDArray[np.uint8]
#: A folder of images, or image files by the names that the scene gives them.
ImageFiles = str | os.PathLike[str] | Mapping[str, str | os.PathLike[str]]
#: Of JPEG (cost: bytes of a page).
_QUALITY = 78


def image_file(images: ImageFiles | None, name: str) -> Path | None:
    """Return the file of an image; None if there is none, or if the name leads out of the folder."""
    if images is None:
        return None
    if isinstance(images, Mapping):
        path = Path(images[name]) if name in images else None
    else:
        path = Path(images) / name if stays_inside(name) else None
    return path if path is not None and path.is_file() else None


def turns_of(images: ImageFiles | None, names: Iterable[str]) -> IntArray:
    """Return the quarter turns to the right (N,) that show photographs upright; 0 for none."""
    files = (image_file(images, name) for name in names)
    return np.array([0 if file is None else quarter_turns(file) for file in files], np.int64)


def folder_of_images(model: str | os.PathLike[str], names: Iterable[str]) -> Path | None:
    """Return the folder of the photographs of a model, searched near the model; None if there is none.

    Parameters
    ----------
    model : path
        A folder or file of a model. Searched in order: the folder named in its ``summary.json``, which ``groma map``
        writes; ``images`` in the model, beside it, and one and two folders higher, as in COLMAP's projects; the folder
        itself or that of the file, relative to which ``transforms.json`` names images.
    names : iterable of str
        Names of the images; the folder holds one of the first hundred at least.
    """
    place, wanted = Path(model).absolute(), [name for name, _ in zip(names, range(100), strict=False)]
    tried = [*(parent / "images" for parent in (place, *place.parents[:3])), place, place.parent]
    try:
        numbers = json.loads(read_text(place / "summary.json"))
        if isinstance(numbers, dict) and isinstance(numbers.get("images"), str):
            tried = [Path(numbers["images"]), place / numbers["images"], *tried]
    except (OSError, ValueError, RecursionError, FileFormatError):
        pass
    return next((one for one in tried if any(image_file(one, name) for name in wanted)), None)


def warn_of_names_outside(images: ImageFiles | None, names: Iterable[str]) -> None:
    """Warn of images that are left out because their names lead out of the folder of photographs."""
    if images is None or isinstance(images, Mapping):
        return
    if wrong := outside(names):
        shown = ", ".join(repr(name[:200]) for name in wrong[:3]) + (", ..." if len(wrong) > 3 else "")
        number = counted(len(wrong), "images")
        warnings.warn(
            f"{number} of the scene not shown: names lead out of {os.fspath(images)} ({shown}). "
            "Rename them, or link to them from the folder.",
            stacklevel=3,
        )


def read_picture(path: str | os.PathLike[str], max_size: int | None = None) -> Picture | None:
    """Return an image file as red, green, blue, at most ``max_size`` pixels on its longer side; None if unreadable.

    The EXIF orientation is ignored: pixel coordinates refer to the stored image.
    """
    import cv2

    try:
        picture = decoded(Path(path).read_bytes(), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    except (OSError, FileFormatError):
        return None
    if picture is None:
        return None
    scale = 1.0 if max_size is None else max_size / max(picture.shape[:2])
    if scale < 1.0:
        picture = _smaller(picture, scale)
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), np.uint8)


def data_address(picture: Picture) -> str:
    """Return a picture as a data URL of a JPEG."""
    import cv2

    colours = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
    encoded = cv2.imencode(".jpg", colours, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()


def jpeg_address(picture: Picture, budget: int) -> str:
    """Return a picture as a data URL of at most about ``budget`` characters, scaled down until it fits."""
    address = data_address(picture)
    for _ in range(4):
        if len(address) <= budget:
            break
        # A smaller picture has more detail in each pixel, so the bytes fall slower than the area.
        picture = _smaller(picture, max(0.9 * (budget / len(address)) ** 0.55, 0.2))
        address = data_address(picture)
    return address


def _smaller(picture: Picture, scale: float) -> Picture:
    """Return a picture at a scale below one; from one half on, bilinear interpolation uses every pixel."""
    import cv2

    size = [max(1, round(scale * side)) for side in picture.shape[1::-1]]
    how = cv2.INTER_LINEAR if scale >= 0.5 else cv2.INTER_AREA  # which takes fifteen times as long
    return np.asarray(cv2.resize(picture, size, interpolation=how), np.uint8)
