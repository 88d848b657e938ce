# SPDX-License-Identifier: BSD-3-Clause
"""What lies on planes, and planes whose members deviate fitted to these members.

The search for planes finds where features lie on a plane within their noise: of a rough wall some panel, or a plane
that cuts through several. How far members of the wall deviate is estimated afterwards, around that plane. A plane
fitted to the members with this deviation in their noise is the one of most likelihood, and tells again what its members
are.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._typing import FloatArray
from groma.estimators.plane_fit import fit_plane
from groma.estimators.plane_search import PlaneSet
from groma.mapping.structure.relations import Landmarks, Pairs, on_planes

#: Rounds in which planes are fitted to members and members told again (cost: time; the second moves planes little).
_ROUNDS = 2


def on_fitted_planes(
    marks: Landmarks, planes: PlaneSet, level: float, least: tuple[float, float], min_support: int
) -> tuple[PlaneSet, Pairs, Pairs]:
    """Return the planes, those whose members deviate fitted to them, and the points and lines on planes.

    Parameters
    ----------
    marks : Landmarks
        Points and lines with their noise.
    planes : PlaneSet
        Planes as found.
    level, least
        As :func:`~groma.mapping.structure.relations.on_planes` has them.
    min_support : int
        Least number of members of a plane that is fitted, a segment counts as two; planes with fewer stay.
    """
    points, lines = on_planes(marks, planes, level, least)
    for _ in range(_ROUNDS):
        rough = _deviations(points, lines, len(planes))
        rough[points.counts(len(planes)) + 2 * lines.counts(len(planes)) < min_support] = 0.0
        if not rough.any():
            break
        planes = _fitted(marks, planes, points, lines, rough)
        points, lines = on_planes(marks, planes, level, least)
    return planes, points, lines


def _deviations(points: Pairs, lines: Pairs, num: int) -> FloatArray:
    """(num,) how far members of each plane deviate, pixels; 0 where their noise explains it."""
    rough = np.zeros(num)
    for found in (points, lines):
        np.maximum.at(rough, found.pairs[:, 1], found.deviation)
    return rough


def _fitted(marks: Landmarks, planes: PlaneSet, points: Pairs, lines: Pairs, rough: FloatArray) -> PlaneSet:
    """Return the planes with a deviation fitted to their members, weighted by their probabilities."""
    plane, covariance, ends = planes.planes.copy(), planes.covariance.copy(), marks.line_noise.ends()
    for k in np.flatnonzero(rough):
        of_points, of_lines = points.pairs[:, 1] == k, lines.pairs[:, 1] == k
        point, line = points.pairs[of_points, 0], lines.pairs[of_lines, 0]
        noise = np.concatenate([marks.point_noise.covariance[point], ends[line].reshape(-1, 3, 3)])
        away = rough[k] * np.concatenate([marks.point_pixel[point], np.repeat(marks.line_pixel[line], 2)])
        fit = fit_plane(
            np.concatenate([marks.points[point], marks.segments[line].reshape(-1, 3)]),
            noise + away[:, None, None] ** 2 * np.eye(3),
            np.concatenate([points.probability[of_points], np.repeat(lines.probability[of_lines], 2)]),
        )
        plane[k], covariance[k] = fit.plane * np.sign(fit.plane[:3] @ plane[k, :3]), fit.covariance
    return replace(planes, planes=plane, covariance=covariance)
