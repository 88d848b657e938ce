# SPDX-License-Identifier: BSD-3-Clause
"""Lines that clusters of images found, joined across their borders.

A line that runs across a border is found by the clusters on both sides, each with the segments of its own images and of
its ring. Two such *versions* are one line if they share segments in two images or more, and in most of those images of
either that both clusters know; and if each is the other's best among all versions of that cluster. A segment that lines
claim which are not joined goes to the one that its own cluster gave it to.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma._rows import connected_parts, pointers_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.mapping.groups import distinct_pairs
from groma.mapping.lines.gates import AGREEMENT
from groma.mapping.lines.linking.tracks import TrackGates, Tracks
from groma.mapping.lines.outcomes import Outcome
from groma.mapping.lines.views import LineViews


@dataclass(frozen=True, eq=False)
class Found:
    """The lines that a cluster found on segments of its own images; of each, all segments that the cluster knows."""

    #: (M,) row of each observation among all segments, by line, ascending within one.
    rows: IntArray
    #: (M,) line of each observation.
    line_idx: IntArray
    #: (M,) whether the segment's own place linked it, its standard deviation, and its squared distance over it.
    linked: BoolArray
    sigma: FloatArray
    squared: FloatArray
    #: (L, 2, 3) ends of the lines, and (L,) how uncertain they are: see :class:`Tracks`.
    lines: FloatArray
    uncertainty: FloatArray
    unchecked: FloatArray
    #: (s,) the :class:`Outcome` and the length in pixels of every segment of the cluster's own images.
    outcomes: IntArray
    length: FloatArray


@dataclass(frozen=True, eq=False)
class Borders:
    """Which images belong to which of K clusters."""

    #: (C,) the cluster of each image.
    home: IntArray
    #: (K, C) the images that each cluster knows: its own, and its ring.
    known: BoolArray
    #: (S,) the image of each segment.
    image_idx: IntArray


@dataclass(frozen=True, eq=False)
class _Versions:
    """The lines (V,) of all clusters, and their observations (M,)."""

    #: (V,) cluster of each.
    cluster: IntArray
    #: (M,) observations: the version, the row and the image of the segment.
    version: IntArray
    row: IntArray
    image: IntArray

    @staticmethod
    def of(found: Sequence[Found], image_idx: IntArray) -> _Versions:
        """Number the lines of all clusters."""
        counts = [len(one.lines) for one in found]
        first = pointers_of(counts)
        version = np.concatenate([first[k] + one.line_idx for k, one in enumerate(found)])
        row = np.concatenate([one.rows for one in found])
        return _Versions(np.repeat(np.arange(len(found)), counts), version, row, image_idx[row])


def joined(found: Sequence[Found], borders: Borders, views: LineViews, rows: IntArray, min_images: int) -> Tracks:
    """Join what clusters found.

    Parameters
    ----------
    found : sequence of K Found
        By cluster; at least one.
    borders : Borders
        Which images are whose.
    views : LineViews
        Table of the segments that any line claims.
    rows : (T,) int
        Row of each of them among all segments, ascending.
    min_images : int
        Lines seen in fewer images are let go once those that changed are fitted anew.

    Returns
    -------
    Tracks
        In the order of clusters.
    """
    versions = _Versions.of(found, borders.image_idx)
    group = _groups(versions, borders)
    observation, line = _claimed(versions, group, borders)
    columns = {
        name: np.concatenate([getattr(one, name) for one in found])
        for name in ("linked", "sigma", "squared", "lines", "uncertainty", "unchecked")
    }
    chosen = _representatives(versions, group)
    kept, number = np.unique(line, return_inverse=True)
    chosen, here = chosen[kept], np.searchsorted(rows, versions.row[observation])
    same = _unchanged(versions, columns["sigma"], observation, number, chosen)
    line_of, squared = np.full(len(rows), -1, np.int64), np.full(len(rows), np.nan)
    linked, sigma = np.zeros(len(rows), bool), views.sigma.copy()
    line_of[here], linked[here] = number, columns["linked"][observation]
    sigma[here], squared[here] = columns["sigma"][observation], columns["squared"][observation]
    tracks = Tracks(
        views=views, line_of=line_of, rejection=np.full(len(rows), Outcome.REPEATED), linked=linked, sigma=sigma,
        squared=squared, lines=columns["lines"][chosen], uncertainty=columns["uncertainty"][chosen],
        unchecked=columns["unchecked"][chosen], stale=~same,
    )  # fmt: skip
    return tracks.refined(min_images)


def _groups(versions: _Versions, borders: Borders) -> IntArray:
    """(V,) the smallest version of the same line."""
    count, cluster = len(versions.cluster), versions.cluster
    first, second, votes = _shared(versions)
    fewer = np.minimum(
        _num_known(versions, first, borders.known, cluster[second]),
        _num_known(versions, second, borders.known, cluster[first]),
    )
    good = (votes >= TrackGates.min_common_images) & (votes >= AGREEMENT.min_common * fewer)
    first, second, votes = first[good], second[good], votes[good]
    best = _is_best(first, second, votes, cluster) & _is_best(second, first, votes, cluster)
    label = connected_parts(first[best], second[best], count)
    return np.unique(label, return_index=True)[1][label]


def _num_known(versions: _Versions, which: IntArray, known: BoolArray, cluster: IntArray) -> IntArray:
    """(n,) in how many images that a cluster (n,) knows a version (n,) is seen."""
    seen, _ = distinct_pairs(versions.version, versions.image)
    pointers = np.searchsorted(seen[:, 0], np.arange(len(versions.cluster) + 1))
    number = np.diff(pointers)[which]
    pair = np.repeat(np.arange(len(which)), number)
    place = np.arange(len(pair)) - np.repeat(np.cumsum(number) - number, number) + pointers[which][pair]
    return np.bincount(pair[known[cluster[pair], seen[place, 1]]], minlength=len(which))


def _shared(versions: _Versions) -> tuple[IntArray, IntArray, IntArray]:
    """Pairs of versions that share segments, the first less than the second, and in how many images."""
    order = np.lexsort([versions.version, versions.row])
    row, version, image = versions.row[order], versions.version[order], versions.image[order]
    pairs: list[IntArray] = [np.zeros((0, 2), np.int64)]
    where: list[IntArray] = [np.zeros(0, np.int64)]
    step = 1
    while True:  # at most as many times as clusters know a segment
        same = np.flatnonzero(row[step:] == row[:-step])
        if not len(same):
            break
        pairs.append(np.column_stack([version[same], version[same + step]]))
        where.append(image[same])
        step += 1
    pair, image = np.concatenate(pairs), np.concatenate(where)
    count = len(versions.cluster)
    seen, _ = distinct_pairs(pair[:, 0] * count + pair[:, 1], image)
    key, votes = np.unique(seen[:, 0], return_counts=True)
    return key // max(count, 1), key % max(count, 1), votes


def _is_best(one: IntArray, other: IntArray, votes: IntArray, cluster: IntArray) -> BoolArray:
    """Whether a pair has the most votes of all between a version and those of another cluster."""
    order = np.lexsort([other, -votes, cluster[other], one])
    key = np.column_stack([one, cluster[other]])[order]
    first = np.ones(len(order), bool)
    first[1:] = (key[1:] != key[:-1]).any(axis=1)
    best = np.zeros(len(order), bool)
    best[order[first]] = True
    return best


def _claimed(versions: _Versions, group: IntArray, borders: Borders) -> tuple[IntArray, IntArray]:
    """Observations that stay, one of each segment, and their groups: those of its own cluster first.

    A group that the cluster with most of its images has no version of was rejected there, and is left out.
    """
    line, home = group[versions.version], borders.home[versions.image]
    own = versions.cluster[versions.version] == home
    seen, _ = distinct_pairs(line, versions.image)
    size = np.bincount(seen[:, 0], minlength=len(group))
    num_clusters = len(borders.known)
    key, count = np.unique(seen[:, 0] * num_clusters + borders.home[seen[:, 1]], return_counts=True)
    order = np.lexsort([key % num_clusters, -count, key // num_clusters])
    of_group, first = np.unique((key // num_clusters)[order], return_index=True)
    most = np.full(len(group), -1)
    most[of_group] = (key % num_clusters)[order][first]
    there = np.zeros(len(group), bool)
    there[group[versions.cluster == most[group]]] = True
    rows = np.flatnonzero(there[line])
    order = rows[np.lexsort([line[rows], -size[line[rows]], ~own[rows], versions.row[rows]])]
    is_first = np.ones(len(order), bool)
    is_first[1:] = versions.row[order][1:] != versions.row[order][:-1]
    chosen = order[is_first]
    return chosen, line[chosen]


def _representatives(versions: _Versions, group: IntArray) -> IntArray:
    """(V,) by group, the version of it that has most observations; the fit begins with its ends."""
    size, count = np.bincount(versions.version, minlength=len(group)), len(group)
    order = np.lexsort([np.arange(count), -size, group])
    of_group, first = np.unique(group[order], return_index=True)
    chosen = np.full(count, -1)
    chosen[of_group] = order[first]
    return chosen


def _unchanged(
    versions: _Versions, sigma: FloatArray, observation: IntArray, number: IntArray, chosen: IntArray
) -> BoolArray:
    """(L,) whether a line has the observations, and they the noise, that its representative was fitted to."""
    count = len(versions.row) + 1
    size = int(versions.row.max(initial=0)) + 1
    of_version = versions.version * size + versions.row
    order = np.argsort(of_version, kind="stable")
    asked = chosen[number] * size + versions.row[observation]
    place = np.minimum(np.searchsorted(of_version[order], asked), count - 2)
    there = order[place] if len(order) else np.zeros(0, np.int64)
    fits = (of_version[there] == asked) & (sigma[there] == sigma[observation])
    kept = np.bincount(number, minlength=len(chosen))
    same = np.bincount(number[fits], minlength=len(chosen))
    return (same == kept) & (kept == np.bincount(versions.version, minlength=len(versions.cluster))[chosen])
