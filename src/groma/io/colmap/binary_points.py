# SPDX-License-Identifier: BSD-3-Clause
"""The points of a binary COLMAP model, read and written as arrays.

pycolmap takes points one by one, each as an object with one more for every image that sees it: most of the time of
writing a model, during which nothing else can be done in Python. A model is therefore written without points, and they
are added to its files.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from groma._typing import IntArray
from groma.io._numbering import numbered_keypoints
from groma.io.colmap.files import points_within
from groma.scene import Scene

#: What stands before the track of a point, and one image in it: the format of COLMAP.
POINT_IN_SPACE = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("length", "<u8")])
_ELEMENT = np.dtype([("image", "<u4"), ("point2D", "<u4")])


def write_points(scene: Scene, folder: Path) -> None:
    """Add the points of a scene to the binary model that was written without them: all else is there."""
    seen = scene.point_observations
    number = numbered_keypoints(scene)[2][: len(seen)]
    (folder / "points3D.bin").write_bytes(_points_file(scene, number))
    owner = scene.points.ids[seen.point_idx]
    order = np.argsort(seen.image_idx, kind="stable")
    ends = np.searchsorted(seen.image_idx[order], np.arange(scene.num_images + 1))
    images = bytearray((folder / "images.bin").read_bytes())
    of_image = points_within(images)
    for row, image in enumerate(scene.images.ids.tolist()):
        mine = order[ends[row] : ends[row + 1]]
        of_image[image]["point"][number[mine]] = owner[mine]
    del of_image  # they are views of the bytes
    (folder / "images.bin").write_bytes(images)


def _points_file(scene: Scene, number: IntArray) -> bytes:
    """Return ``points3D.bin``; ``number`` is that of each observation within its image."""
    seen, points = scene.point_observations, scene.points
    order = np.lexsort((number, seen.image_idx, seen.point_idx))
    length = np.bincount(seen.point_idx, minlength=len(points))
    heads = np.zeros(len(points), POINT_IN_SPACE)
    heads["id"], heads["xyz"], heads["color"] = points.ids, points.xyz, points.color
    heads["error"], heads["length"] = points.error, length
    elements = np.zeros(len(order), _ELEMENT)
    elements["image"], elements["point2D"] = scene.images.ids[seen.image_idx[order]], number[order]
    size = POINT_IN_SPACE.itemsize + _ELEMENT.itemsize * length
    begin = 8 + np.cumsum(size) - size
    content = np.zeros(8 + int(size.sum()), np.uint8)
    content[:8] = np.frombuffer(np.array(len(points), "<u8").tobytes(), np.uint8)
    content[begin[:, None] + np.arange(POINT_IN_SPACE.itemsize)] = heads.view(np.uint8).reshape(
        -1, POINT_IN_SPACE.itemsize
    )
    first = np.cumsum(length) - length  # of each point among the elements
    place = np.repeat(begin + POINT_IN_SPACE.itemsize - _ELEMENT.itemsize * first, length)
    place += _ELEMENT.itemsize * np.arange(len(order))
    content[place[:, None] + np.arange(_ELEMENT.itemsize)] = elements.view(np.uint8).reshape(-1, _ELEMENT.itemsize)
    return content.tobytes()


def points_in_space(path: Path) -> np.ndarray:
    """Return the points (P,) of a checked ``points3D.bin`` by their identifiers: ``id``, ``xyz``, ``color``, ``error``.

    pycolmap gives them one by one.
    """
    data, begin, at = path.read_bytes(), [], 8
    length = struct.Struct("<Q").unpack_from
    for _ in range(length(data)[0]):
        begin.append(at)
        at += POINT_IN_SPACE.itemsize + _ELEMENT.itemsize * length(data, at + POINT_IN_SPACE.itemsize - 8)[0]
    places = np.array(begin, np.int64)[:, None] + np.arange(POINT_IN_SPACE.itemsize)
    found = np.frombuffer(data, np.uint8)[places].view(POINT_IN_SPACE)[:, 0]
    return found[np.argsort(found["id"])]
