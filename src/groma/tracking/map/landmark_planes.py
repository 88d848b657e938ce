# SPDX-License-Identifier: BSD-3-Clause
"""Planes in the points and lines of a map, for cameras without depth images.

Comes in: the map as a scene. The search and the tests are those of :mod:`groma.mapping.structure`: every distance is
compared with the noise of its landmark, so that maps without a metric scale have the same planes. Surfaces differ in
flatness: a board is flat to a fraction of a pixel, a street with its kerbs is not. So the search is repeated for some
deviations of surfaces, and of planes that claim the same landmarks the one stays that chance would make most rarely.
Goes out: planes of the map, and the plane that each point and line lies on. Points that one stereo pair saw alone help
to find planes, but are not noted, as they take no part in adjustments.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.terms.relations import lengths_per_pixel
from groma.gates import NORMAL
from groma.mapping.structure.find import StructureOptions, detect_structure
from groma.mapping.structure.flatness import plane_noise_px
from groma.scene import Scene
from groma.tracking.gates import DEFAULT, LandmarkPlaneGates
from groma.tracking.map.landmarks import ALIVE, DEAD
from groma.tracking.map.track_map import TrackMap

#: What a line counts as support of a plane, in points: its two ends.
LINE = 2


@dataclass(frozen=True)
class _Claim:
    """A plane, and the landmarks that it claims."""

    hesse: FloatArray
    #: Base-10 logarithm of how many such planes chance would make.
    false_alarms: float
    #: Half thickness of the layer in which it stands out, scene units.
    band: float
    #: Rows of points and of lines on it.
    points: IntArray
    lines: IntArray
    #: Deviation of landmarks from it, as a length in the images, pixels.
    sigma_px: float

    @property
    def support(self) -> int:
        """Points, and ends of lines."""
        return len(self.points) + LINE * len(self.lines)


def find_planes(track_map: TrackMap, scene: Scene, gates: LandmarkPlaneGates = DEFAULT.landmark_planes) -> int:
    """Find planes in the points and lines of a map, note what lies on them, and return how many there are.

    Planes found before in points and lines are forgotten.

    Parameters
    ----------
    track_map : TrackMap
        The map. It is changed.
    scene : Scene
        The same as a scene, with points seen once: identifiers of landmarks are their numbers in the map, plus one.
    gates : LandmarkPlaneGates
        What counts as a plane.
    """
    points, lines, planes = track_map.points, track_map.lines, track_map.planes
    forget(track_map, np.flatnonzero(planes.of_landmarks))
    chosen = _chosen(scene, gates)
    rows = planes.extend(len(chosen))
    planes.state[rows] = ALIVE
    for kind, table, ids in (("point", points, scene.points.ids), ("line", lines, scene.lines.ids)):
        length = lengths_per_pixel(scene, kind)
        for row, claim in zip(rows, chosen, strict=True):
            of = claim.points if kind == "point" else claim.lines
            table.plane[ids[of] - 1], table.plane_sigma[ids[of] - 1] = row, claim.sigma_px * length[of]
    for row, claim in zip(rows, chosen, strict=True):
        planes.hesse[row] = claim.hesse
        planes.support[row] = claim.support
    return len(chosen)


def forget(track_map: TrackMap, planes: IntArray) -> None:
    """Take planes out of the map; nothing lies on them any longer."""
    track_map.planes.state[planes] = DEAD
    for table in (track_map.points, track_map.lines):
        table.plane[np.isin(table.plane, planes)] = -1


def _chosen(scene: Scene, gates: LandmarkPlaneGates) -> list[_Claim]:
    """Planes, the least accidental first, that keep enough of what they claim beside those before."""
    again = np.bincount(scene.point_observations.point_idx, minlength=scene.num_points) > 1
    free_point, free_line = np.ones(scene.num_points, dtype=bool), np.ones(scene.num_lines, dtype=bool)
    chosen = []
    claims = [claim for sigma in gates.surface_sigmas_px for claim in _claims(scene, sigma, gates)]
    for claim in sorted(claims, key=lambda claim: claim.false_alarms):
        left = replace(claim, points=claim.points[free_point[claim.points]], lines=claim.lines[free_line[claim.lines]])
        kept = replace(left, points=left.points[again[left.points]])
        if left.support < NORMAL.majority * claim.support or kept.support < gates.min_support:
            continue
        chosen.append(kept)
        # Nothing else lies in its layer: relief so near cannot be distinguished from the plane.
        normal, offset = claim.hesse[:3], claim.hesse[3]
        free_point &= np.abs(scene.points.xyz @ normal + offset) > claim.band
        free_line &= (np.abs(scene.lines.segments @ normal + offset) > claim.band).any(axis=1)
    return chosen


def _claims(scene: Scene, sigma_px: float, gates: LandmarkPlaneGates) -> Iterator[_Claim]:
    """Planes whose landmarks deviate from them by up to some pixels."""
    options = StructureOptions(min_views=gates.min_views, surface_sigma_px=sigma_px)
    structure = detect_structure(scene, options)
    flatness = plane_noise_px(structure.scene, replace(options, surface_sigma_px=max(gates.surface_sigmas_px)))
    relations, planes = structure.scene.relations, structure.planes
    columns = planes.planes, planes.log10_false_alarms, planes.band
    for k, (hesse, false_alarms, band) in enumerate(zip(*columns, strict=True)):
        points, lines = (pairs[pairs[:, 1] == k, 0] for pairs in (relations.point_on_plane, relations.line_on_plane))
        yield _Claim(hesse, float(false_alarms), float(band), points, lines, float(flatness[k]))
