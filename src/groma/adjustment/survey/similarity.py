# SPDX-License-Identifier: BSD-3-Clause
r"""A robust similarity between two sets of corresponding points.

A model from images is bent by more than instruments err, and some of the measurements are wrong; neither is known
beforehand. So the scatter is found together with the similarity: of the similarities through three correspondences
each, the one with the least median of squared distances (Rousseeuw, *Least median of squares regression*, 1984); its
scatter :math:`\sigma^2 = \mathrm{med}(d^2)/2.37` (the median of :math:`\chi^2_3`) separates inliers, to which the
similarity is fitted by least squares until they stay the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np

from groma._typing import BoolArray, FloatArray
from groma.errors import InputError
from groma.evaluation.alignment import align_points
from groma.gates import NORMAL, chi_square_gate, gate
from groma.geometry import quaternion, so3
from groma.geometry.algebra import unit
from groma.scene import Scene, Similarity


@dataclass(frozen=True)
class SimilarityGates:
    """How a similarity to measurements is found, and what is said where none is."""

    draws: int = gate(500, "triples", "of correspondences tried", "derived from 1e-7 without a good one, 70 % inliers")
    apart_deg: float = gate(10.0, "degrees", "by which directions differ if axes are doubted", "cost: a refused phone")
    parallel_deg: float = gate(10.0, "degrees", "from parallel, where lines have no width", "cost: a meaning")
    near_unit: float = gate(0.05, "share", "by which lengths may miss a factor of two units", "cost: a wrong hint")
    spare: int = gate(8, "places", "to spare, from which a scatter is the noise of all", "derived from 25 % of it")
    better: float = gate(3.0, "times", "a fit must get with other axes, to name them", "chosen on random point sets")


GATES = SimilarityGates()


@dataclass(frozen=True, eq=False)
class RobustSimilarity:
    """A similarity and how well it fits."""

    #: ``target_from_source``.
    similarity: Similarity
    #: (N, 3) target less moved source.
    residuals: FloatArray
    #: (N,) which correspondences it was fitted to.
    inliers: BoolArray
    #: Standard deviation of a coordinate of the inliers.
    scatter: float
    #: Whether the points are on a line, about which the source may turn.
    on_line: bool


#: Coordinates whose squares and products are still numbers.
_LARGEST = 1e60


def robust_similarity(source: FloatArray, target: FloatArray) -> RobustSimilarity:
    """Return the similarity that most of at least three correspondences (N, 3) agree on.

    Raises
    ------
    InputError
        If there are fewer than three, all points coincide, or the target is a mirror image of the source.
    """
    if len(source) < 3:
        raise InputError(f"A similarity needs three places that are known in both frames; there are {len(source)}.")
    if (largest := max(np.abs(source).max(), np.abs(target).max())) > _LARGEST:
        raise InputError(f"Measured places or camera centres lie as far out as {largest:.3g}. Check the file.")
    found = _fitted(source, target)
    if len(source) > 3:
        mirror = np.array([-1.0, 1.0, 1.0])
        mirrored = _fitted(source * mirror, target)
        if mirrored.inliers.sum() >= found.inliers.sum() and mirrored.scatter * GATES.better < found.scatter:
            raise InputError(
                f"The measured places fit a mirror image of the scene ({mirrored.scatter:.3g} instead of "
                f"{found.scatter:.3g}): their axes are left-handed. Are two axes exchanged, such as north and east, or "
                "is z down?"
            )
    return found


def _fitted(source: FloatArray, target: FloatArray) -> RobustSimilarity:
    x, y = source - source.mean(0), target - target.mean(0)
    best, least = None, np.inf
    for rows in _triples(len(x)):
        candidate = _of(x[rows], y[rows])
        if candidate is None:
            continue
        median = float(np.median(np.sum((y - candidate.points(x)) ** 2, axis=1)))
        if median < least:
            best, least = candidate, median
    if best is None:
        best = _of_line(x, y)
        least = float(np.median(np.sum((y - best.points(x)) ** 2, axis=1)))
    inliers = np.ones(len(x), bool)
    scatter = _small_sample(len(x)) * np.sqrt(least / chi_square_gate(0.5, 3))
    limit = chi_square_gate(NORMAL.gross, 3)
    for _ in range(20):
        squares = np.sum((y - best.points(x)) ** 2, axis=1)
        floor = (1e-12 * np.abs(y).max()) ** 2
        chosen = squares <= limit * scatter**2 + floor
        if chosen.sum() < 3 or (refitted := _of(x[chosen], y[chosen])) is None:
            break
        best, unchanged, inliers = refitted, bool((chosen == inliers).all()), chosen
        squares = np.sum((y - best.points(x)) ** 2, axis=1)
        if inliers.sum() > 3:
            scatter = float(np.sqrt(squares[inliers].sum() / (3 * inliers.sum() - 7)))
        if unchanged:
            break
    whole = Similarity(
        best.scale, best.rotation, target.mean(0) + best.translation - best.scale * best.rotation @ source.mean(0)
    )
    spread = np.linalg.svd(y[inliers] - y[inliers].mean(0), compute_uv=False) / np.sqrt(max(inliers.sum(), 1))
    on_line = bool(spread[1] <= max(NORMAL.far * scatter, 1e-9 * spread[0]))
    return RobustSimilarity(whole, y - best.points(x), inliers, float(scatter), on_line)


def _triples(count: int):
    if comb(count, 3) <= GATES.draws:  # derived from three points that fix a similarity
        return [np.array(rows) for rows in combinations(range(count), 3)]
    random = np.random.default_rng(0)
    return [random.choice(count, 3, replace=False) for _ in range(GATES.draws)]


def _small_sample(count: int) -> float:
    """Rousseeuw's correction of the scale of few residuals; a similarity takes seven of three for each point."""
    return 1.0 + 5.0 / max(count - 7 / 3, 1.0)  # convention: Rousseeuw and Leroy 1987


