# SPDX-License-Identifier: BSD-3-Clause
"""The pinhole camera of a track: projection and its inverse for many points and segments at once.

Frames are undistorted and rectified before they are tracked, so a track needs no other model. Pixels count from the
corner of the image (first pixel's centre at 0.5, 0.5); OpenCV's do not, and are shifted where it is called.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from groma._numba import loop
from groma._ordering import copy
from groma._typing import BoolArray, FloatArray
from groma.cameras import model as camera_model
from groma.errors import InputError
from groma.io.sequences.frame import SequenceCamera
from groma.localization.pose.camera import QueryCamera

#: Nothing nearer than this share of the focal plane's unit depth is projected, scene units.
NEAR = 1e-3
PINHOLE = "PINHOLE"


@loop
def _clip_segments(ends_in_cam, K, size, limits, ends, seen):
    """Write segments (L, 2, 3) in pixels, clipped beyond ``near`` and within a border; flag visible ones."""
    near, border = limits
    P, start, way = np.empty((2, 3)), np.empty(2), np.empty(2)
    for i in range(ends_in_cam.shape[0]):
        copy(ends_in_cam[i, 0], P[0])
        copy(ends_in_cam[i, 1], P[1])
        if not (P[0, 2] > near or P[1, 2] > near):
            continue
        for one in range(2):
            if P[one, 2] < near:
                share = (near - P[one, 2]) / (P[1 - one, 2] - P[one, 2])
                for k in range(2):
                    P[one, k] += share * (P[1 - one, k] - P[one, k])
                P[one, 2] = near
        low, high, outside = 0.0, 1.0, False
        for axis in range(2):
            start[axis] = P[0, axis] / P[0, 2] * K[axis] + K[2 + axis]
            way[axis] = P[1, axis] / P[1, 2] * K[axis] + K[2 + axis] - start[axis]
            for sign in (1.0, -1.0):
                side = border if sign > 0.0 else size[axis] - border
                distance, speed = sign * (start[axis] - side), sign * way[axis]
                if speed > 0.0:
                    low = max(low, -distance / speed)
                elif speed < 0.0:
                    high = min(high, -distance / speed)
                elif not distance >= 0.0:
                    outside = True
        if not outside and high > low:
            seen[i] = True
            for axis in range(2):
                ends[i, axis], ends[i, 2 + axis] = start[axis] + low * way[axis], start[axis] + high * way[axis]


@dataclass(frozen=True)
class TrackCamera:
    """Focal lengths, principal point, size, and the baseline of a stereo pair."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    #: Distance of the right camera along x, scene units; 0 without one.
    baseline: float = 0.0

    @classmethod
    def of(cls, camera: SequenceCamera) -> TrackCamera:
        """Return the camera of a sequence; it must be free of distortion."""
        model = camera_model(camera.model)
        if not model.has_pinhole_parameters:
            raise InputError(
                f"Tracking needs undistorted images; the camera model is {camera.model}. "
                "Undistort the images first, or open them with groma.io.sequences.open_sequence, which does."
            )
        params = np.asarray(camera.params, float)
        focal, center = params[list(model.focal_indices)], params[list(model.principal_point_indices)]
        if not (np.isfinite(params).all() and (focal > 0.0).all()):
            raise InputError(f"Focal lengths must be positive and finite; got the parameters {params.tolist()}.")
        return cls(
            float(focal[0]), float(focal[-1]), float(center[0]), float(center[1]),
            int(camera.width), int(camera.height), float(camera.baseline or 0.0),
        )  # fmt: skip

    @property
    def line_baseline(self) -> float:
        """Baseline at which the inverse depths of segments are compared, scene units: that of the pair if it is longer
        than what is derived from a Kinect, whose noise of 0.003 is then a pixel.
        """
        return max(self.baseline, 0.6)  # derived from 0.003 / m of inverse depth at a focal length of 525 px

    @property
    def params(self) -> FloatArray:
        """(4,) fx, fy, cx, cy."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    @property
    def matrix_opencv(self) -> FloatArray:
        """(3, 3) calibration matrix in OpenCV's pixels."""
        return np.array([[self.fx, 0, self.cx - 0.5], [0, self.fy, self.cy - 0.5], [0, 0, 1.0]])

    @property
    def pinhole(self) -> dict[str, Any]:
        """The same camera, as PoseLib wants it."""
        return {"model": PINHOLE, "width": self.width, "height": self.height, "params": self.params.tolist()}

    @property
    def query(self) -> QueryCamera:
        """The same camera, for :func:`groma.estimate_absolute_pose`."""
        return QueryCamera(PINHOLE, self.params, self.width, self.height)

    def bearings(self, pixels: FloatArray) -> FloatArray:
        """(N, 3) rays with z = 1 through pixels."""
        rays = np.ones((len(pixels), 3))
        rays[:, 0] = (pixels[:, 0] - self.cx) / self.fx
        rays[:, 1] = (pixels[:, 1] - self.cy) / self.fy
        return rays

    def project(self, points_in_cam: FloatArray) -> FloatArray:
        """(N, 2) pixels of points in the camera; NaN where they are not in front of it."""
        z = np.where(points_in_cam[:, 2] > NEAR, points_in_cam[:, 2], np.nan)
        return points_in_cam[:, :2] / z[:, None] * (self.fx, self.fy) + (self.cx, self.cy)

    def inside(self, pixels: FloatArray, border: float = 0.0) -> BoolArray:
        """Whether pixels lie in the image, at least ``border`` from its edge."""
        with np.errstate(invalid="ignore"):
            return np.asarray(
                ((pixels >= border) & (pixels <= (self.width - border, self.height - border))).all(axis=1)
            )

    def project_segments(self, ends_in_cam: FloatArray, border: float = 0.0) -> tuple[FloatArray, BoolArray]:
        """Project segments (L, 2, 3) and clip them to the part in front of the camera and in the image.

        Returns (L, 4) pixels, and which of them are seen at all.
        """
        near = max(NEAR, 0.02 * float(np.median(np.abs(ends_in_cam[..., 2])))) if len(ends_in_cam) else NEAR
        ends, seen = np.zeros((len(ends_in_cam), 4)), np.zeros(len(ends_in_cam), dtype=bool)
        size = float(self.width), float(self.height)
        _clip_segments(np.ascontiguousarray(ends_in_cam), self.params, size, (near, float(border)), ends, seen)
        return ends, seen


