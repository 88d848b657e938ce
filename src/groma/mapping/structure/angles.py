# SPDX-License-Identifier: BSD-3-Clause
r"""Which planes and directions are parallel, and which are at right angles.

The normal of a plane and a direction are unit vectors with a covariance alike, so all pairs among them are tried
together. At a right angle :math:`x = u \cdot v` is normal, with :math:`u^\top\Sigma_v u + v^\top\Sigma_u v`; of
parallel vectors the two components of v across u are, with :math:`B(\Sigma_u + \Sigma_v)B^\top`.

Angles that are meant to be right deviate by t beyond that noise; of the others one half is nearly right, with a normal
deviation of two degrees, and the other half is spread evenly. For each kind of pair, the share of those that are
right is estimated for every t up to a bound, and what follows is averaged over t, each as likely as the pairs make it
(:mod:`groma.estimators.membership`). An angle that is surely a little off is therefore no right one, and a house whose
angles are all a degree off has no right angles, and none is forced on it. As pairs of the same vectors are not
independent, they tell of t as much as the vectors do that they are of.

What share is right, and how exactly, is told by angles that are known well. An uncertain one, as of the normal of a
narrow plane, is right where nearly all of those are, as long as noise hardly takes it out of the layer.

Many pairs are tried, so they are kept, the surest first, only as long as the expected share of wrong ones among them,
the mean of :math:`1 - P`, stays small: the false discovery rate.

What no pair tells, all may: of two boxes turned by a third of a degree each face alone may be parallel to one of the
other box; all together are not. So pairs are imposed on the vectors one by one, the surest first, each vector with a
deviation of its own of :math:`t/\sqrt2`. A pair that contradicts those before it, by a chi-square test with the
covariances that these leave, is dropped; that a right one is among the dropped has a probability of 5 %.

An adjustment holds them with the upper end of the one-sigma interval of t, which is large where pairs are few or
vectors uncertain. As n parallel planes have :math:`n(n-1)/2` pairs, the variance of a pair grows with the pairs that
its two vectors are in: together they count as often as the deviation of one vector does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.directions import DIRECTIONS, DirectionSet
from groma.estimators.membership import Candidates, averaged_memberships
from groma.estimators.plane_search import PlaneSet
from groma.gates import NORMAL, chi_square_gate, gate
from groma.geometry.algebra import perpendicular, unit
from groma.mapping.structure.relations import Pairs
from groma.scene import Scene
from groma.scene.survey import Kind

#: Relations between planes and directions, by the number of directions in a pair: parallel, and at right angles.
_KINDS = (
    ("parallel_planes", "perpendicular_planes"),
    ("plane_across_direction", "plane_along_direction"),
    ("parallel_directions", "perpendicular_directions"),
)
#: Components of known directions that are the same.
_SAME = 1e-6
#: Pairs that are tried together, and columns that are taken off a covariance at once (cost: memory, time).
_TOGETHER, _LATE = 4096, 64
#: A unit vector and its covariance.
Vector = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class AngleGates:
    """Which angles are right."""

    layer: float = gate(0.15, "rad", "window around right and zero angles of the mixture", "chosen on synthetic rooms")
    most: float = gate(8.7e-3, "rad", "that angles deviate which are meant to be right", "convention: half a degree")
    held: float = gate(1e-4, "rad", "by which right angles are held at least", "cost: conditioning of an adjustment")
    tried: int = gate(100, "deviations", "from the least to the most", "cost: each a twentieth larger than the last")
    known: float = gate(0.01, "rad", "deviation of an angle that tells of others", "chosen on synthetic rooms")


GATES = AngleGates()


@dataclass(frozen=True)
class Angles:
    """Pairs of unit vectors that are parallel or at right angles."""

    #: (M, 2) numbers of the vectors, the smaller first.
    pairs: IntArray
    #: (M,) whether they are at right angles; the others are parallel.
    right: BoolArray
    #: (M,) probability that the pair is none by chance.
    probability: FloatArray
    #: (M,) standard deviation of the angle in an adjustment that holds all of them, radians.
    sigma: FloatArray


def angles_between(
    planes: PlaneSet, directions: DirectionSet, lines: tuple[Pairs, Pairs], vertical: Vector | None, level: float
) -> dict[str, Pairs]:
    """Find relations between planes and directions, by their names; deviations are radians.

    ``lines`` are those on planes and those along directions. The vertical, if it is known, has the number after the
    last direction.
    """
    inside = _inside(*lines, len(planes), len(directions))
    normals, noise, inside = _known_by_directions(planes, directions, inside, level)
    vectors = [normals, directions.vectors, *([] if vertical is None else [vertical[0][None]])]
    covariance = [noise, directions.covariance, *([] if vertical is None else [vertical[1][None]])]
    is_direction = np.arange(sum(map(len, vectors))) >= len(planes)
    num, implied = len(planes), np.zeros((len(is_direction), len(is_direction)), bool)
    implied[:num, num : num + len(directions)] = inside
    found = right_angles(np.concatenate(vectors), np.concatenate(covariance), is_direction, level, implied)
    of_kind, relations = (found.pairs >= num).sum(axis=1), {}
    for number, names in enumerate(_KINDS):
        for right, name in enumerate(names):
            rows = (of_kind == number) & (found.right == bool(right))
            pairs = found.pairs[rows] - num * (found.pairs[rows] >= num)
            relations[name] = Pairs(pairs, found.probability[rows], found.sigma[rows])
    return relations


def _inside(on: Pairs, along: Pairs, num_planes: int, num_directions: int) -> BoolArray:
    """(K, D) whether a line on a plane is along a direction, which lies in the plane then."""
    inside = np.zeros((num_planes, num_directions), bool)
    direction = np.full(int(max(on.pairs[:, 0].max(initial=0), along.pairs[:, 0].max(initial=0))) + 1, -1)
    direction[along.pairs[:, 0]] = along.pairs[:, 1]
    plane, of_line = on.pairs[:, 1], direction[on.pairs[:, 0]]
    inside[plane[of_line >= 0], of_line[of_line >= 0]] = True
    return inside


def _known_by_directions(
    planes: PlaneSet, directions: DirectionSet, inside: BoolArray, level: float
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Normals (K, 3) and covariances (K, 3, 3), those that say nothing with the directions that lie in their planes.

    Directions that contradict a plane, by a chi-square test of all of them, tell nothing about it. Planes that are
    known well enough stay as they are: of two boxes that are turned by little a common direction may be neither's.
    Also returned are the directions (K, D) that were used.
    """
    normals, covariance = planes.planes[:, :3].copy(), planes.covariance[:, :3, :3].copy()
    inside = inside & (np.linalg.eigvalsh(covariance)[:, -1] > GATES.known**2)[:, None]
    for k in np.flatnonzero(inside.any(axis=1)).tolist():
        normal, of = normals[k], np.flatnonzero(inside[k])
        axes, vectors = np.stack(perpendicular(normal)), directions.vectors[of]
        own, slope, off = axes @ covariance[k] @ axes.T, vectors @ axes.T, vectors @ normal
        noise = np.diag(np.einsum("i,dij,j->d", normal, directions.covariance[of], normal) + DIRECTIONS.parallel**2)
        total = slope @ own @ slope.T + noise
        if off @ np.linalg.solve(total, off) > chi_square_gate(1.0 - level, len(of)):
            inside[k] = False
            continue
        gain = np.linalg.solve(total, slope @ own).T
        normals[k] = unit(normal - axes.T @ (gain @ off))
        covariance[k] = axes.T @ (own - gain @ slope @ own) @ axes
    return normals, covariance, inside


