# SPDX-License-Identifier: BSD-3-Clause
"""Planes of the map's own points and lines after an adjustment with them: which hold, and the message."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._counted import counted
from groma.adjustment.assemble import assemble
from groma.adjustment.outcome import drop_failed_relations
from groma.gates import NORMAL
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.gates import DEFAULT, LandmarkPlaneGates
from groma.tracking.map.landmark_planes import LINE, forget
from groma.tracking.map.map_scene import TRACKING
from groma.tracking.map.track_map import TrackMap
from groma.tracking.result import map_to_scene


@dataclass(frozen=True)
class PlaneOutcome:
    """What became of the planes that were found in the points and lines of a map."""

    #: Points and lines that were searched, and points among them that one keyframe saw: they are in no result.
    searched: tuple[int, int]
    once: int
    #: Planes found, and those that held.
    found: int
    held: int
    #: Points and lines on planes that held, and those that did not hold to theirs.
    points: int = 0
    lines: int = 0
    dropped: int = 0

    @property
    def sentence(self) -> str:
        """The message."""
        once = f" ({self.once:,} of them in one keyframe alone, which are not written)" if self.once else ""
        among = f"{counted(self.searched[0], 'points')}{once} and {counted(self.searched[1], 'lines')} of the map"
        if not self.found:
            return f"No planes: none stands out from the {among}."
        if not self.held:
            return f"No planes: what was found in the {among} did not hold in the adjustment."
        on = f"{counted(self.points, 'points')} and {counted(self.lines, 'lines')}"
        left = f"; {counted(self.dropped, 'landmarks')} contradicted theirs" if self.dropped else ""
        return f"Found in the {among}: {counted(self.held, 'planes')} with {on}{left}."

    def numbers(self) -> dict:
        """Return everything as plain values."""
        names = ("found", "held", "points", "lines", "dropped")
        return {name: getattr(self, name) for name in names} | {"sentence": self.sentence}


def drop_what_failed(
    track_map: TrackMap, camera: TrackCamera, gates: LandmarkPlaneGates = DEFAULT.landmark_planes
) -> tuple[int, int]:
    """Take landmarks off planes that they do not hold to, and planes out of the map that keep too few.

    Returns
    -------
    int, int
        Landmarks that were taken off, and planes that went.
    """
    scene = map_to_scene(track_map, camera)
    kept, _ = drop_failed_relations(scene, assemble(scene, TRACKING).problem)
    own = track_map.planes.of_landmarks
    before, support = np.zeros(len(own), np.int64), np.zeros(len(own), np.int64)
    dropped = 0
    for kind, table, weight in (("point", track_map.points, 1), ("line", track_map.lines, LINE)):
        rows = np.flatnonzero(np.isin(table.plane, np.flatnonzero(own)))
        before += weight * np.bincount(table.plane[rows], minlength=len(own))
        held = getattr(scene, f"{kind}s").ids[getattr(kept.relations, f"{kind}_on_plane")[:, 0]] - 1
        failed = np.setdiff1d(rows, held)
        table.plane[failed], dropped = -1, dropped + len(failed)
        support += weight * np.bincount(table.plane[np.intersect1d(rows, held)], minlength=len(own))
    gone = np.flatnonzero(own & (support < np.maximum(gates.min_support, NORMAL.majority * before)))
    forget(track_map, gone)
    track_map.planes.support[own] = support[own]
    return dropped, len(gone)
