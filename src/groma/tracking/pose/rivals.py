# SPDX-License-Identifier: BSD-3-Clause
"""Whether a place that was found stands out: as much must not agree with poses beside it.

What agrees with a pose by chance, or because things repeat themselves, agrees about as much with poses that see
everything a little elsewhere in the image. Features of one cell of the image have one vote, and so has each line. The
verdict is that of localisation on another place: if both were equally good, each vote would be for either, and the sign
test says how likely the pose is the right one (:mod:`groma.localization.pose.verdict`).

Planes have no vote. Each of a few is matched to the nearest of the map, and boxes and rooms look alike from both ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from groma._typing import FloatArray
from groma.geometry import se3
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.verdict import votes_of_a_rival
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.pose.relocalise import cells_of

#: Directions in which poses lie beside another, at two distances each (cost: time of a frame that is found).
_DIRECTIONS = 8


def stands_out(
    camera: TrackCamera, pose: FloatArray, votes: int, votes_at: Callable[[FloatArray], int], near: float
) -> bool:
    """Return whether clearly more is seen at a pose than at any beside it.

    Parameters
    ----------
    camera
        The camera.
    pose, votes
        The pose (7,), and its votes.
    votes_at
        Returns the votes of another pose.
    near
        Distance at which a feature agrees, pixels.
    """
    limit = votes_of_a_rival(votes)
    return all(votes_at(beside) < limit for beside in poses_beside(camera, pose, VERDICT.distinct * near))


def poses_beside(camera: TrackCamera, pose: FloatArray, way: float) -> Iterator[FloatArray]:
    """Yield poses (7,) turned so that all is seen some pixels away, once and twice as far."""
    for distance in (way, 2.0 * way):
        for direction in np.arange(_DIRECTIONS) * (2.0 * math.pi / _DIRECTIONS):
            turn = np.array([math.sin(direction), math.cos(direction), 0.0]) * math.atan(distance / camera.fx)
            yield se3.compose(se3.exp(np.concatenate([np.zeros(3), turn])[None]), pose[None])[0]


def num_cells(camera: TrackCamera, pixel: FloatArray) -> int:
    """Return in how many cells of the image pixels (n, 2) are."""
    return len(np.unique(cells_of(camera, pixel)))