def vertical_of(scene: Scene) -> Vector | None:
    """Return the direction that was measured in the cameras, if it is one and the same in all: gravity."""
    table = scene.known_directions
    table = table.take((table.kind == Kind.IMAGE) & ~table.rejected)
    if len(table) == 0 or np.abs(table.vector - table.vector[0]).max() > _SAME:
        return None
    vector, information = table.vector[0], float((table.sigma**-2.0).sum())
    return vector, (np.eye(3) - np.outer(vector, vector)) / information


def right_angles(
    vectors: FloatArray,
    covariance: FloatArray,
    kind: BoolArray,
    level: float,
    implied: BoolArray | None = None,
    gates: AngleGates = GATES,
) -> Angles:
    """Find parallel and perpendicular pairs.

    Parameters
    ----------
    vectors : (N, 3) float64
        Unit vectors; their signs have no meaning.
    covariance : (N, 3, 3) float64
        Their covariances, square radians.
    kind : (N,) bool
        Vectors of two kinds, planes and directions: pairs of other kinds deviate by other angles.
    level : float
        Level of the chi-square tests.
    implied : (N, N) bool, optional
        Pairs, the smaller number first, that are used in the vectors already: they tell nothing of how exact angles
        are.
    gates : AngleGates
        What is right.
    """
    found, offset, variance, right = _near(vectors, covariance, gates)
    if len(found) == 0:
        return Angles(found, right, np.zeros(0), np.zeros(0))
    live = np.column_stack([np.ones(len(found)), (~right).astype(np.float64)])
    uncertain = np.sqrt((variance * live).max(axis=1))
    telling = uncertain < gates.known
    if implied is not None:
        telling &= ~implied[found[:, 0], found[:, 1]]
    exact = variance + DIRECTIONS.parallel**2 * live
    family = 2 * kind[found].sum(axis=1) + right
    even = np.where(right, 0.5 / gates.layer, 1.0 / (np.pi * gates.layer**2))
    told = averaged_memberships(
        Candidates(
            owner=family,
            offset=offset,
            variance=exact,
            unit=live,
            # The nearly right deviate by the geometric mean of the layer and of the most that is right.
            clutter=0.5 * even + 0.5 * _normal(offset, exact + gates.most * gates.layer * live),
            counted=telling,
            group=family,
        ),
        np.full(6, gates.most),
        _worth(found[telling], family[telling], len(vectors)),
    )
    squared = (offset**2 / (exact + (told.deviation[family, None] * live) ** 2)).sum(axis=1)
    # What noise may take out of the layer is not among what is tried.
    passed = NORMAL.far * uncertain < gates.layer
    passed &= squared < np.where(right, *(chi_square_gate(1.0 - level, freedom) for freedom in (1, 2)))
    order = np.flatnonzero(passed)[np.argsort(-told.probability[passed], kind="stable")]
    wrong = np.cumsum(1.0 - told.probability[order]) / np.arange(1, len(order) + 1)
    kept = order[wrong <= NORMAL.significance]
    own = 0.5 * (DIRECTIONS.parallel**2 + np.mean(told.deviation[family[kept]] ** 2)) if len(kept) else 0.0
    kept = np.sort(kept[_consistent(vectors, covariance + own * np.eye(3), found[kept], right[kept], gates)])
    times = np.bincount(found[kept].ravel(), minlength=len(vectors))
    per_vector = max(len(kept) / max(np.count_nonzero(times), 1), 1.0)
    deviation, axes = np.zeros(6), live > 0.0
    for k in np.unique(family[kept]):
        rows = kept[(family[kept] == k) & telling[kept]]
        deviation[k] = _upper_end(offset[rows][axes[rows]] ** 2, variance[rows][axes[rows]], per_vector, gates)
    sigma = deviation[family[kept]] * np.sqrt(np.maximum(0.25 * times[found[kept]].sum(axis=1), 1.0))
    return Angles(found[kept], right[kept], told.probability[kept], sigma)


