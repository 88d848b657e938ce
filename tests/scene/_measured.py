# SPDX-License-Identifier: BSD-3-Clause
"""What a depth camera or a stereo pair would measure in a synthetic scene."""

from __future__ import annotations

import math

import numpy as np

from groma._typing import FloatArray
from groma.geometry import quaternion
from groma.scene.measurements import LineDepths, PlaneObservations, PointDepths, PosePriors, RightColumns
from groma.scene.scene import Scene


def with_measurements(
    truth: Scene, seed: int = 0, depth_sigma: float = 0.01, pixel_sigma: float = 0.5, baseline: float = 0.3
) -> Scene:
    """Return a scene with depths, right columns, depths of segments, planes in the cameras and a prior of each pose.

    Every second observation of a point has a depth, every third a column in a right image, every second segment the
    inverse depths of its ends; all planes are measured by all images, to 0.5 degrees and ``depth_sigma``.

    Parameters
    ----------
    truth : Scene
        True poses, landmarks and their observations by one PINHOLE camera, without rigs.
    seed : int
        Random seed of the noise.
    depth_sigma, pixel_sigma : float
        Standard deviations of depths (scene units) and of columns (pixels); 0 for exact measurements, whose stated
        standard deviations are then 0.01 and 1.
    baseline : float
        Distance of the right camera, and of the cameras that compare the depths of segments, scene units.
    """
    rng = np.random.default_rng(seed)
    focal, poses = truth.cameras.params[0, 0], truth.cam_from_world
    stated, stated_px = depth_sigma or 0.01, pixel_sigma or 1.0
    seen = truth.point_observations
    depth = _into(poses[seen.image_idx], truth.points.xyz[seen.point_idx])[:, 2]
    half, third = np.arange(0, len(seen), 2), np.arange(0, len(seen), 3)
    right = seen.pixel[third, 0] - focal * baseline / depth[third]
    ends = _depths_of_ends(truth)[::2]
    inverse, inverse_sigma = 1.0 / ends, stated / ends**2
    image, plane = (index.ravel() for index in np.meshgrid(np.arange(truth.num_images), np.arange(truth.num_planes)))
    normals = quaternion.rotate(poses[image, :4], truth.planes.hesse[plane, :3])
    offsets = truth.planes.hesse[plane, 3] - np.einsum("ni,ni->n", normals, poses[image, 4:])
    angle = math.radians(0.5)
    exact = 0.0 if depth_sigma == 0.0 else 1.0
    normals = quaternion.rotate(quaternion.exp(exact * rng.normal(0, angle, normals.shape)), normals)
    weights = np.diag([1.0 / angle, 1.0 / angle, 1.0 / stated])
    prior_sigma = np.tile([0.1, 0.1, 0.1, 0.05, 0.05, 0.05], (truth.num_frames, 1))
    return truth.replace(
        point_depths=PointDepths(
            seen.image_idx[half],
            seen.point_idx[half],
            depth[half] + rng.normal(0, depth_sigma, len(half)),
            np.full(len(half), stated),
        ),
        right_columns=RightColumns(
            third,
            right + rng.normal(0, pixel_sigma, len(third)),
            np.full(len(third), baseline),
            np.full(len(third), stated_px),
        ),
        line_depths=LineDepths(
            2 * np.arange(len(ends)),
            inverse + exact * rng.normal(size=ends.shape) * inverse_sigma,
            inverse_sigma,
            np.full(len(ends), baseline),
        ),
        plane_observations=PlaneObservations(
            image,
            plane,
            np.column_stack([normals, offsets + rng.normal(0, depth_sigma, len(image))]),
            np.tile(weights, (len(image), 1, 1)),
        ),
        pose_priors=PosePriors(np.arange(truth.num_frames), truth.frames.rig_from_world, prior_sigma),
    )


def _into(poses: FloatArray, xyz: FloatArray) -> FloatArray:
    return quaternion.rotate(poses[:, :4], xyz) + poses[:, 4:]


def _depths_of_ends(truth: Scene) -> FloatArray:
    """Depths (N, 2) at which the rays of the ends of segments pass their line."""
    seen, params = truth.line_observations, truth.cameras.params[0]
    poses, segments = truth.cam_from_world[seen.image_idx], truth.lines.segments[seen.line_idx]
    start, end = _into(poses, segments[:, 0]), _into(poses, segments[:, 1])
    d = (end - start) / np.linalg.norm(end - start, axis=1, keepdims=True)
    depths = np.empty((len(seen), 2))
    for k in (0, 1):
        ray = np.column_stack([(seen.segment[:, 2 * k : 2 * k + 2] - params[2:4]) / params[:2], np.ones(len(seen))])
        # z ray = start + s d, in the least-squares sense
        A = np.stack([ray, -d], axis=-1)
        depths[:, k] = np.linalg.solve(A.swapaxes(1, 2) @ A, A.swapaxes(1, 2) @ start[:, :, None])[:, 0, 0]
    return depths


__all__ = ["with_measurements"]
