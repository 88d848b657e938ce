# SPDX-License-Identifier: BSD-3-Clause
"""Images of one value or of blobs at projected points, for folders of sequences."""

import cv2
import numpy as np

from groma.geometry import quaternion
from groma.io import Trajectory

SIZE = (64, 48)


def image(path, value, size=SIZE, dtype=np.uint8):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((size[1], size[0]), value, dtype))


def straight(times):
    """A trajectory along z."""
    count = len(times)
    return Trajectory(
        np.asarray(times, float), np.hstack([np.tile([0, 0, 0, 1.0, 0, 0], (count, 1)), np.arange(count)[:, None]])
    )


def values(sequence):
    """The grey value of each frame."""
    return [int(frame.gray[0, 0]) for frame in sequence]


def blob_image(pixels, size):
    """Bright Gaussian blobs at pixels (first pixel's centre at 0.5, 0.5)."""
    u, v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    total = sum(np.exp(-((u - a) ** 2 + (v - b) ** 2) / (2 * 2.0**2)) for a, b in pixels)
    return np.clip(200 * total, 0, 255).astype(np.uint8)


def blob_center(gray, near, radius=7):
    """Centre of the blob nearest to a pixel."""
    u0, v0 = int(near[0]), int(near[1])
    patch = gray[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1].astype(float)
    v, u = np.mgrid[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1] + 0.5
    return np.array([(patch * u).sum(), (patch * v).sum()]) / patch.sum()


POINTS = np.array([[-0.5, -0.3, 2.0], [0.4, -0.25, 1.8], [0.1, 0.3, 2.5], [-0.3, 0.25, 2.2], [0.5, 0.35, 2.4]])


def pose(rotation_vector, translation):
    matrix = np.eye(4)
    matrix[:3, :3] = quaternion.to_matrix(quaternion.exp(np.array(rotation_vector, float)))
    matrix[:3, 3] = translation
    return matrix
