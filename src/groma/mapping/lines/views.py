# SPDX-License-Identifier: BSD-3-Clause
r"""Segments of all images as one table, with the rays, lines and depths that mapping needs.

Pixels are undistorted once, here: an image is then a pinhole camera :math:`P = K [R\,|\,t]`, and a segment has two rays
:math:`f = R^\top K^{-1} [u, v, 1]^\top`, so that :math:`X = c + z f = c + f/q` lies at depth z, inverse depth q.
Along a segment of a straight line q is affine in the pixel, which is why everything is done in inverse depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from groma import cameras as camera_models
from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry import quaternion, segment2
from groma.scene import Scene

if TYPE_CHECKING:
    from groma.features.segments import Segments

#: Points asked for around each end and the middle of a segment.
_NUM_NEAR = 6


@dataclass(frozen=True, eq=False)
class LineViews:
    """Images and their segments. Rows of image i are ``pointers[i] : pointers[i + 1]``."""

    #: (C, 3, 4) pinhole cameras, pixels from world.
    camera: FloatArray
    #: (C, 3) camera centres.
    center: FloatArray
    #: (C, 2) least and largest inverse depth of the points seen; NaN where none are.
    inverse_depth: FloatArray
    #: (C + 1,) rows of each image.
    pointers: IntArray
    #: (S,) image of each segment.
    image_idx: IntArray
    #: (S, 4) undistorted end points, pixels; zero where not usable.
    ends: FloatArray
    #: (S,) standard deviation across the line, pixels, at each end point, with the floor for poses and cameras.
    sigma: FloatArray
    #: (S, 3) image lines with unit normal.
    line: FloatArray
    #: (S, 2, 3) rays of the end points in the world, one unit of depth long.
    ray: FloatArray
    #: (S, 3) change of the ray for one pixel across the segment.
    across: FloatArray
    #: (S, 2) range of inverse depths searched.
    range: FloatArray
    #: (S,) length, pixels.
    length: FloatArray
    #: (S,) whether the segment can be used at all: long enough, and the camera can undo its distortion there.
    usable: BoolArray

    def rows(self, image: int) -> slice:
        """Rows of an image."""
        return slice(int(self.pointers[image]), int(self.pointers[image + 1]))


def build_views(
    scene: Scene, segments: Sequence[Segments], min_length: float, noise: float, depth_margin: float
) -> LineViews:
    """Undistort the segments of all images and find where to look for them in depth.

    Parameters
    ----------
    scene : Scene
        Cameras, poses, points and their observations.
    segments : sequence of C Segments
        By image of the scene.
    min_length : float
        Shorter segments are not usable; pixels.
    noise : float
        Added in quadrature to the segments' own sigma; pixels.
    depth_margin : float
        Factor by which the depth range of the points near a segment is widened at both sides.
    """
    count = scene.num_images
    poses = scene.cam_from_world
    rotation, centers = quaternion.to_matrix(poses[:, :4]), scene.cam_centers_in_world
    sizes = [len(item.ends) for item in segments]
    pointers = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    total = int(pointers[-1])
    camera, depths = np.zeros((count, 3, 4)), np.full((count, 2), np.nan)
    ends, ray, across = np.zeros((total, 4)), np.zeros((total, 2, 3)), np.zeros((total, 3))
    sigma, search = np.ones(total), np.zeros((total, 2))
    usable, lengths = np.zeros(total, bool), np.zeros(total)
    by_image = np.argsort(scene.point_observations.image_idx, kind="stable")
    starts = np.searchsorted(scene.point_observations.image_idx[by_image], np.arange(count + 1))
    for i in range(count):
        rows = slice(pointers[i], pointers[i + 1])
        which = scene.images.camera_idx[i]
        model, params = camera_models.model(scene.cameras.models[which]), scene.cameras.params_of(which)
        K = model.camera_matrix(params)
        camera[i] = K @ np.column_stack([rotation[i], poses[i, 4:]])
        straight = model.undistort_pixels(params, segments[i].ends.reshape(-1, 2)).reshape(-1, 4)
        length = np.where(np.isfinite(straight).all(1), segment2.length(straight), 0.0)
        good = length >= min_length
        straight[~good] = 0.0
        to_ray = rotation[i].T @ np.linalg.inv(K)
        pixel = np.ones((len(straight), 2, 3))
        pixel[:, :, :2] = straight.reshape(-1, 2, 2)
        normal = np.zeros((len(straight), 3))
        normal[:, :2] = segment2.to_line(straight)[:, :2]
        ends[rows], usable[rows], lengths[rows] = straight, good, length
        ray[rows], across[rows] = pixel @ to_ray.T, normal @ to_ray.T
        sigma[rows] = np.hypot(segments[i].sigma, noise)
        seen = by_image[starts[i] : starts[i + 1]]
        xyz = scene.points.xyz[scene.point_observations.point_idx[seen]]
        depth = xyz @ rotation[i, 2] + poses[i, 6]
        xyz, depth = xyz[depth > 0], depth[depth > 0]
        if len(depth):
            pixel = (xyz @ camera[i, :2, :3].T + camera[i, :2, 3]) / depth[:, None]
            inverse = 1.0 / depth
            low, high = np.quantile(inverse, [0.01, 0.99])
            depths[i] = low / depth_margin, high * depth_margin
            search[rows] = _range_near(straight, pixel, inverse, depth_margin)
        elif count > 1:
            nearest = np.sort(np.linalg.norm(centers - centers[i], axis=1))[1 : 1 + min(5, count - 1)].mean()
            depths[i] = search[rows] = 1e-3 / max(nearest, 1e-12), 2.0 / max(nearest, 1e-12)
    image_idx = np.repeat(np.arange(count), sizes)
    line = segment2.to_line(ends)
    return LineViews(
        camera, centers, depths, pointers, image_idx, ends, sigma, line, ray, across, search, lengths, usable
    )


def _range_near(ends: FloatArray, pixel: FloatArray, inverse: FloatArray, margin: float) -> FloatArray:
    """Range of the inverse depths of the points around each segment, widened by the margin."""
    if len(ends) == 0:
        return np.zeros((0, 2))
    first, second = ends[:, :2], ends[:, 2:]
    places = np.stack([first, 0.5 * (first + second), second], axis=1)
    near = min(_NUM_NEAR, len(pixel))
    found = KDTree(pixel).query(places.reshape(-1, 2), k=near)[1].reshape(len(ends), -1)
    values = inverse[found]
    return np.column_stack([values.min(1) / margin, values.max(1) * margin])