def _consistent(
    vectors: FloatArray, covariance: FloatArray, pairs: IntArray, right: BoolArray, gates: AngleGates
) -> BoolArray:
    """Which pairs (M,) agree with those that agree before them; vectors have their deviations in their covariances.

    The state is a turn of each vector along two axes across it, as in a Kalman filter, with the covariance ``joint``
    minus ``late @ late.T``, which is taken off now and then. Pairs that follow from those before stay so, so all up to
    the next one that changes the state are tried together.
    """
    axes, size, one = np.stack(perpendicular(vectors), axis=1), 2 * len(vectors), gates.held**2
    turn, joint = np.zeros((len(vectors), 2)), np.zeros((len(vectors), 2, len(vectors), 2))
    joint[np.arange(len(vectors)), :, np.arange(len(vectors))] = axes @ covariance @ np.swapaxes(axes, 1, 2)
    joint, late, used = joint.reshape(size, size), np.zeros((size, _LATE)), 0
    limit = np.array([chi_square_gate(NORMAL.significance / max(len(pairs), 1), freedom) for freedom in (2, 1)])
    places = (2 * pairs[:, :, None] + np.arange(2)).reshape(-1, 4)
    agree, start, tried = np.zeros(len(pairs), bool), 0, 1
    while start < len(pairs):
        rows = slice(start, start + min(tried, _TOGETHER))
        place = places[rows]
        off, slope = _deviation(vectors, axes, turn, pairs[rows], right[rows])
        shared = slope @ late[place, :used]
        known = slope @ joint[place[:, :, None], place[:, None]] @ np.swapaxes(slope, 1, 2)
        known -= shared @ np.swapaxes(shared, 1, 2)
        follows = np.trace(known, axis1=1, axis2=2) < one
        solved = np.linalg.solve(known + one * np.eye(2), off[:, :, None])[:, :, 0]
        agrees = (off * solved).sum(axis=1) < limit[right[rows].astype(int)]
        changes = np.flatnonzero(~follows & agrees)
        agree[rows] = follows
        start, tried = start + len(follows), 2 * tried
        if len(changes):
            k = changes[0]
            start, tried = rows.start + k + 1, max(k, 1)
            agree[start - 1], agree[start:] = True, False
            moved = joint[:, place[k]] @ slope[k].T - late[:, :used] @ shared[k].T
            turn -= (moved @ solved[k]).reshape(turn.shape)
            late[:, used : used + 2] = np.linalg.solve(np.linalg.cholesky(known[k] + one * np.eye(2)), moved.T).T
            used += 1 if right[start - 1] else 2
            if used > _LATE - 2:
                joint, used = joint - late[:, :used] @ late[:, :used].T, 0
    return agree


