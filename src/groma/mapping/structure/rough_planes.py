# SPDX-License-Identifier: BSD-3-Clause
"""What lies on planes, planes whose members deviate fitted to these members, and pieces of rough walls joined.

The search for planes finds where features lie on a plane within their noise: of a rough wall some panel, or a plane
that cuts through several. How far members of the wall deviate is estimated afterwards, around that plane. A plane
fitted to the members with this deviation in their noise is the one of most likelihood, and tells again what its members
are. In the end every plane is fitted to its members: of what it was found in, other planes may have taken a part, and
the normal of a narrow one then is off by many of the deviations that it had.

Of a rough wall several such planes may have been found. Planes beside one with more members, within the layer in which
members are told from clutter, are tried as pieces of one wall where members of one of them deviate, or where three are
turned against each other by more than their noise: then each is a cut through parts that stand at different depths. A
plane is fitted to the members of all, with the deviation in their noise. Of what it is fitted to, those pieces stay of
which most is on it then, by the same tests. Parallel planes that their own noise explains are not joined: nothing says
that they are parts of something rough. What is on one piece deviates alike, so the covariance of such a plane counts
pieces, not features. Steps of a stepped wall are no pieces of one: the plane through them is turned against all of them
alike, while the turns of pieces scatter around that of the whole. So the mean turn of the pieces has to be none, by
their covariances, by how they scatter beyond these, and by that of the whole. A piece may have held landmarks of
another plane, a panel before the wall: they are free again once it has become part of the wall.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.estimators.plane_fit import PlaneFit, fit_plane, plane_motions
from groma.estimators.plane_search import PlaneSet, connected_to
from groma.execution import map_in_threads
from groma.gates import NORMAL, chi_square_gate
from groma.geometry.algebra import perpendicular
from groma.mapping.structure.relations import Landmarks, Pairs, RelationGates, on_planes

#: Rounds in which planes are fitted to members and members told again (cost: time; the second moves planes little).
_ROUNDS = 2
#: Unknowns of a plane (derived from geometry).
_UNKNOWNS = 3

#: What counts as beside a plane.
_RELATIONS = RelationGates()
#: Planes, and the points and the lines on them.
_Told = tuple[PlaneSet, Pairs, Pairs]


def on_fitted_planes(
    marks: Landmarks,
    planes: PlaneSet,
    level: float,
    least: tuple[float, float],
    min_support: int,
    again: Callable[[PlaneSet], PlaneSet] | None = None,
) -> tuple[PlaneSet, Pairs, Pairs]:
    """Return the planes fitted to what lies on them, with how far it deviates, and the points and lines on planes.

    Parameters
    ----------
    marks : Landmarks
        Points and lines with their noise.
    planes : PlaneSet
        Planes as found.
    level, least
        As :func:`~groma.mapping.structure.relations.on_planes` has them.
    min_support : int
        Least number of members that tell how far they deviate, a segment counts as two: with fewer the members of a
        plane stay.
    again : callable, optional
        Returns planes and others beside them, in what has no label of theirs: what became a piece of a wall may have
        held landmarks of planes that were not found.

    Returns
    -------
    planes : PlaneSet
        Those that are pieces of one rough wall are one, in the place of the one with most members.
    points, lines : Pairs
        What lies on them.
    """
    fitted = partial(_fitted_in_turn, marks, level=level, least=least, min_support=min_support, known={})
    pieces = fitted(planes)
    into, joined = _joined(marks, *pieces, fitted, level)
    told, before = pieces if joined is pieces[0] else fitted(joined), pieces[1:]
    settled = len(told[0])
    if again is not None and joined is not pieces[0] and len(more := again(_released(marks, *told))) > settled:
        found = fitted(more)
        number, joined = _joined(marks, *found, fitted, level, settled)
        told = found if joined is found[0] else fitted(joined)
        fresh = np.r_[np.full(settled, -1), len(into) + np.arange(len(more) - settled)]
        before = tuple(one.joined(new.renumbered(fresh)) for one, new in zip(before, found[1:], strict=True))
        into = np.concatenate([number[into], number[settled:]])
    planes, points, lines = told
    # A plane was found in features of which others may have taken some: they say nothing about where it is.
    enough = np.flatnonzero(_num_members(points, lines, len(planes)) > _UNKNOWNS)
    planes = _fitted(marks, planes, points, lines, deviations(points, lines, len(planes)), enough)
    return _with_shared_deviations(marks, planes, points, lines, before, into), points, lines


def _fitted_in_turn(
    marks: Landmarks, planes: PlaneSet, level: float, least: tuple[float, float], min_support: int, known: dict
) -> _Told:
    """Tell members of planes and fit planes to them in turn."""
    points, lines = on_planes(marks, planes, level, least, known)
    for _ in range(_ROUNDS):
        rough = deviations(points, lines, len(planes))
        rough[_num_members(points, lines, len(planes)) < min_support] = 0.0
        if not rough.any():
            break
        planes = _fitted(marks, planes, points, lines, rough, np.flatnonzero(rough))
        points, lines = on_planes(marks, planes, level, least, known)
    return planes, points, lines


def _joined(
    marks: Landmarks,
    planes: PlaneSet,
    points: Pairs,
    lines: Pairs,
    fitted: Callable[[PlaneSet], _Told],
    level: float,
    settled: int = 0,
) -> tuple[IntArray, PlaneSet]:
    """Into which plane each goes, and the planes with pieces of rough walls joined: the same ones where none are.

    Of the first ones, ``settled``, it is known that they are no pieces of each other.
    """
    num = len(planes)
    rough, members = deviations(points, lines, num), _num_members(points, lines, num)
    free = members > 0
    groups: list[list[int]] = []
    wholes: list[PlaneSet] = []
    for k in np.argsort(-members, kind="stable").tolist():
        if not free[k]:
            continue
        free[k] = False  # a piece has fewer members than what it is a piece of
        group = _beside(marks, planes, points, lines, k, free)
        if max(group) < settled:
            continue
        if not rough[group].any() and not _contradict(planes, group, level):
            continue
        whole, group = _whole(marks, planes, points, lines, group, rough[group].max(), fitted)
        if len(group) > 1:
            groups.append(group)
            wholes.append(whole)
            free[group] = False
    return _with_wholes(planes, groups, wholes)


def _beside(marks: Landmarks, planes: PlaneSet, points: Pairs, lines: Pairs, first: int, free: np.ndarray) -> list[int]:
    """A plane, then those in its layer that are connected with it, directly or by others of them."""
    plane = planes.planes[first]
    turned = np.arccos(np.clip(np.abs(planes.planes[:, :3] @ plane[:3]), 0.0, 1.0))
    near = [
        b
        for b in np.flatnonzero(free & (turned < _RELATIONS.competing)).tolist()
        if np.median(np.abs(planes.places[b] @ plane[:3] + plane[3])) < _RELATIONS.layer * planes.band[first]
    ]
    group, reached = [first], [first]
    while reached:
        places = np.concatenate([planes.places[b] for b in group])
        reached = [b for b in near if connected_to(places, *_features(marks, points, lines, b), plane).any()]
        group += reached
        near = [b for b in near if b not in reached]
    return group


def _whole(
    marks: Landmarks,
    planes: PlaneSet,
    points: Pairs,
    lines: Pairs,
    group: list[int],
    rough: float,
    fitted: Callable[[PlaneSet], _Told],
) -> tuple[PlaneSet, list[int]]:
    """One plane for those of a group that are pieces of it, and which these are: the first alone if there are none.

    The first fit takes members to deviate by ``rough``, pixels.
    """
    whole = planes
    while len(group) > 1:
        new = np.full(len(planes), -1)
        new[group] = 0
        of_group = points.renumbered(new), lines.renumbered(new)
        whole = _fitted(marks, _as_one(planes, group), *of_group, np.array([rough]), np.zeros(1, int))
        whole, *found = fitted(whole)
        on_whole = found[0], found[1]
        parts = [_share(points, lines, b, *on_whole) > NORMAL.majority for b in group]
        if all(parts) and deviations(*on_whole, 1)[0]:
            known = _with_shared_deviations(marks, whole, *on_whole, (points, lines), np.where(new < 0, 1, 0))
            if not _leans(known, planes, group):
                break
            return whole, group[:1]
        group = [b for b, part in zip(group, parts, strict=True) if part] if parts[0] and not all(parts) else group[:1]
    return whole, group


def _leans(whole: PlaneSet, planes: PlaneSet, group: list[int]) -> bool:
    """Whether a plane leans against what may be its pieces, beyond how these are turned against each other.

    The roughness of a wall displaces parts of it: it turns a piece the more, the less that extends.
    """
    basis = np.stack(perpendicular(whole.planes[0, :3]))
    turned, noise = _turned(basis, planes, group)
    scatter = np.array([np.cov(planes.places[b] @ basis.T, rowvar=False) for b in group])
    scatter += 1e-12 * np.trace(scatter, axis1=1, axis2=2)[:, None, None] * np.eye(2)  # places may be on one line
    shape = np.asarray(np.linalg.inv(scatter), dtype=np.float64)
    information = np.linalg.inv(noise + _spread(turned, noise, shape, 2 * len(group) - 2) * shape)
    known = np.linalg.inv(information.sum(axis=0))
    mean = known @ np.einsum("kab,kb->a", information, turned)
    known = known + basis @ whole.covariance[0, :3, :3] @ basis.T
    return float(mean @ np.linalg.solve(known, mean)) > chi_square_gate(NORMAL.significance, 2)


def _contradict(planes: PlaneSet, group: list[int], level: float) -> bool:
    """Whether planes are turned against each other beyond their noise, three or more: two may be two walls."""
    if len(group) < 3:
        return False
    basis = np.stack(perpendicular(planes.planes[group[0], :3]))
    turned, noise = _turned(basis, planes, group)
    shape = np.broadcast_to(np.eye(2), noise.shape)
    return _spread(turned, noise, shape, chi_square_gate(1.0 - level, 2 * len(group) - 2)) > 0.0


def _turned(basis: FloatArray, planes: PlaneSet, group: list[int]) -> tuple[FloatArray, FloatArray]:
    """Turns (K, 2) of planes against the normal of a basis, and their covariances (K, 2, 2)."""
    normal = planes.planes[group, :3]
    sign = np.sign(normal @ np.cross(basis[0], basis[1]))
    return sign[:, None] * normal @ basis.T, basis @ planes.covariance[group, :3, :3] @ basis.T


def _spread(turned: FloatArray, noise: FloatArray, shape: FloatArray, expected: float) -> float:
    """By how many covariances ``shape`` (K, 2, 2) turns (K, 2) scatter beyond their noise: chi-square is as expected.

    The chi-square about the mean falls with the variance and is convex: Newton's steps from zero never pass the root.
    """
    variance = 0.0
    while True:
        information = np.linalg.inv(noise + variance * shape)
        mean = np.linalg.solve(information.sum(axis=0), np.einsum("kab,kb->a", information, turned))
        pull = np.einsum("kab,kb->ka", information, turned - mean)
        excess = float(np.einsum("ka,ka->", turned - mean, pull)) - expected
        step = excess / max(float(np.einsum("ka,kab,kb->", pull, shape, pull)), 1e-300)
        if expected <= 0.0 or not step > 1e-12 * variance:  # nothing is expected of a plane alone
            return variance
        variance += step


def _as_one(planes: PlaneSet, group: list[int]) -> PlaneSet:
    """The first plane of a group with all that the group has; what other planes have is theirs."""
    new = np.ones(len(planes), np.int64)
    new[group] = 0
    return replace(
        planes.take(np.array(group[:1]), new),
        support=planes.support[group].sum(keepdims=True),
        places=[np.concatenate([planes.places[b] for b in group])],
    )


def _with_wholes(planes: PlaneSet, groups: list[list[int]], wholes: list[PlaneSet]) -> tuple[IntArray, PlaneSet]:
    """The new number of each plane, and the planes with each group replaced by its whole, where its first was."""
    if not groups:
        return np.arange(len(planes)), planes
    into, plane, covariance = np.arange(len(planes)), planes.planes.copy(), planes.covariance.copy()
    support, places = planes.support.copy(), list(planes.places)
    for group, whole in zip(groups, wholes, strict=True):
        first = group[0]
        into[group], plane[first], covariance[first] = first, whole.planes[0], whole.covariance[0]
        support[first], places[first] = whole.support[0], whole.places[0]
    rows = np.unique(into)
    new = np.searchsorted(rows, into)
    joined = replace(planes, planes=plane, covariance=covariance, support=support, places=places)
    return new, joined.take(rows, new)


def _features(marks: Landmarks, points: Pairs, lines: Pairs, plane: int) -> tuple[FloatArray, FloatArray]:
    """(M, 3) points and segment ends on a plane, and (M,) the distances at which they have their neighbours."""
    point, line = points.pairs[points.pairs[:, 1] == plane, 0], lines.pairs[lines.pairs[:, 1] == plane, 0]
    return (
        np.concatenate([marks.points[point], marks.segments[line].reshape(-1, 3)]),
        np.concatenate([marks.point_spacing[point], marks.end_spacing[line].ravel()]),
    )


def _share(points: Pairs, lines: Pairs, plane: int, whole_points: Pairs, whole_lines: Pairs) -> float:
    """Share of the members of a plane that are on the whole; a line counts as its two ends."""
    number = right = 0
    for weight, mine, whole in ((1, points, whole_points), (2, lines, whole_lines)):
        own = mine.pairs[mine.pairs[:, 1] == plane, 0]
        number += weight * len(own)
        right += weight * int(np.isin(own, whole.pairs[:, 0]).sum())
    return right / max(number, 1)


def _num_members(points: Pairs, lines: Pairs, num: int) -> np.ndarray:
    """(num,) members of each plane; a line counts as its two ends."""
    return points.counts(num) + 2 * lines.counts(num)


def deviations(points: Pairs, lines: Pairs, num: int) -> FloatArray:
    """(num,) how far members of each plane deviate, pixels; 0 where their noise explains it."""
    rough = np.zeros(num)
    for found in (points, lines):
        np.maximum.at(rough, found.pairs[:, 1], found.deviation)
    return rough


def _fitted(
    marks: Landmarks, planes: PlaneSet, points: Pairs, lines: Pairs, rough: FloatArray, which: IntArray
) -> PlaneSet:
    """Return the planes, some fitted to their members, which deviate and are weighted by their probabilities."""
    plane, covariance = planes.planes.copy(), planes.covariance.copy()

    def fit(k: int) -> PlaneFit:
        places, noise, away, weight = members_of(marks, points, lines, k, rough[k])
        return fit_plane(places, noise + away[:, None, None] ** 2 * np.eye(3), weight)

    for k, found in zip(which.tolist(), map_in_threads(fit, which.tolist()), strict=True):
        plane[k], covariance[k] = found.plane * np.sign(found.plane[:3] @ plane[k, :3]), found.covariance
    return replace(planes, planes=plane, covariance=covariance)


def members_of(
    marks: Landmarks, points: Pairs, lines: Pairs, plane: int, rough: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Points and segment ends on a plane: places (M, 3), covariances, deviations ``rough`` as lengths, weights."""
    of_points, of_lines = points.pairs[:, 1] == plane, lines.pairs[:, 1] == plane
    point, line = points.pairs[of_points, 0], lines.pairs[of_lines, 0]
    return (
        np.concatenate([marks.points[point], marks.segments[line].reshape(-1, 3)]),
        np.concatenate([marks.point_noise.covariance[point], marks.line_noise.ends(line).reshape(-1, 3, 3)]),
        rough * np.concatenate([marks.point_pixel[point], np.repeat(marks.line_pixel[line], 2)]),
        np.concatenate([points.probability[of_points], np.repeat(lines.probability[of_lines], 2)]),
    )


