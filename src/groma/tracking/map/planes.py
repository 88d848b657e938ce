# SPDX-License-Identifier: BSD-3-Clause
"""Planes of one frame and the planes of the map: which is which, and how the map's grow and merge."""

from __future__ import annotations

import numpy as np

from groma._numba import loop
from groma._typing import FloatArray, IntArray
from groma.tracking.frame.camera import back, planes_back, planes_into
from groma.tracking.frame.planes import FramePlanes
from groma.tracking.gates import DEFAULT, PlaneGates
from groma.tracking.map.landmarks import ALIVE, DEAD, SAMPLES_KEPT, PlaneTable


@loop
def _is_near(samples, places, step, reach):
    """Whether one of some places, each ``step``-th, is within reach of a sample; samples that are NaN are none."""
    for i in range(samples.shape[0]):
        for j in range(0, places.shape[0], step):
            x, y, z = samples[i, 0] - places[j, 0], samples[i, 1] - places[j, 1], samples[i, 2] - places[j, 2]
            if x * x + y * y + z * z < reach * reach:
                return True
    return False


@loop
def _refuse_apart(samples, alive, places, rows, begin, limits, score):
    """Set scores to infinity where no place of a plane (``rows`` from its ``begin``) is near a sample of the other."""
    compared, reach = limits
    for i in range(score.shape[0]):
        for j in range(score.shape[1]):
            if score[i, j] < np.inf:
                own = rows[begin[j] : begin[j + 1]]
                step = max(1, len(own) // compared)
                if not _is_near(samples[alive[i]], places[own], step, reach):
                    score[i, j] = np.inf


def assign_planes(
    planes: PlaneTable, seen: FramePlanes, pose: FloatArray, gates: PlaneGates = DEFAULT.planes, wider: float = 1.0
) -> tuple[IntArray, IntArray]:
    """Pair planes of the map with planes of a frame by angle, distance and overlap.

    The distance is that of the seen part from the map's plane, which does not grow with the distance of the camera.

    Returns
    -------
    (k,), (k,) int
        Planes of the map, and rows of ``seen``; each at most once.
    """
    max_angle, max_distance = wider * gates.angle, wider * gates.distance
    alive = np.flatnonzero(planes.alive)
    none = np.zeros(0, np.int64)
    if not len(alive) or not len(seen):
        return none, none
    in_cam = planes_into(pose, planes.hesse[alive])
    cosine = in_cam[:, :3] @ seen.plane[:, :3].T
    distance = np.abs(in_cam[:, :3] @ seen.means.T + in_cam[:, 3:])
    good = (cosine > np.cos(max_angle)) & (distance < max_distance)
    score = np.where(good, np.arccos(np.clip(cosine, -1, 1)) / max_angle + distance / max_distance, np.inf)
    places = back(pose, seen.places) if good.any() else seen.places
    _refuse_apart(planes.samples, alive, places, *seen.place_rows, (int(gates.compared), float(gates.reach)), score)
    best = score.argmin(axis=1)
    rows = np.flatnonzero(np.isfinite(score[np.arange(len(alive)), best]))
    rows = rows[score.argmin(axis=0)[best[rows]] == rows]
    return alive[rows], best[rows]


def add_planes(
    planes: PlaneTable, seen: FramePlanes, rows: IntArray, pose: FloatArray, gates: PlaneGates = DEFAULT.planes
) -> IntArray:
    """Make landmarks of planes of a frame; return their indices."""
    index = planes.extend(len(rows))
    planes.hesse[index] = planes_back(pose, seen.plane[rows])
    planes.state[index] = ALIVE
    for k, row in zip(index, rows, strict=True):
        grow(planes, int(k), back(pose, seen.places_of(row)), float(seen.support[row]), gates)
    return index


def grow(planes: PlaneTable, index: int, places: FloatArray, support: float, gates: PlaneGates) -> None:
    """Add the part of a plane that a frame sees: samples stay spread over all that was seen."""
    old = planes.samples[index]
    both = np.concatenate([old[np.isfinite(old[:, 0])], places])
    # One sample per box; boxes grow until the samples fit.
    size = gates.box
    while True:
        cells = np.floor(both / size).astype(np.int64)
        cells -= cells.min(axis=0, initial=0)
        most = cells.max(axis=0, initial=0) + 1
        rows = np.unique((cells[:, 0] * most[1] + cells[:, 1]) * most[2] + cells[:, 2], return_index=True)[1]
        if len(rows) <= SAMPLES_KEPT:
            break
        size *= gates.box_growth
    planes.samples[index] = np.nan
    planes.samples[index, : len(rows)] = both[rows]
    planes.support[index] += support
    planes.found[index] += 1


def merge_planes(planes: PlaneTable, gates: PlaneGates = DEFAULT.planes) -> list[tuple[int, int]]:
    """Merge planes of depth images that have come to lie on each other; return (kept, dropped) pairs."""
    alive = np.flatnonzero(planes.alive & ~planes.of_landmarks)
    merged: list[tuple[int, int]] = []
    for a, first in enumerate(alive):
        for second in alive[a + 1 :]:
            if planes.state[first] != ALIVE or planes.state[second] != ALIVE:
                continue
            one, two = planes.hesse[first], planes.hesse[second]
            if one[:3] @ two[:3] < np.cos(gates.merge_angle):
                continue
            samples = [planes.samples[k][np.isfinite(planes.samples[k][:, 0])] for k in (first, second)]
            apart = max(
                float(np.median(np.abs(samples[1] @ one[:3] + one[3]))),
                float(np.median(np.abs(samples[0] @ two[:3] + two[3]))),
            )
            if apart > gates.merge_distance or not _overlap(planes.samples[first], samples[1], gates):
                continue
            keep, drop = (first, second) if planes.support[first] >= planes.support[second] else (second, first)
            grow(planes, int(keep), samples[1] if keep == first else samples[0], float(planes.support[drop]), gates)
            planes.state[drop] = DEAD
            planes.merged_into[drop] = keep
            merged.append((int(keep), int(drop)))
    return merged


def _overlap(samples: FloatArray, places: FloatArray, gates: PlaneGates) -> bool:
    return bool(_is_near(samples, places, max(1, len(places) // gates.compared), gates.reach))