def _deviation(
    vectors: FloatArray, axes: FloatArray, turn: FloatArray, pairs: IntArray, right: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Deviations of pairs (M, 2) from their relation, the second of right angles zero; derivatives (M, 2, 4)."""
    ends = [vectors[end] + np.einsum("mk,mki->mi", turn[end], axes[end]) for end in pairs.T]
    u, v = (end / np.linalg.norm(end, axis=1)[:, None] for end in ends)
    across = np.stack(perpendicular(u), axis=1)
    across[right] = np.stack([v[right], np.zeros_like(v[right])], axis=1)
    other = across.copy()
    other[right, 0] = u[right]
    sign = np.where(right, 1.0, -np.sign(np.einsum("mi,mi->m", u, v)))
    first, second = (np.swapaxes(axes[end], 1, 2) for end in pairs.T)
    slope = np.concatenate([sign[:, None, None] * (across @ first), other @ second], axis=2)
    return np.einsum("mki,mi->mk", across, np.where(right[:, None], u, v)), slope


def _worth(pairs: IntArray, family: IntArray, num: int) -> FloatArray:
    """(6,) vectors per pair of each kind, at most one: pairs of the same vectors tell the same."""
    worth = np.ones(6)
    for k in np.unique(family):
        rows = family == k
        worth[k] = min(np.count_nonzero(np.bincount(pairs[rows].ravel(), minlength=num)) / rows.sum(), 1.0)
    return worth


def _normal(offset: FloatArray, variance: FloatArray) -> FloatArray:
    """Normal densities of offsets (M, 2) along independent axes."""
    return np.exp(-0.5 * (offset**2 / variance).sum(axis=1)) / np.sqrt((2.0 * np.pi * variance).prod(axis=1))


def _upper_end(squared: FloatArray, variance: FloatArray, pairs_per_vector: float, gates: AngleGates) -> float:
    """Upper end of the confidence interval of t; pairs of few vectors tell less than as many independent ones."""
    tried = np.geomspace(gates.held, gates.most, gates.tried)
    total = variance + tried[:, None] ** 2
    surprise = (np.log(total) + squared / total).sum(axis=1)
    return float(tried[np.flatnonzero(surprise <= surprise.min() + pairs_per_vector)[-1]])


def _near(
    vectors: FloatArray, covariance: FloatArray, gates: AngleGates
) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
    """Pairs near a right angle or none, offsets from it (M, 2) along the axes of their noise, variances there.

    The second axis of right angles is none: an offset of zero with the density of one.
    """
    first, second = np.triu_indices(len(vectors), 1)
    cosine = np.einsum("mi,mi->m", vectors[first], vectors[second])
    right = np.abs(cosine) < np.sin(gates.layer)
    near = np.flatnonzero(right | (np.abs(cosine) > np.cos(gates.layer)))
    first, second, cosine, right = first[near], second[near], cosine[near], right[near]
    one, other = vectors[first], vectors[second]
    offset, variance = np.zeros((len(near), 2)), np.full((len(near), 2), 0.5 / np.pi)
    offset[:, 0] = cosine
    variance[:, 0] = np.einsum("mi,mij,mj->m", one, covariance[second], one)
    variance[:, 0] += np.einsum("mi,mij,mj->m", other, covariance[first], other)
    rows = np.flatnonzero(~right)
    basis = np.stack(perpendicular(one[rows]), axis=1)
    noise = basis @ (covariance[first[rows]] + covariance[second[rows]]) @ np.swapaxes(basis, 1, 2)
    variance[rows], axes = np.linalg.eigh(noise)
    offset[rows] = np.einsum("nab,nai,ni->nb", axes, basis, other[rows])
    return np.column_stack([first, second]), offset, variance, right
