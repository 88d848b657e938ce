# SPDX-License-Identifier: BSD-3-Clause
r"""Cameras of Gaussian splats: the ``cameras.json`` that 3D Gaussian Splatting and its successors write beside them.

A list, one entry a photograph: ``img_name``, perhaps without its ending; ``width``, ``height``, ``fx`` and ``fy`` in
pixels; ``rotation``, the matrix :math:`R_{wc}` row by row; ``position``, the camera centre. Axes are ours. There is no
principal point: splats are rendered as if it were the middle of the image.

Reference: B. Kerbl, G. Kopanas, T. Leimkuehler, G. Drettakis, *3D Gaussian Splatting for Real-Time Radiance Field
Rendering*, 2023, and its implementation.
"""

from __future__ import annotations

import os

import numpy as np

from groma.bounded.documents import member, names_early, number, of_kind, read_document, size, table
from groma.bounded.names import existing
from groma.errors import FileFormatError
from groma.io.interchange.calibration import Calibration, camera_table, shared
from groma.io.interchange.poses import rigid
from groma.io.pose_conventions import SPLATS
from groma.io.reading import reading
from groma.io.registry import SceneFormat, register_format
from groma.scene import Scene


def read_splats(path: str | os.PathLike[str]) -> Scene:
    """Read the cameras and poses of a ``cameras.json``.

    Raises
    ------
    FileFormatError
        If it is damaged, a matrix is no rotation, or two cameras have the same name.
    """
    place = existing(path)
    with reading(place, "file of the cameras of splats"):
        entries, names, calibrations = of_kind(read_document(place), list, place), [], []
        for row, entry in enumerate(entries, 1):
            where = f"{place}, camera {row}"
            names.append(member(of_kind(entry, dict, where), "img_name", str, where))
            extent = size(entry, ("width", "height"), where)
            focal = (number(entry, "fx", where), number(entry, "fy", where))
            calibrations.append(Calibration("PINHOLE", (*focal, extent[0] / 2, extent[1] / 2), extent))
        if not all(names) or len(set(names)) < len(names):
            raise FileFormatError(f"{place}: expected a different 'img_name' for each camera. Correct the file.")
        cameras, camera_idx = shared(calibrations)
        rotation = table([entry.get("rotation") for entry in entries], (3, 3), f"{place}, rotation")
        center = table([entry.get("position") for entry in entries], (3,), f"{place}, position")
        poses = rigid(rotation, center, place, SPLATS)
        return Scene.from_images(camera_table(cameras, place), names, np.array(camera_idx, np.int64), poses)


register_format(
    SceneFormat(
        "splats",
        source="the cameras.json of Gaussian splats",
        recognise=lambda path, head: path.is_file() and names_early(path, head, b"[", "img_name"),
        read=read_splats,
    )
)
