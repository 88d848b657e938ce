# SPDX-License-Identifier: BSD-3-Clause
"""Depths of the points of a model, read from depth maps: the unit of length, the noise, and a table of the scene."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from groma import cameras as camera_models
from groma._typing import FloatArray
from groma.errors import FileFormatError, InputError
from groma.execution import map_work
from groma.features.depth.noise import DepthNoise
from groma.features.depth.points import depth_at
from groma.geometry import quaternion
from groma.io.depth_maps import DepthMap, DepthMaps
from groma.mapping.depth.noise import cells_of, fitted_noise, shared_errors
from groma.mapping.depth.registration import BESIDE, sample, shifted_maps
from groma.mapping.depth.unit import common_unit, own_units, say_left_out
from groma.mapping.noise.landmarks import point_noise
from groma.scene import PointDepths, Scene, Similarity

#: Units of the model in which depths up to scale are measured: the usual depth of a point.
_USUAL_DEPTH = 3.0


@dataclass(frozen=True, eq=False)
class MeasuredDepths:
    """A model with the depths of its points, and what was found out about the depth maps."""

    #: In the unit of the maps; where each has its own, in one that suits.
    scene: Scene
    #: (C,) what the numbers of each map are to be divided by; NaN of images without a map that is used.
    units: FloatArray
    noise: DepthNoise
    #: Units of the scene that was given for one of this: 1 where it was known.
    scale: float
    #: Whether every map has its own unit.
    relative: bool
    #: Correlations of errors in a cell of an image and across it.
    correlations: tuple[float, float]
    warnings: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: the entry ``depth`` of ``summary.json``."""
        depth = self.scene.point_depths.depth
        middle = float(np.median(depth)) if len(depth) else None
        return {
            "unit": "relative" if self.relative else "metric",
            "num_maps": int(np.isfinite(self.units).sum()),
            "num_point_depths": len(depth),
            "scale": None if self.relative else self.scale,
            "median_depth": middle,
            "sigma_at_median": None if middle is None else float(self.noise.sigma(middle)),
            "noise": {"constant": self.noise.constant, "quadratic": self.noise.quadratic},
            "correlation_near": self.correlations[0],
            "correlation_far": self.correlations[1],
        }

    def header(self) -> str:
        """Return all but scene and units, as JSON."""
        noise = vars(self.noise)
        return json.dumps([noise, self.scale, self.relative, self.correlations, self.warnings])

    @staticmethod
    def of(scene: Scene, units: FloatArray, header: str) -> MeasuredDepths:
        """Return what scene, units and header say."""
        noise, scale, relative, correlations, warnings = json.loads(header)
        return MeasuredDepths(scene, units, DepthNoise(**noise), scale, relative, tuple(correlations), tuple(warnings))


