# SPDX-License-Identifier: BSD-3-Clause
"""Initial calibrations of photographs, from EXIF or by a default."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from groma import cameras as camera_models
from groma._typing import IntArray
from groma.errors import InputError
from groma.io.colmap.load import load_pycolmap, quiet
from groma.scene import Cameras


def cameras_of_photographs(
    images: Path, names: Sequence[str], model: str, params: tuple[float, ...] | None = None
) -> tuple[Cameras, IntArray]:
    """Return cameras and which each photograph has: one for each size and each camera that EXIF names.

    Parameters
    ----------
    images : Path
        Folder of the photographs.
    names : sequence of str
        The photographs.
    model : str
        A camera model of COLMAP's.
    params : tuple of float, optional
        Parameters, if they are known; else the focal length is EXIF's, or 1.2 times the longer side.

    Raises
    ------
    InputError
        If a photograph cannot be read, or parameters are given for photographs of several sizes.
    """
    pycolmap = load_pycolmap()
    options = pycolmap.ImageReaderOptions()
    options.camera_model = camera_models.model(model).colmap_name
    cameras: dict[tuple[object, ...], tuple[int, int, list[float]]] = {}
    keys = []
    with quiet(pycolmap):
        for name in names:
            bitmap = pycolmap.Bitmap.read(str(images / name), False)
            if bitmap is None:
                raise InputError(f"{images / name} cannot be read by pycolmap. Convert it to JPEG or PNG.")
            kind = None if params is not None else bitmap.exif_camera_model()
            key = (bitmap.width, bitmap.height, kind)
            if key not in cameras:
                found = pycolmap.infer_camera_from_image(str(images / name), options)
                cameras[key] = (bitmap.width, bitmap.height, list(found.params if params is None else params))
            keys.append(key)
    if params is not None and len(cameras) > 1:
        sizes = ", ".join(sorted(f"{key[0]}x{key[1]}" for key in cameras))
        raise InputError(
            f"One set of camera parameters was given, but the photographs have the sizes {sizes}. Leave the parameters "
            "out, or map the photographs of one camera."
        )
    row_of = {key: row for row, key in enumerate(cameras)}
    table = Cameras.of(
        ids=np.arange(len(cameras)) + 1,
        models=[camera_models.model(model).name] * len(cameras),
        params=[one[2] for one in cameras.values()],
        sizes=[one[:2] for one in cameras.values()],
    )
    return table, np.array([row_of[key] for key in keys], np.int64)
