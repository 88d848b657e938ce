# SPDX-License-Identifier: BSD-3-Clause
"""Measure the points of a scene again in its photographs.

A detector localises the keypoints of a track independently. Here one observation of each point, the one most similar to
the others in viewpoint, becomes the reference, with the patch of grey levels around it. The other observations are
refined by aligning this patch to their images (:mod:`groma.features.patch_alignment`), starting at the detected pixel
and with the affine shape that the poses and a plane facing the cameras predict. Every refined pixel has a standard
deviation, so that an adjustment can weight it.

An error of the reference pixel does not affect the others: it only selects which physical point is meant. The reference
therefore has the smallest standard deviation, that of effects which no image shows.

Each image is read twice, and each thread holds one; templates are held for a bounded number of points.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.execution import map_work
from groma.features.edge_fit import EDGES
from groma.features.images import GrayImage, smoothed
from groma.features.patch_alignment import SIZE, Alignment, Templates, align_templates, cut_templates
from groma.gates import gate
from groma.geometry.algebra import norm, perpendicular, unit
from groma.mapping.groups import grouped
from groma.mapping.noise.landmarks import project_points
from groma.scene import Scene


@dataclass(frozen=True)
class PointRefinementGates:
    """What no image tells of a place, and how much is held in memory."""

    min_correlation: float = gate(0.8, "1", "of the grey levels of two observations", "convention: four fifths")
    max_shift: float = gate(1.5, "px", "of a patch; farther it is another one", "convention: keypoints are nearer")
    points_at_once: int = gate(100_000, "points", "whose templates are held together", "cost: a hundred megabytes")


GATES = PointRefinementGates()


@dataclass(frozen=True)
class PointRefinement:
    """A scene whose points were measured again."""

    #: The scene with new pixels and standard deviations (relative to ``sigma_px``) of its point observations.
    scene: Scene
    #: (N,) whether each observation was placed anew.
    refined: BoolArray
    #: (N,) whether it defines its point; its place stays.
    reference: BoolArray
    #: The median standard deviation of a coordinate afterwards, pixels, by the images.
    sigma_px: float


def refine_points(
    scene: Scene, read: Callable[[int], GrayImage], sigma_px: float, progress: Callable[[int, int], None] | None = None
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
    if not sigma_px > 0.0:
        raise InputError(f"sigma_px must be positive; got {sigma_px}. Pass the noise of the observations, pixels.")
    table, count = scene.point_observations, scene.num_points
    by_plane, usable = _moves_in_image(scene)
    search = _Search(scene, read, by_plane, usable, _references(scene, by_plane, usable))
    pixel, deviation = table.pixel.copy(), np.full(len(table), np.inf)
    size = GATES.points_at_once
    chunks = [range(first, min(first + size, count)) for first in range(0, count, size)]
    say = progress or (lambda done, total: None)

    def step(number: int) -> Callable[[int, int], None]:
        return lambda done, images: say(number * images + done, 2 * len(chunks) * images)

    for k, points in enumerate(chunks):
        templates = search.templates(points, step(2 * k))
        for rows, found in search.positions(points, templates, step(2 * k + 1)):
            spread = np.sqrt(0.5 * np.trace(found.covariance, axis1=1, axis2=2) + EDGES.min_sigma**2)
            good = found.found & (found.correlation >= GATES.min_correlation) & (spread < sigma_px)
            good &= norm(found.pixels - table.pixel[rows]) <= GATES.max_shift
            pixel[rows[good]], deviation[rows[good]] = found.pixels[good], spread[good]
    refined, is_reference = np.isfinite(deviation), search.is_reference()
    defined = (np.bincount(table.point_idx[refined], minlength=count) > 0)[table.point_idx]
    # What kept its place errs against the defining observation, which errs itself.
    deviation[~refined] = np.where(defined[~refined], np.sqrt(2.0) * sigma_px, sigma_px)
    is_reference &= defined
    deviation[is_reference] = EDGES.min_sigma
    usual = float(np.median(deviation)) if len(deviation) else sigma_px
    observations = table.replace(pixel=pixel, sigma=deviation / usual)
    return PointRefinement(scene.replace(point_observations=observations), refined, is_reference, usual)


@dataclass(frozen=True, eq=False)
class _Search:
    """The data of the search for observations of points."""

    scene: Scene
    read: Callable[[int], GrayImage]
    #: (N, 2, 2) how each observed pixel moves with its point in the plane that faces the cameras, and if it is known.
    by_plane: FloatArray
    usable: BoolArray
    #: (P,) rows of the observations that define the points, -1 for none.
    reference: IntArray

    def is_reference(self) -> BoolArray:
        """(N,) whether each observation defines its point."""
        chosen = np.zeros(len(self.usable), dtype=bool)
        chosen[self.reference[self.reference >= 0]] = True
        return chosen

    def templates(self, points: range, progress: Callable[[int, int], None]) -> Templates:
        """Grey levels around the observations that define some points."""
        table, rows = self.scene.point_observations, self.reference[points.start : points.stop]
        found = Templates(np.zeros((len(points), SIZE, SIZE), np.float32), np.full((len(points), 2), np.nan))
        defined = np.flatnonzero(rows >= 0)
        order, starts = grouped(table.image_idx[rows[defined]], self.scene.num_images)
        chosen = [defined[order[starts[i] : starts[i + 1]]] for i in range(self.scene.num_images)]
        work = [(i, table.pixel[rows[points_here]]) for i, points_here in enumerate(chosen)]
        for points_here, cut in zip(chosen, map_work(partial(_templates_in, self.read), work, progress), strict=True):
            if cut is not None:
                found.levels[points_here], found.fractions[points_here] = cut.levels, cut.fractions
        return found

    def positions(
        self, points: range, templates: Templates, progress: Callable[[int, int], None]
    ) -> list[tuple[IntArray, Alignment]]:
        """Rows of the other observations of these points in each image, and where their templates are found."""
        table = self.scene.point_observations
        point = table.point_idx
        searched = self.usable & ~self.is_reference() & (self.reference[point] >= 0)
        searched &= (point >= points.start) & (point < points.stop)
        searched = np.flatnonzero(searched)
        shapes = self.by_plane[searched] @ np.linalg.inv(self.by_plane[self.reference[point[searched]]])
        order, starts = grouped(table.image_idx[searched], self.scene.num_images)
        work, rows = [], []
        for i in range(self.scene.num_images):
            here = order[starts[i] : starts[i + 1]]
            rows.append(searched[here])
            work.append((i, point[rows[-1]] - points.start, table.pixel[rows[-1]], shapes[here]))
        found = map_work(partial(_positions_in, self.read, templates), work, progress)
        return [(rows[i], one) for i, one in enumerate(found) if one is not None]


def _templates_in(read: Callable[[int], GrayImage], image: tuple[int, FloatArray]) -> Templates | None:
    """Templates at pixels of an image; None where there are none, and the image is not read."""
    return cut_templates(smoothed(read(image[0])), image[1]) if len(image[1]) else None


def _positions_in(
    read: Callable[[int], GrayImage], templates: Templates, image: tuple[int, IntArray, FloatArray, FloatArray]
) -> Alignment | None:
    """Where some templates are found in an image, from their pixels and shapes there; None for no template."""
    return align_templates(smoothed(read(image[0])), templates, *image[1:]) if len(image[1]) else None


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