def measure_depths(
    points: Scene, maps: DepthMaps, known: float | None = None, progress: Callable[[int, int], None] | None = None
) -> MeasuredDepths:
    """Read the depths of the points of a model, and bring it to their unit of length.

    Parameters
    ----------
    points : Scene
        Cameras, poses and points, adjusted.
    maps : DepthMaps
        The depth maps of its images.
    known : float, optional
        Length in units of the model of one unit of the maps, if other measurements determine it.
    progress : callable, optional
        Called with the number of images done and in all.

    Raises
    ------
    InputError, FileFormatError
        If maps are missing, damaged, of another size or unit than they should be, or empty.
    """
    seen, names = points.point_observations, points.images.names
    files, sizes = maps.files(names), image_sizes(points)
    rows = [np.flatnonzero(seen.image_idx == i) for i in range(len(names))]
    work = [(file, size, seen.pixel[own]) for file, size, own in zip(files, sizes, rows, strict=True)]
    read = map_work(partial(_depths_in, maps), work, progress or (lambda done, total: None))
    measured = np.full(len(seen), np.nan)
    for own, (depths, _) in zip(rows, read, strict=True):
        measured[own] = depths
    used = np.array([beside is not None for _, beside in read])
    if not used.any():
        raise InputError(f"None of the depth maps in {maps.folder} holds any depth (all are zero or not finite).")
    predicted, sigma = _depths_of_points(points)
    warnings, width = say_left_out(used, names), np.array([size[0] for size in sizes], float)
    if not maps.relative:
        beside = np.concatenate([found for _, found in read if found is not None], axis=1)
        sampled = np.concatenate(
            [own[sample(len(own))] for own, (_, found) in zip(rows, read, strict=True) if found is not None]
        )
        warnings += shifted_maps(beside, predicted[sampled], float(np.median(width)))
    ratio = np.where(predicted > 0.0, measured / np.where(predicted > 0.0, predicted, 1.0), np.nan)
    units = np.where(used, 1.0, np.nan)
    if maps.relative:
        own, said = own_units(ratio, measured, seen.image_idx, names)
        scale = _USUAL_DEPTH / float(np.median(predicted[np.isfinite(ratio)]))
        units = own / scale
    elif known is not None:
        scale, said = 1.0, common_unit(ratio * known, seen.image_idx, True)[1]
        units = units / known
    else:
        scale, said = common_unit(ratio, seen.image_idx, False)
    depth = measured / units[seen.image_idx]
    told = np.flatnonzero(np.isfinite(depth) & (predicted > 0.0))
    scene = points.transformed(Similarity(scale)) if scale != 1.0 else points
    depth, image = depth[told], seen.image_idx[told]
    difference = depth - scale * predicted[told]
    noise = fitted_noise(depth, difference, scale * sigma[told])
    cell = cells_of(image, seen.pixel[told], width[image])
    shared = shared_errors(difference / noise.sigma(depth), image, cell)
    table = PointDepths(image, seen.point_idx[told], depth, noise.sigma(depth) * shared.factors(image, cell))
    noise = replace(noise, shift=float(np.sqrt(shared.near)) * float(noise.sigma(np.median(depth))))
    return MeasuredDepths(
        scene.replace(point_depths=table), units, noise, scale, maps.relative, (shared.near, shared.far),
        (*warnings, *said),
    )  # fmt: skip


def image_sizes(scene: Scene) -> list[tuple[int, int]]:
    """Return width and height of every image."""
    of = scene.images.camera_idx
    return list(zip(scene.cameras.width[of].tolist(), scene.cameras.height[of].tolist(), strict=True))


def check_cameras(scene: Scene) -> None:
    """Refuse cameras whose images no plane holds: depth along the axis means nothing there."""
    for name in scene.cameras.models:
        if not camera_models.model(name).is_planar:
            raise InputError(f"Depth maps are for images that a plane holds; {name} images are wider. Leave them out.")


def read_map(maps: DepthMaps, file: Path, size: tuple[int, int]) -> DepthMap:
    """Read a depth map; refuse one that is probably in millimetres."""
    depth = maps.read(file, size)
    if maps.holds_millimetres(depth, file):
        raise FileFormatError(
            f"{file} holds whole numbers (median {float(np.median(depth[depth > 0])):.0f}), as millimetres are, but "
            "fractions are taken for metres. Pass --depth-scale 1000, or 1 if they are metres."
        )
    return depth


def _depths_in(
    maps: DepthMaps, image: tuple[Path | None, tuple[int, int], FloatArray]
) -> tuple[FloatArray, FloatArray | None]:
    """Depths at pixels of one image, and :data:`BESIDE` a sample of them; None where its map holds none."""
    file, size, pixels = image
    depth = np.zeros((3, 3), np.float32) if file is None else read_map(maps, file, size)
    if not (depth > 0.0).any():
        return np.full(len(pixels), np.nan), None
    some = pixels[sample(len(pixels))]
    beside = [depth_at(depth, some + size[0] * shift, np.inf) for shift in BESIDE]
    return depth_at(depth, pixels, np.inf), np.stack(beside)


def _depths_of_points(scene: Scene) -> tuple[FloatArray, FloatArray]:
    """Depths (N,) of observed points in their images, and standard deviations of them."""
    seen, poses = scene.point_observations, scene.cam_from_world
    axis = quaternion.to_matrix(poses[:, :4])[seen.image_idx, 2]
    depth = np.einsum("ni,ni->n", axis, scene.points.xyz[seen.point_idx]) + poses[seen.image_idx, 6]
    covariance = point_noise(scene).covariance[seen.point_idx]
    return depth, np.sqrt(np.einsum("ni,nij,nj->n", axis, covariance, axis))
