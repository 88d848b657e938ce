# SPDX-License-Identifier: BSD-3-Clause
r"""The residual offset of a rectified pair, estimated from a finished map.

A rectification that is wrong by a fraction of a pixel shifts all disparities alike, and depths by
:math:`\delta z / z = -\delta / d`: a wrong scale, other for near points than for far ones. Motion tells the shape of
the scene without the pair, so near and far points together tell the offset. Here the right camera may turn a little
about the vertical axis, which shifts its columns, against a prior that holds it where the map does not tell.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma.adjustment.terms.right_columns import RIGHT_CAMERAS
from groma.tracking.backend.local_adjustment import job_of
from groma.tracking.frame.camera import TrackCamera, rotation
from groma.tracking.map.map_scene import TRACKING
from groma.tracking.map.track_map import TrackMap

#: Standard deviation of the offset before anything is known, pixels.
PRIOR_PX = 0.5
#: Keyframes and measured pairs that an estimate needs.
MIN_KEYFRAMES, MIN_PAIRS = 5, 200
#: Larger offsets are not a matter of fractions of a pixel, and are left alone.
MAX_PX = 1.5


def estimate_offset(track_map: TrackMap, camera: TrackCamera) -> float:
    """Return by how much columns in the right image are too large, pixels; 0 where the map does not tell."""
    living = track_map.living()
    if len(living) < MIN_KEYFRAMES or not camera.baseline > 0:
        return 0.0
    held = np.zeros(len(living), dtype=bool)
    held[0] = True
    options = replace(TRACKING, lines=False, planes=False, right_turn_sigma_px=PRIOR_PX)
    job = job_of(track_map, camera, living, held, relations=False, max_iterations=25, options=options)
    if job is None or np.isfinite(job.point_table.right).sum() < MIN_PAIRS:
        return 0.0
    job.solve()
    assert job.solved is not None
    axis = rotation(job.solved.variables[RIGHT_CAMERAS].state[0])[:, 2]
    offset = camera.fx * float(axis[0] / axis[2])
    return offset if abs(offset) < MAX_PX else 0.0


def correct_offset(track_map: TrackMap, camera: TrackCamera, offset: float) -> None:
    """Take an offset out of all measured columns, and out of the inverse depths along segments."""
    for keyframe in track_map.living():
        points, lines = keyframe.measured.points, keyframe.measured.lines
        points = replace(points, right=points.right - offset)
        inverse = lines.inverse_depth + offset / (camera.fx * camera.baseline)
        keyframe.measured = replace(keyframe.measured, points=points, lines=replace(lines, inverse_depth=inverse))


__all__ = ["correct_offset", "estimate_offset"]
