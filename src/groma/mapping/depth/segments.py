# SPDX-License-Identifier: BSD-3-Clause
"""Depths of segments, read from the depth maps beside them, and of the observations of mapped lines."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from groma import cameras as camera_models
from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.execution import map_work
from groma.features.depth.lines import DepthLineGates, fit_depth_lines
from groma.features.depth.noise import DepthNoise
from groma.gates import SIGMA_OF_MEDIAN
from groma.geometry import quaternion
from groma.io.depth_maps import DepthMaps
from groma.mapping.depth.points import MeasuredDepths, image_sizes, read_map
from groma.scene import LineDepths, Scene
from groma.scene.line_intervals import shares_on_lines

if TYPE_CHECKING:
    from groma.features.segments import Segments
    from groma.mapping.lines.line_map import LineMap


def segment_depths(
    scene: Scene,
    segments: Sequence[Segments],
    maps: DepthMaps,
    measured: MeasuredDepths,
    progress: Callable[[int, int], None] | None = None,
) -> FloatArray:
    """Return the inverse depths q of the ends of all segments, image by image, (S, 5): q1 q2 c11 c12 c22; 0 unknown.

    Parameters
    ----------
    scene : Scene
        The images, in the unit of length of ``measured``.
    segments : sequence of C Segments
        Of its images.
    maps, measured : DepthMaps, MeasuredDepths
        The maps, with the estimates from points.
    progress : callable, optional
        Called with the number of images done and in all.
    """
    files, cameras = maps.files(scene.images.names), scene.cameras
    work = []
    for i, (own, camera) in enumerate(zip(segments, scene.images.camera_idx, strict=True)):
        K = camera_models.model(cameras.models[camera]).camera_matrix(cameras.params_of(camera))
        pinhole = np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]])
        work.append((files[i] if np.isfinite(measured.units[i]) else None, image_sizes(scene)[i], own, pinhole))
    units = measured.units.tolist()
    todo = list(zip(work, units, strict=True))
    found = map_work(partial(_depths_beside, maps, measured.noise), todo, progress or (lambda done, total: None))
    return np.concatenate([np.zeros((0, 5)), *found])


def _depths_beside(
    maps: DepthMaps, noise: DepthNoise, work: tuple[tuple[Path | None, tuple[int, int], Segments, FloatArray], float]
) -> FloatArray:
    """The same of one image (n, 5)."""
    (file, size, segments, pinhole), unit = work
    if file is None or len(segments) == 0:
        return np.zeros((len(segments), 5))
    depth = read_map(maps, file, size) / np.float32(unit)
    found = fit_depth_lines(segments.ends, depth, pinhole, noise, segments.sigma, DepthLineGates())
    covariance = found.inverse_depth_covariances
    values = np.column_stack([found.inverse_depth, covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]])
    return np.where(found.good[:, None], values, 0.0)


def with_line_depths(scene: Scene, line_map: LineMap, segments: Sequence[Segments], depths: FloatArray | None) -> Scene:
    """Return a scene whose lines are those of a map, with the depths (S, 5) of the segments that see them."""
    if depths is None:
        return scene
    first = pointers_of([len(one) for one in segments])
    of = depths[first[line_map.image_idx] + line_map.segment_idx]
    rows = np.flatnonzero(of[:, 0] > 0.0)
    if len(rows) == 0:
        return scene
    image, ends = line_map.image_idx[rows], scene.lines.segments[line_map.line_idx[rows]]
    q, sigma = of[rows, :2], np.sqrt(of[rows][:, [2, 4]])
    sigma = sigma * _misfit(q - _predicted(scene, image, scene.line_observations.segment[rows], ends), sigma)
    # Far enough apart that depth adds information to the segment: a pixel of usual noise.
    camera = scene.images.camera_idx[image]
    focal = np.array([
        np.mean(camera_models.model(name).focal_length(scene.cameras.params_of(row)[None]))
        for row, name in enumerate(scene.cameras.models)
    ])[camera]  # fmt: skip
    baseline = np.full(len(rows), 1.0 / float(np.median(focal[:, None] * sigma)))
    return scene.replace(line_depths=LineDepths(rows, q, sigma, baseline))


def _predicted(scene: Scene, image_idx: IntArray, segment: FloatArray, ends: FloatArray) -> FloatArray:
    """Inverse depths (N, 2) of lines through ends (N, 2, 3), in images, where the ends of segments (N, 4) see them."""
    poses, q = scene.cam_from_world[image_idx], np.empty((len(ends), 2))
    axis = quaternion.to_matrix(poses[:, :4])[:, 2]
    for end in range(2):
        share = shares_on_lines(scene, image_idx, segment[:, 2 * end : 2 * end + 2], ends)
        place = ends[:, 0] + share[:, None] * (ends[:, 1] - ends[:, 0])
        q[:, end] = 1.0 / (np.einsum("ni,ni->n", axis, place) + poses[:, 6])
    return q


def _misfit(difference: FloatArray, sigma: FloatArray) -> float:
    """Return how many times as far inverse depths are from those of mapped lines as they should be, one at least.

    Beside an edge that is bowed, or the contour of a round body, surfaces are not the planes that are fitted to them.
    """
    away = np.abs(difference / sigma)
    away = away[np.isfinite(away)]
    return max(1.0, SIGMA_OF_MEDIAN * float(np.median(away))) if len(away) else 1.0
