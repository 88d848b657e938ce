# SPDX-License-Identifier: BSD-3-Clause
"""Are the covariances of localised poses true? Simulated queries in simulated maps whose noise is known.

Each run draws a scene, takes one of its images for the query, measures points and segments in it with noise, and moves
every landmark by an error of its own covariance. The errors of the poses are compared with what their covariances
predict, as :mod:`groma.adjustment.consistency` does for maps: by points, by lines, and by both.
"""

from __future__ import annotations

import numpy as np
from scipy.stats import chi2

from groma._typing import FloatArray
from groma.adjustment.consistency import BAND, LIMIT, NUM_IMAGES, RUNS, ConsistencyRow
from groma.geometry import se3
from groma.localization.pose.absolute_pose import AbsolutePose, PoseOptions, pose_from_matches
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.matches import Matches
from groma.scene import Scene
from groma.scene.synthetic import holistic

#: What poses are estimated from.
KINDS = ("points", "lines", "both")


def localization_consistency(
    runs: int = RUNS,
    seed: int = 0,
    num_images: int = NUM_IMAGES,
    noise_px: float = 0.5,
    believed_px: float | None = None,
) -> tuple[ConsistencyRow, ...]:
    """Compare the covariances of localised poses with the errors that they predict.

    Parameters
    ----------
    runs : int
        Queries.
    seed : int
        Everything random follows from it.
    num_images : int
        Size of the scenes; see :func:`groma.scene.synthetic.holistic`.
    noise_px : float
        Standard deviation of the measurements. Landmarks are off by as much, seen from the query, on average.
    believed_px : float, optional
        What the estimate takes it for; the same by default.

    Returns
    -------
    tuple of ConsistencyRow
        One for each of :data:`KINDS`.
    """
    values: dict[str, list[float]] = {kind: [] for kind in KINDS}
    for run in range(runs):
        rng = np.random.default_rng([seed, run, 2])
        scene = holistic(num_images, int(rng.integers(2**31)), noise_px=0.0).truth
        image = int(rng.integers(scene.num_images))
        camera = QueryCamera.of(scene.cameras, int(scene.images.camera_idx[image]))
        matches = _measured(scene, image, camera, noise_px, rng)
        told = noise_px if believed_px is None else believed_px
        for kind, (points, lines) in zip(KINDS, ((True, False), (False, True), (True, True)), strict=True):
            chosen = matches.take(np.full(matches.num_points, points), np.full(matches.num_lines, lines))
            chosen = chosen.with_sigma(told)
            found = pose_from_matches(camera, chosen, PoseOptions(seed=run))
            error = _normalised(scene.cam_from_world[image], found)
            if error is not None:
                values[kind].append(error)
    return tuple(_row(kind, np.array(found)) for kind, found in values.items() if found)


def _measured(scene: Scene, image: int, camera: QueryCamera, noise_px: float, rng: np.random.Generator) -> Matches:
    """What an image sees of a scene, both with noise."""
    pose = scene.cam_from_world[image]
    seen, lines = scene.point_observations, scene.line_observations
    points = scene.points.xyz[seen.point_idx[seen.image_idx == image]]
    ends = scene.lines.segments[lines.line_idx[lines.image_idx == image]]
    pixels = camera.project(pose, points)
    segments = camera.project(pose, ends.reshape(-1, 3)).reshape(-1, 2, 2)
    good, good_lines = np.isfinite(pixels).all(axis=1), np.isfinite(segments).all(axis=(1, 2))
    points, pixels, ends, segments = points[good], pixels[good], ends[good_lines], segments[good_lines]
    away = np.linalg.norm(points - scene.cam_centers_in_world[image], axis=1)
    sigma = noise_px * away / float(camera.kind.focal_length(camera.params))
    spread = noise_px * np.linalg.norm(ends.mean(axis=1) - scene.cam_centers_in_world[image], axis=1)
    spread = spread / float(camera.kind.focal_length(camera.params))
    return Matches(
        pixels + rng.normal(0.0, noise_px, pixels.shape),
        points + sigma[:, None] * rng.normal(size=points.shape),
        segments + rng.normal(0.0, noise_px, segments.shape),
        ends + spread[:, None, None] * rng.normal(size=ends.shape),
        point_covariance=sigma[:, None, None] ** 2 * np.eye(3),
        line_covariance=_of_lines(ends, spread),
    )


def _of_lines(ends: FloatArray, sigma: FloatArray) -> FloatArray:
    """Covariances (L, 6, 6) of (moment, direction) of lines through places (L, 2, 3) with errors of one size each."""
    way = ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(way, axis=1)[:, None, None]
    d = way / length[:, 0]
    across = (np.eye(3) - d[:, :, None] * d[:, None, :]) / length
    by_direction = np.concatenate([-across, across], axis=2)
    by_moment = _hat(ends[:, 0]) @ by_direction
    by_moment[:, :, :3] -= _hat(d)
    J = np.concatenate([by_moment, by_direction], axis=1)
    return sigma[:, None, None] ** 2 * J @ np.swapaxes(J, 1, 2)


def _hat(vectors: FloatArray) -> FloatArray:
    return np.cross(vectors[:, None, :], np.eye(3)[None]).swapaxes(1, 2)


def _normalised(true: FloatArray, found: AbsolutePose) -> float | None:
    """Squared error of a pose in units of its covariance; None where there is none."""
    if found.cam_from_world is None or found.covariance is None or not np.isfinite(found.covariance).all():
        return None
    error = se3.log(se3.compose(true[None], se3.inverse(found.cam_from_world[None])))[0]
    return float(error @ np.linalg.solve(found.covariance, error))


def _row(kind: str, values: FloatArray) -> ConsistencyRow:
    count, average = len(values), float(values.mean())
    low, high = (float(chi2.ppf(0.5 + side * BAND / 2, 6 * count) / count) for side in (-1, 1))
    least, most = (float(chi2.ppf(0.5 + side * LIMIT / 2, 6 * count) / count) for side in (-1, 1))
    return ConsistencyRow("query", kind, 6, count, average, low, high, low <= average <= high, least <= average <= most)
