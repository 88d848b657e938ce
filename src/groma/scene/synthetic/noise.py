# SPDX-License-Identifier: BSD-3-Clause
"""What synthetic scenes share: the pair of truth and start, noisy measurements of exact landmarks, turned poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import InputError
from groma.geometry import quaternion
from groma.scene.camera import Cameras
from groma.scene.landmarks import Lines, Planes, Points
from groma.scene.observations import LineObservations, PointObservations, Relations
from groma.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """A synthetic scene with exact ground truth."""

    #: Exact cameras and landmarks, noisy measurements.
    truth: Scene
    #: The same scene with perturbed cameras and landmarks.
    start: Scene
    #: Standard deviation of the measurements in each coordinate, pixels.
    noise_px: float


@dataclass(frozen=True, eq=False)
class Structure:
    """True landmarks and the images that see them."""

    #: (P, 3), (L, 2, 3) and (K, 4) points, segments and planes.
    xyz: FloatArray
    segments: FloatArray
    planes: FloatArray
    #: Which of them belong together.
    relations: Relations
    #: (M, 2) pairs (landmark, image) of points and of lines.
    point_obs: IntArray
    line_obs: IntArray
    #: (M, 2) where each observed segment begins and ends on the line's segment, 0 to 1; all of it by default.
    trims: FloatArray | None = None


def check_deviations(**deviations: float) -> None:
    """Raise InputError if a standard deviation is negative or not finite."""
    for name, value in deviations.items():
        if not 0.0 <= value < float("inf"):
            raise InputError(f"{name} must be a standard deviation, 0 or more; got {value}.")


def assemble(
    rng: np.random.Generator, camera: Cameras, poses: FloatArray, structure: Structure, noise_px: float
) -> Scene:
    """Return the true scene with measurements of a standard deviation in pixels; poses (N, 7) of one PINHOLE camera."""
    check_deviations(noise_px=noise_px)
    point_obs, line_obs, segments = structure.point_obs, structure.line_obs, structure.segments
    point_obs = point_obs[np.lexsort((point_obs[:, 1], point_obs[:, 0]))]
    order = np.lexsort((line_obs[:, 1], line_obs[:, 0]))
    line_obs = line_obs[order]
    params = camera.params[0]
    pixel = project_pinhole(params, poses[point_obs[:, 1]], structure.xyz[point_obs[:, 0]])[0]
    share = np.tile([0.0, 1.0], (len(line_obs), 1)) if structure.trims is None else structure.trims[order]
    start, end = segments[line_obs[:, 0], 0], segments[line_obs[:, 0], 1]
    ends = [project_pinhole(params, poses[line_obs[:, 1]], start + s[:, None] * (end - start))[0] for s in share.T]
    seen = np.hstack(ends)
    count = len(poses)
    return Scene.from_images(
        camera,
        [f"{row + 1:05d}.png" for row in range(count)],
        np.zeros(count, int),
        poses,
        points=Points.at(structure.xyz),
        point_observations=PointObservations.numbered(
            point_obs[:, 1], point_obs[:, 0], pixel + rng.normal(0, noise_px, pixel.shape)
        ),
        lines=Lines.through(segments),
        line_observations=LineObservations(line_obs[:, 1], line_obs[:, 0], seen + rng.normal(0, noise_px, seen.shape)),
        planes=Planes(np.arange(len(structure.planes)) + 1, structure.planes),
        relations=structure.relations,
    )


def project_pinhole(params: FloatArray, cam_from_world: FloatArray, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return pixels (..., 2) and depths (...) of points (..., 3) seen from poses (..., 7) by one PINHOLE camera."""
    in_cam = quaternion.rotate(cam_from_world[..., :4], xyz) + cam_from_world[..., 4:]
    depth = in_cam[..., 2]
    safe = np.where(depth > 1e-9, depth, 1e-9)[..., None]
    return params[:2] * in_cam[..., :2] / safe + params[2:], depth


def rotated(rng: np.random.Generator, poses: FloatArray, sigma_deg: float) -> FloatArray:
    """Return poses turned in their camera frames; the translation of cam_from_world stays."""
    turned = poses.copy()
    turn = quaternion.exp(rng.normal(0, np.deg2rad(sigma_deg), (len(poses), 3)))
    turned[:, :4] = quaternion.multiply(turn, poses[:, :4])
    turned[:, :4] /= np.linalg.norm(turned[:, :4], axis=1, keepdims=True)
    return turned
