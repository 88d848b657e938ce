# SPDX-License-Identifier: BSD-3-Clause
"""A scene as plain arrays to draw: places, camera axes, pieces of planes, and the residual of every observation.

Residuals are computed here from scene and camera model alone, so that a picture shows what is in the file and not what
a solver reported. The residual of a line end is the vector from the measured end to the image of the line. It is
computed on bearings, which works for every camera model: the bearing is moved into the plane of camera centre and line
and projected again; what is left along the image of the line is removed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from groma._rows import medians
from groma._typing import FloatArray, IntArray
from groma.cameras import CameraModel
from groma.geometry import se3
from groma.geometry.incidence import closest_points
from groma.geometry.line3 import from_point_and_direction
from groma.scene import Scene
from groma.scene.local_frame import up_of
from groma.scene.patches import plane_patches

#: Step along the image of a line that gives its direction, radians.
_STEP = 1e-4


@dataclass(frozen=True)
class Drawable:
    """What the page shows of a scene."""

    #: (P, 3) places of the points, and (P, 3) uint8 colours or None.
    points: FloatArray
    colours: npt.NDArray[np.uint8] | None
    #: (L, 2, 3) end points of the lines.
    segments: FloatArray
    #: K convex polygons (n, 3), a piece of each plane, and (K,) how many landmarks lie on each.
    patches: list[FloatArray]
    patch_members: IntArray
    #: (N, 7) poses of the images.
    cam_from_world: FloatArray
    image_names: list[str]
    #: (3,) the direction that is up.
    up: FloatArray
    #: (N, 2) width and height of the images, pixels; zero where unknown.
    image_sizes: IntArray
    #: (M, 2) residuals in pixels, predicted minus measured, of points and line ends; NaN behind the camera.
    residuals: FloatArray
    #: (M, 2) pixels where they were measured, (M,) their image, and their kind as a position in ``residual_kinds``.
    residual_place: FloatArray
    residual_image: IntArray
    residual_kind: IntArray
    residual_kinds: tuple[str, ...]
    #: Observations: points and segments.
    num_observations: int
    #: (P,) root mean square residual of each point, pixels; NaN where it is not observed.
    point_errors: FloatArray

    @cached_property
    def world_from_cam_axes(self) -> FloatArray:
        """(N, 3, 3): the rows are the x, y and z axes of each camera, in the world."""
        return se3.to_matrix(self.cam_from_world)[:, :3, :3]

    @cached_property
    def centers(self) -> FloatArray:
        """(N, 3) centres of the cameras in the world."""
        return -np.einsum("nij,ni->nj", self.world_from_cam_axes, self.cam_from_world[:, 4:])

    @cached_property
    def lengths(self) -> FloatArray:
        """(M,) lengths of the residuals, pixels; NaN behind the camera."""
        return np.linalg.norm(self.residuals, axis=1)

    @cached_property
    def median_by_image(self) -> FloatArray:
        """(N,) median residual of each image, pixels; zero where nothing was measured.

        A wrong pose changes it; single wrong matches, which a robust loss leaves where they are, do not.
        """
        known = np.isfinite(self.lengths)
        return medians(self.lengths[known], self.residual_image[known], len(self.image_names))


def drawable(scene: Scene) -> Drawable:
    """Compute everything that the page shows of a scene."""
    poses = se3.to_matrix(scene.cam_from_world)[:, :3]
    points, lines = scene.point_observations, scene.line_observations
    point_residuals = _point_residuals(scene, poses)
    line_residuals, line_places = _line_residuals(scene, poses)
    kinds = [("points", len(points)), ("line ends", 2 * len(lines))]
    color = scene.points.color
    patches, members = plane_patches(scene)
    camera_idx = scene.images.camera_idx
    return Drawable(
        points=scene.points.xyz,
        colours=np.ascontiguousarray(color) if color.any() else None,
        segments=scene.lines.segments,
        patches=patches,
        patch_members=members,
        cam_from_world=scene.cam_from_world,
        image_names=list(scene.images.names),
        up=up_of(scene),
        image_sizes=np.stack([scene.cameras.width, scene.cameras.height], axis=1)[camera_idx],
        residuals=np.concatenate([point_residuals, line_residuals]),
        residual_place=np.concatenate([points.pixel, line_places]),
        residual_image=np.concatenate([points.image_idx, np.repeat(lines.image_idx, 2)]),
        residual_kind=np.repeat([0, 1], [count for _, count in kinds]),
        residual_kinds=tuple(name for name, _ in kinds),
        num_observations=scene.num_observations,
        point_errors=rms_by_group(
            np.linalg.norm(point_residuals, axis=1), points.point_idx, len(scene.points), empty=np.nan
        ),
    )


def junctions(segments: FloatArray, pairs: IntArray) -> FloatArray:
    """Places (J, 3) where pairs (J, 2) of lines through segments (L, 2, 3) meet: half-way where they are nearest."""
    ends = segments[pairs]
    lines = from_point_and_direction(ends[:, :, 0], ends[:, :, 1] - ends[:, :, 0])
    return closest_points(lines[:, 0], lines[:, 1]).midpoint


def rms_by_group(lengths: FloatArray, group: IntArray, size: int, empty: float = 0.0) -> FloatArray:
    """Return the root mean square (size,) of the known lengths (M,) of each group; ``empty`` where there are none.

    Squares are taken in a power of two near the largest of a group, so that none overflows and nothing is rounded.
    """
    known = np.isfinite(lengths)
    lengths, group = lengths[known], group[known]
    count, largest = np.bincount(group, minlength=size), np.zeros(size)
    np.maximum.at(largest, group, lengths)
    unit = np.ldexp(1.0, np.frexp(largest)[1] - 1)
    total = np.bincount(group, (lengths / unit[group]) ** 2, minlength=size)
    return np.where(count > 0, unit * np.sqrt(total / np.maximum(count, 1)), empty)


# ------------------------------------------------------------------------------------------------------ Residuals


def _by_camera(
    scene: Scene, image_idx: IntArray, function: Callable[[CameraModel, FloatArray, IntArray], FloatArray]
) -> FloatArray:
    """Call ``function(model, params, rows)`` once per camera model, with a row of parameters per observation."""
    result = np.full((len(image_idx), 2), np.nan)
    for model, rows, params in scene.cameras.rows_by_model(scene.images.camera_idx[image_idx]):
        result[rows] = function(model, params, rows)
    return result


def _point_residuals(scene: Scene, poses: FloatArray) -> FloatArray:
    seen = scene.point_observations
    in_cam = _transform(poses[seen.image_idx], scene.points.xyz[seen.point_idx])

    def residual(model: CameraModel, params: FloatArray, rows: IntArray) -> FloatArray:
        residual = model.pixel_difference(params, model.project(params, in_cam[rows]), seen.pixel[rows])
        if not model.sees_behind:
            residual[in_cam[rows, 2] <= 0] = np.nan
        return residual

    return _by_camera(scene, seen.image_idx, residual)


def _line_residuals(scene: Scene, poses: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residuals (2 M, 2) of both ends of each observed segment, and the ends (2 M, 2)."""
    seen = scene.line_observations
    line = scene.lines.plucker[seen.line_idx]
    pose = poses[seen.image_idx]
    rotated = np.einsum("nij,nj->ni", pose[:, :, :3], line[:, 3:])
    normal = np.einsum("nij,nj->ni", pose[:, :, :3], line[:, :3]) + np.cross(pose[:, :, 3], rotated)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.repeat(np.divide(normal, length, out=np.full_like(normal, np.nan), where=length > 0), 2, axis=0)
    places = seen.segment.reshape(-1, 2)

    def residual(model: CameraModel, params: FloatArray, rows: IntArray) -> FloatArray:
        bearing = model.unproject(params, places[rows])
        across = normal[rows]
        onto = bearing - np.einsum("ni,ni->n", bearing, across)[:, None] * across
        predicted = model.project(params, onto)
        tangent = model.project(params, onto + _STEP * np.cross(across, onto)) - predicted
        tangent /= np.maximum(np.linalg.norm(tangent, axis=1, keepdims=True), 1e-300)
        way = model.pixel_difference(params, predicted, places[rows])
        return way - np.einsum("ni,ni->n", way, tangent)[:, None] * tangent

    return _by_camera(scene, np.repeat(seen.image_idx, 2), residual), places


def _transform(poses: FloatArray, points: FloatArray) -> FloatArray:
    return np.einsum("nij,nj->ni", poses[:, :, :3], points) + poses[:, :, 3]
