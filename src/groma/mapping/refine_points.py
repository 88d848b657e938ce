# SPDX-License-Identifier: BSD-3-Clause
"""Measure the points of a scene again in its photographs.

A detector places the keypoints of a track one by one. Here one observation of each point, the one most like the others,
defines it by the grey levels around it; the others are found by aligning that patch to their images
(:mod:`groma.features.patch_alignment`), from the place where they were and with the shape that poses and a plane facing
the cameras predict. Every place found comes with its standard deviation, so that an adjustment can weight it.

The error of the defining observation is no error of the others: it only says which physical point is meant. It carries
no noise but what no image can tell, :data:`SIGMA_FLOOR`.

Images are read twice, one per thread at a time; templates are held for :data:`POINTS_AT_ONCE` points.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.features.images import GrayImage
from groma.features.patch_alignment import SIZE, Templates, align_templates, cut_templates, smoothed
from groma.geometry.algebra import norm, perpendicular, unit
from groma.mapping.noise.landmarks import project_points
from groma.problem.parallel import available_cores
from groma.scene import Scene

#: What no image tells of a place: lens model, shading, surfaces that are not flat; pixels.
SIGMA_FLOOR = 0.03
#: Points whose templates are held together: a hundred megabytes.
POINTS_AT_ONCE = 100_000


@dataclass(frozen=True)
class PointRefinementOptions:
    """Options of :func:`refine_points`."""

    #: Least correlation of the grey levels of two observations of a point.
    min_correlation: float = 0.8
    #: Largest correction, pixels; a patch found farther away is another one.
    max_shift: float = 1.5
    threads: int | None = None


@dataclass(frozen=True)
class PointRefinement:
    """A scene whose points were measured again."""

    #: The scene with new pixels and standard deviations (relative to ``sigma_px``) of its point observations.
    scene: Scene
    #: (N,) whether each observation was placed anew.
    refined: BoolArray
    #: (N,) whether it defines its point; its place stays.
    reference: BoolArray
    #: The usual standard deviation of a coordinate afterwards, pixels, as far as the images tell.
    sigma_px: float


def refine_points(
    scene: Scene,
    read: Callable[[int], GrayImage],
    sigma_px: float,
    options: PointRefinementOptions | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> PointRefinement:
    """Place the point observations of a scene anew by the grey levels around them.

    Parameters
    ----------
    scene : Scene
        Posed images and points; it is not changed.
    read : callable
        Returns the grey image of an image's number; called from several threads.
    sigma_px : float
        Standard deviation of the observations as they are, pixels. What is found less well keeps its place.
    options : PointRefinementOptions, optional
        Gates and threads.
    progress : callable, optional
        Called with the number of images read and to be read.

    Returns
    -------
    PointRefinement
        The scene with better observations, and which they are.

    Raises
    ------
    InputError
        If ``sigma_px`` is not positive.

    Notes
    -----
    Points seen by one image only, near the border, or without texture keep their observations.
    """
    options = options or PointRefinementOptions()
    if not sigma_px > 0.0:
        raise InputError(f"sigma_px must be positive; got {sigma_px}. Pass the noise of the observations, pixels.")
    table = scene.point_observations
    by_plane, usable = _moves_in_image(scene)
    reference = _references(scene, by_plane, usable)
    is_reference = np.zeros(len(table), dtype=bool)
    is_reference[reference[reference >= 0]] = True
    pixel, deviation = table.pixel.copy(), np.full(len(table), np.inf)
    searched = usable & ~is_reference & (reference[table.point_idx] >= 0)
    chunks = range(0, scene.num_points, POINTS_AT_ONCE)
    done = 0
    with ThreadPoolExecutor(options.threads or available_cores()) as pool:
        for begin in chunks:
            end = min(begin + POINTS_AT_ONCE, scene.num_points)
            templates = _blank(end - begin)

            def cut(image: int, begin=begin, end=end, templates=templates) -> None:
                rows = reference[begin:end]
                points = np.flatnonzero((rows >= 0) & (table.image_idx[rows] == image))
                if len(points):
                    found = cut_templates(smoothed(read(image)), table.pixel[rows[points]])
                    templates.levels[points], templates.fractions[points] = found.levels, found.fractions

            def align(image: int, begin=begin, end=end, templates=templates) -> None:
                point = table.point_idx
                rows = np.flatnonzero(searched & (table.image_idx == image) & (point >= begin) & (point < end))
                if len(rows) == 0:
                    return
                shapes = by_plane[rows] @ np.linalg.inv(by_plane[reference[point[rows]]])
                found = align_templates(
                    smoothed(read(image)), templates, point[rows] - begin, table.pixel[rows], shapes
                )
                good = found.found & (found.correlation >= options.min_correlation)
                good &= norm(found.pixels - table.pixel[rows]) <= options.max_shift
                spread = np.sqrt(0.5 * np.trace(found.covariance, axis1=1, axis2=2) + SIGMA_FLOOR**2)
                good &= spread < sigma_px
                pixel[rows[good]], deviation[rows[good]] = found.pixels[good], spread[good]

            for work in (cut, align):
                for _ in pool.map(work, range(scene.num_images)):
                    done += 1
                    if progress is not None:
                        progress(done, 2 * len(chunks) * scene.num_images)
    refined = np.isfinite(deviation)
    defined = (np.bincount(table.point_idx[refined], minlength=scene.num_points) > 0)[table.point_idx]
    # What kept its place errs against the defining observation, which errs itself.
    deviation[~refined] = np.where(defined[~refined], np.sqrt(2.0) * sigma_px, sigma_px)
    is_reference &= defined
    deviation[is_reference] = SIGMA_FLOOR
    usual = float(np.median(deviation)) if len(deviation) else sigma_px
    observations = table.replace(pixel=pixel, sigma=deviation / usual)
    return PointRefinement(scene.replace(point_observations=observations), refined, is_reference, usual)


def _blank(count: int) -> Templates:
    return Templates(np.zeros((count, SIZE, SIZE), np.float32), np.full((count, 2), np.nan))


def _moves_in_image(scene: Scene) -> tuple[FloatArray, BoolArray]:
    """How each observed pixel (N, 2, 2) moves with its point in the plane that faces the cameras; where it is known."""
    table = scene.point_observations
    normal = _sum(_toward_cameras(scene), table.point_idx, scene.num_points)
    basis = np.stack(perpendicular(unit(np.where(norm(normal)[:, None] > 0.0, normal, [0.0, 0.0, 1.0]))), axis=-1)
    _, by_world = project_points(scene, table.image_idx, scene.points.xyz[table.point_idx])
    moves = by_world @ basis[table.point_idx]
    usable = np.isfinite(moves).all(axis=(1, 2))
    moves[~usable] = np.eye(2)
    usable &= np.abs(np.linalg.det(moves)) > 1e-12 * (moves**2).sum(axis=(1, 2))
    moves[~usable] = np.eye(2)
    return moves, usable


def _toward_cameras(scene: Scene) -> FloatArray:
    """Unit vectors (N, 3) from the points to the cameras that observe them."""
    table = scene.point_observations
    return unit(scene.cam_centers_in_world[table.image_idx] - scene.points.xyz[table.point_idx])


def _references(scene: Scene, by_plane: FloatArray, usable: BoolArray) -> IntArray:
    """Rows (P,) of the observations that define the points: seen from the middle, at the middle size; -1 for none."""
    table, count = scene.point_observations, scene.num_points
    point = table.point_idx
    view = np.hstack([_toward_cameras(scene), 0.5 * np.log(np.abs(np.linalg.det(by_plane)))[:, None]])
    middle = _sum(view, point, count) / np.maximum(np.bincount(point, minlength=count), 1)[:, None]
    apart = np.where(usable, norm(view - middle[point]), np.inf)
    order = np.lexsort((apart, point))
    best = order[np.flatnonzero(np.diff(point[order], prepend=-1))]
    reference = np.full(count, -1)
    best = best[usable[best]]
    reference[point[best]] = best
    return reference


def _sum(rows: FloatArray, owner: IntArray, count: int) -> FloatArray:
    """Sums (count, k) of rows (N, k) by owner."""
    total = np.zeros((count, rows.shape[1]))
    for column in range(rows.shape[1]):
        total[:, column] = np.bincount(owner, weights=rows[:, column], minlength=count)
    return total


__all__ = ["PointRefinement", "PointRefinementOptions", "refine_points"]