def _with_shared_deviations(
    marks: Landmarks, planes: PlaneSet, points: Pairs, lines: Pairs, before: Sequence[Pairs], into: IntArray
) -> PlaneSet:
    """Return the planes, the joined ones with the covariance that they have if the members of a piece deviate alike.

    ``before`` has the members of the pieces, ``into`` the planes that these are pieces of.
    """
    covariance, rough = planes.covariance.copy(), deviations(points, lines, len(planes))
    joined = np.bincount(into, minlength=len(planes))[: len(planes)] > 1
    for k in np.flatnonzero(joined & (rough > 0.0)).tolist():
        places, noise, away, weight = members_of(marks, points, lines, k, rough[k])
        piece = _pieces(points, lines, before, into, k)
        normal = planes.planes[k, :3]
        own = np.einsum("i,nij,j->n", normal, noise, normal)
        precision = weight / (own + away**2)
        slope, motion = plane_motions(planes.planes[k], precision @ places / precision.sum(), places)
        alike = np.zeros((int(piece.max()) + 1, 3))
        np.add.at(alike, piece, (precision * away)[:, None] * slope)
        inverse = np.linalg.inv((precision[:, None] * slope).T @ slope)
        inner = inverse @ ((precision**2 * own)[:, None] * slope).T @ slope @ inverse
        covariance[k] = motion @ (inner + (alike @ inverse).T @ (alike @ inverse)) @ motion.T
    return replace(planes, covariance=covariance)


