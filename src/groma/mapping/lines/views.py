# SPDX-License-Identifier: BSD-3-Clause
r"""The segments of all images as one table, with their rays, image lines and depth ranges.

Pixels are undistorted here, once. An image is then a pinhole camera :math:`P = K [R\,|\,t]`, and a segment has two rays
:math:`f = R^\top K^{-1} [u, v, 1]^\top`, so that :math:`X = c + z f = c + f/q` lies at depth z, inverse depth q.
Along the image of a straight line q is an affine function of the pixel; mapping therefore works with inverse depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from groma import cameras as camera_models
from groma._rows import pointers_of
from groma._trees import kd_tree, nearest
from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_in_threads, map_work
from groma.features.segments import Segments
from groma.gates import LINE_MAPS, gate
from groma.geometry import quaternion, segment2
from groma.mapping.groups import grouped
from groma.scene import Scene


@dataclass(frozen=True)
class ViewGates:
    """Where segments are looked for in depth."""

    num_near: int = gate(6, "points", "at ends and middle of a segment that tell its depth", LINE_MAPS)
    depth_quantile: float = gate(0.01, "quantile", "of inverse depths in an image, at either end", LINE_MAPS)
    num_baselines: int = gate(5, "images", "nearest cameras that tell the scale without points", LINE_MAPS)
    inverse_depth_range: tuple[float, float] = gate((1e-3, 2.0), "1/baseline", "searched without points", LINE_MAPS)


GATES = ViewGates()


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

    def usable_rows(self, image: int) -> IntArray:
        """Rows of the usable segments of an image."""
        rows = self.rows(image)
        return rows.start + np.flatnonzero(self.usable[rows])


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
    camera = _cameras(scene)
    by_image, starts = grouped(scene.point_observations.image_idx, count)

    seen = scene.points.xyz[scene.point_observations.point_idx[by_image]]
    work = [(i, segments[i], camera[i], seen[starts[i] : starts[i + 1]]) for i in range(count)]
    none = {
        "ends": np.zeros((0, 4)), "ray": np.zeros((0, 2, 3)), "across": np.zeros((0, 3)), "length": np.zeros(0),
        "usable": np.zeros(0, bool), "sigma": np.zeros(0), "range": np.zeros((0, 2)), "inverse_depth": np.zeros((0, 2)),
    }  # fmt: skip
    cameras = scene.keep(points=[], lines=[], planes=[], directions=[])  # points travel with their images
    parts = [none, *map_work(partial(_columns_of, cameras, (min_length, noise, depth_margin)), work)]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in none}
    sizes = [len(item.ends) for item in segments]
    return LineViews(
        camera=camera,
        center=scene.cam_centers_in_world,
        pointers=pointers_of(sizes),
        image_idx=np.repeat(np.arange(count), sizes),
        line=segment2.to_line(columns["ends"]),
        **columns,
    )


def views_of_rows(
    scene: Scene, segments: Sequence[Segments], rows: IntArray, min_length: float, noise: float
) -> LineViews:
    """Return the table of some segments, ascending ``rows`` among all, without where to look for them in depth."""
    first = pointers_of([len(one) for one in segments])
    bounds = np.searchsorted(rows, first)
    chosen = [one.select(rows[bounds[i] : bounds[i + 1]] - first[i]) for i, one in enumerate(segments)]
    undistorted = map_in_threads(lambda i: _undistorted(scene, i, chosen[i], min_length), range(scene.num_images))
    columns = {name: np.concatenate([part[name] for part in undistorted]) for name in undistorted[0]}
    return LineViews(
        camera=_cameras(scene),
        center=scene.cam_centers_in_world,
        inverse_depth=np.full((scene.num_images, 2), np.nan),
        pointers=bounds.astype(np.int64),
        image_idx=np.repeat(np.arange(scene.num_images), np.diff(bounds)),
        sigma=np.hypot(np.concatenate([one.sigma for one in chosen]), noise),
        line=segment2.to_line(columns["ends"]),
        range=np.full((len(rows), 2), np.nan),
        **columns,
    )


def _columns_of(
    scene: Scene, limits: tuple[float, float, float], image: tuple[int, Segments, FloatArray, FloatArray]
) -> dict[str, np.ndarray]:
    """Columns of one image: its number, segments, pinhole camera and points."""
    (min_length, noise, depth_margin), (i, segments, camera, points) = limits, image
    columns = _undistorted(scene, i, segments, min_length)
    depths, search = _depth_range(scene, i, camera, points, columns["ends"], depth_margin)
    return columns | {"sigma": np.hypot(segments.sigma, noise), "range": search, "inverse_depth": depths[None]}


def _cameras(scene: Scene) -> FloatArray:
    """(C, 3, 4) pinhole cameras, pixels without distortion from world."""
    poses = scene.cam_from_world
    rotation = quaternion.to_matrix(poses[:, :4])
    camera = np.zeros((scene.num_images, 3, 4))
    for i, which in enumerate(scene.images.camera_idx):
        K = camera_models.model(scene.cameras.models[which]).camera_matrix(scene.cameras.params_of(which))
        camera[i] = K @ np.column_stack([rotation[i], poses[i, 4:]])
    return camera


def _undistorted(scene: Scene, image: int, segments: Segments, min_length: float) -> dict[str, np.ndarray]:
    """Columns of the segments of an image that follow from their end points."""
    which = scene.images.camera_idx[image]
    model, params = camera_models.model(scene.cameras.models[which]), scene.cameras.params_of(which)
    ends = model.undistort_pixels(params, segments.ends.reshape(-1, 2)).reshape(-1, 4)
    length = np.where(np.isfinite(ends).all(1), segment2.length(ends), 0.0)
    usable = length >= min_length
    ends[~usable] = 0.0
    to_ray = quaternion.to_matrix(scene.cam_from_world[image, :4]).T @ np.linalg.inv(model.camera_matrix(params))
    pixel = np.ones((len(ends), 2, 3))
    pixel[:, :, :2] = ends.reshape(-1, 2, 2)
    normal = np.zeros((len(ends), 3))
    normal[:, :2] = segment2.to_line(ends)[:, :2]
    return {
        "ends": ends, "ray": pixel @ to_ray.T, "across": normal @ to_ray.T, "length": length, "usable": usable,
    }  # fmt: skip


def _depth_range(
    scene: Scene, image: int, camera: FloatArray, points: FloatArray, ends: FloatArray, margin: float
) -> tuple[FloatArray, FloatArray]:
    """Range (2,) of the inverse depths in an image, and where to look for each segment (n, 2)."""
    pose = scene.cam_from_world[image]
    depth = points @ quaternion.to_matrix(pose[:4])[2] + pose[6]
    points, depth = points[depth > 0], depth[depth > 0]
    if len(depth):
        pixel = (points @ camera[:2, :3].T + camera[:2, 3]) / depth[:, None]
        inverse = 1.0 / depth
        low, high = np.quantile(inverse, [GATES.depth_quantile, 1.0 - GATES.depth_quantile])
        near = _range_near(ends, pixel, inverse, margin)
        return np.array([low / margin, high * margin]), near
    if scene.num_images == 1:
        return np.full(2, np.nan), np.zeros((len(ends), 2))
    centers = scene.cam_centers_in_world
    away = np.sort(np.linalg.norm(centers - centers[image], axis=1))[1 : 1 + GATES.num_baselines]
    everywhere = np.array(GATES.inverse_depth_range) / max(away.mean(), 1e-12)
    return everywhere, np.tile(everywhere, (len(ends), 1))


def _range_near(ends: FloatArray, pixel: FloatArray, inverse: FloatArray, margin: float) -> FloatArray:
    """Range of the inverse depths of the points around each segment, widened by the margin."""
    if len(ends) == 0:
        return np.zeros((0, 2))
    first, second = ends[:, :2], ends[:, 2:]
    places = np.stack([first, 0.5 * (first + second), second], axis=1)
    near = min(GATES.num_near, len(pixel))
    found = nearest(kd_tree(pixel), places.reshape(-1, 2), near)[1].reshape(len(ends), -1)
    values = inverse[found]
    return np.column_stack([values.min(1) / margin, values.max(1) * margin])
