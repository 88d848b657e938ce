# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of 2D points within their images, as a COLMAP model has them."""

from __future__ import annotations

import numpy as np

from groma._typing import IntArray
from groma.scene import Scene


def numbered_keypoints(scene: Scene) -> tuple[IntArray, IntArray, IntArray]:
    """Return how the 2D points of a scene are numbered in a COLMAP model: 0, 1, 2, ... in each image.

    Where the numbers in the scene have gaps (after a subset) they close up.

    Returns
    -------
    order : (n,) int
        The rows of point observations followed by keypoints, image by image.
    ends : (N + 1,) int
        Bounds of the images in ``order``.
    number : (n,) int
        The number of each row.
    """
    tables = (scene.point_observations, scene.keypoints)
    image_idx = np.concatenate([table.image_idx for table in tables])
    order = np.lexsort((np.concatenate([table.keypoint_idx for table in tables]), image_idx))
    ends = np.searchsorted(image_idx[order], np.arange(scene.num_images + 1))
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order)) - ends[image_idx[order]]
    return order, ends, number