def _pieces(points: Pairs, lines: Pairs, before: Sequence[Pairs], into: IntArray, plane: int) -> IntArray:
    """(M,) the piece that each point and segment end on a plane is on; those on none have numbers of their own."""
    numbers, free = [], len(into)
    for found, earlier, ends in ((points, before[0], 1), (lines, before[1], 2)):
        mark = found.pairs[found.pairs[:, 1] == plane, 0]
        piece = np.full(int(max(mark.max(initial=0), earlier.pairs[:, 0].max(initial=0))) + 1, -1)
        rows = into[earlier.pairs[:, 1]] == plane
        piece[earlier.pairs[rows, 0]] = earlier.pairs[rows, 1]
        number = np.where(piece[mark] >= 0, piece[mark], free + np.arange(len(mark)))
        numbers.append(np.repeat(number, ends))
        free += len(mark)
    return np.concatenate(numbers)


def _released(marks: Landmarks, planes: PlaneSet, points: Pairs, lines: Pairs) -> PlaneSet:
    """Return planes with labels of what lies on them; what they were found in, but is beyond the layer, is free."""

    def labels(before: IntArray, usable: BoolArray, places: FloatArray, found: Pairs) -> IntArray:
        label = np.full(len(usable), -1)
        label[usable] = before
        plane = planes.planes[label]
        height = np.abs(np.einsum("nki,ni->nk", places, plane[:, :3]) + plane[:, 3:]).max(axis=1)
        label[height > planes.band[label]] = -1
        label[found.pairs[:, 0]] = found.pairs[:, 1]
        return label[usable]

    return replace(
        planes,
        point_label=labels(planes.point_label, marks.point_usable, marks.points[:, None], points),
        segment_label=labels(planes.segment_label, marks.line_usable, marks.segments, lines),
    )