def rotation(pose: FloatArray) -> FloatArray:
    """(3, 3) rotation matrix of one pose (7,)."""
    x, y, z, w = pose[:4].tolist()  # numbers of Python are quicker here than arrays of one
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def into(pose: FloatArray, points: FloatArray) -> FloatArray:
    """Move points (..., 3) by one pose (7,)."""
    return points @ rotation(pose).T + pose[4:]


def apart(pose: FloatArray, other: FloatArray) -> tuple[float, float]:
    """Distance between the centres of two cameras (7,), and the angle between them."""
    first, second = rotation(pose), rotation(other)
    shift = math.dist(pose[4:] @ first, other[4:] @ second)
    turn = first @ second.T
    across = math.hypot(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
    return shift, math.atan2(across, float(np.trace(turn)) - 1.0)


def back(pose: FloatArray, points: FloatArray) -> FloatArray:
    """Move points (..., 3) by the inverse of one pose (7,)."""
    return (points - pose[4:]) @ rotation(pose)


def planes_into(pose: FloatArray, planes: FloatArray) -> FloatArray:
    """Planes (K, 4) with unit normals, moved by one pose (7,)."""
    normals = planes[:, :3] @ rotation(pose).T
    return np.hstack([normals, (planes[:, 3] - normals @ pose[4:])[:, None]])


def planes_back(pose: FloatArray, planes: FloatArray) -> FloatArray:
    """Planes (K, 4) with unit normals, moved by the inverse of one pose (7,)."""
    return np.hstack([planes[:, :3] @ rotation(pose), (planes[:, 3] + planes[:, :3] @ pose[4:])[:, None]])