def _of(x: FloatArray, y: FloatArray) -> Similarity | None:
    try:
        return align_points(x, y)
    except InputError:
        return None


def _of_line(x: FloatArray, y: FloatArray) -> Similarity:
    """Return a similarity between points on lines: any turn about them will do."""
    _, sizes, axes = np.linalg.svd(x)
    _, target_sizes, target_axes = np.linalg.svd(y)
    if sizes[0] == 0.0 or target_sizes[0] == 0.0:
        raise InputError("All measured places, or all camera centres, are the same. Check the file.")
    along, target_along = axes[0], target_axes[0]
    if (x @ along) @ (y @ target_along) < 0.0:
        target_along = -target_along
    rotation = turn_between(along, target_along)
    scale = float((x @ along) @ (y @ target_along)) / float((x @ along) @ (x @ along))
    return Similarity(scale, rotation, np.zeros(3))


def turn_between(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the smallest rotation (3, 3) that takes one unit vector to another."""
    axis = np.cross(first, second)
    if np.linalg.norm(axis) < 1e-12 and first @ second < 0:
        axis = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    angle = np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)
    length = np.linalg.norm(axis)
    turn: FloatArray = np.asarray(angle * axis / length if length > 0 else np.zeros(3), float)
    return so3.exp(turn[None])[0]


def upright(found: RobustSimilarity, scene: Scene, target: FloatArray) -> RobustSimilarity:
    """Return a similarity of points on a line, turned about it so that the cameras stand upright: z is up.

    Of cameras that do not roll the rows of the images are level. The direction that is most nearly perpendicular to all
    of them is up, on the side where the images have their tops, or which the cameras look away from; of cameras that
    all look the same way, the one that is nearest to their tops.

    Parameters
    ----------
    found : RobustSimilarity
        Of which the turn about the line is open.
    scene : Scene
        The source.
    target : (N, 3) float
        The measured places.
    """
    places = target[found.inliers]
    axis = np.linalg.svd(places - places.mean(0))[2][0]
    right, down, ahead = quaternion.to_matrix(scene.cam_from_world[:, :4]).transpose(1, 0, 2)
    up = np.linalg.eigh(right.T @ right + 1e-3 * ahead.T @ ahead)[1][:, 0]
    away = -float((down @ up).mean() + (ahead @ up).mean())
    up = found.similarity.directions(up if away >= 0.0 else -up)
    flat, wanted = up - (up @ axis) * axis, np.array([0.0, 0.0, 1.0]) - axis[2] * axis
    if min(np.linalg.norm(flat), np.linalg.norm(wanted)) < 0.1:
        return found
    turn = turn_between(unit(flat), unit(wanted))
    old, middle = found.similarity, places.mean(0)
    moved = Similarity(old.scale, turn @ old.rotation, turn @ (old.translation - middle) + middle)
    return RobustSimilarity(moved, found.residuals, found.inliers, found.scatter, True)
