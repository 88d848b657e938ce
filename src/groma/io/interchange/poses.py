# SPDX-License-Identifier: BSD-3-Clause
"""Rotations and points as other programs write them, brought to ours."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.bounded.content import READING
from groma.bounded.images import image_size
from groma.bounded.names import stays_inside
from groma.errors import FileFormatError
from groma.io.pose_conventions import PoseConvention
from groma.scene import Points

#: Largest deviation of a rotation matrix from an orthonormal one: files hold three digits at least (derived from those
#: digits).
_ROTATION_SLIP = 5e-3
#: Coordinates beyond this are no places; their squares leave the number range.
_LARGEST = 1e100
#: Bytes of a photograph that are searched for its size first (cost: time only).
_HEADER_BYTES = 1 << 17


def rigid(rotation: FloatArray, place: FloatArray, path: object, convention: PoseConvention) -> FloatArray:
    """Return poses (N, 7) of rotation matrices (N, 3, 3) and places (N, 3), as files of a kind hold them.

    The nearest rotations are taken.

    Raises
    ------
    FileFormatError
        If a matrix is no rotation, or turns a right hand into a left one.
    """
    if not len(rotation):
        return np.zeros((0, 7))
    if max(np.abs(rotation).max(), np.abs(place).max()) > _LARGEST:
        raise FileFormatError(f"{path}: the numbers of a pose are too large. Correct the file.")
    left, scale, right = np.linalg.svd(rotation)
    nearest = left @ right
    off = np.abs(scale - 1.0).max(axis=1)
    if off.max() > _ROTATION_SLIP:
        row = int(off.argmax())
        raise FileFormatError(
            f"{path}: expected rotation matrices; that of image {row + 1} stretches by {scale[row].tolist()}. "
            "Divide it by its scale."
        )
    mirrors = np.linalg.det(nearest) < 0.0
    if mirrors.any():
        raise FileFormatError(
            f"{path}: expected right-handed axes; the matrix of image {int(mirrors.argmax()) + 1} mirrors. Turn the "
            "sign of one axis."
        )
    return convention.cam_from_world(nearest, place)


def points_table(ids: Sequence[int] | IntArray, xyz: FloatArray, color: FloatArray, path: object) -> Points:
    """Return points; colours are rounded and cut to bytes."""
    if len(xyz) and np.abs(xyz).max() > _LARGEST:
        raise FileFormatError(f"{path}: the coordinates of a point are too large. Correct the file.")
    numbers = np.array(ids, np.int64)
    if len(np.unique(numbers)) != len(numbers):
        raise FileFormatError(f"{path}: two points have the same identifier. Correct the file.")
    shades = np.clip(np.round(color), 0, 255).astype(np.uint8)
    return Points(numbers, xyz, shades, np.full(len(numbers), -1.0))


def checked_rows(index: IntArray, count: int, path: object) -> IntArray:
    """Return references to images as they are, or raise FileFormatError where one is to nothing."""
    if len(index) and (index.min() < 0 or index.max() >= count):
        wrong = int(index[(index < 0) | (index >= count)][0])
        raise FileFormatError(f"{path}: an observation names image {wrong}, but there are {count} images.")
    return index


def file_in(place: Path, name: str) -> Path:
    """Return the file of a usual name in a folder, or the file itself."""
    return place / name if place.is_dir() else place


def size_of_image(folder: Path, name: str) -> tuple[int, int]:
    """Return width and height of a photograph in a folder, from its header; (0, 0) if there is none to read.

    A name that leaves the folder is not followed.
    """
    if not stays_inside(name):
        return 0, 0
    try:
        with (folder / name).open("rb") as file:
            head = file.read(_HEADER_BYTES)
            found = image_size(head) or image_size(head + file.read(READING.pipe))
    except OSError:
        return 0, 0
    return found if found is not None and 0 < min(found) and max(found) <= 10**6 else (0, 0)
