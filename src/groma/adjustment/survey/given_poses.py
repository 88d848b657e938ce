# SPDX-License-Identifier: BSD-3-Clause
"""Tests of poses that were given with the photographs and whose noise was estimated."""

from __future__ import annotations

from typing import Any

import numpy as np

from groma.geometry import se3
from groma.scene import Scene


def given_poses_of(scene: Scene) -> dict[str, Any]:
    """Return the noise that given poses count with and what they are off after the adjustment, as plain values.

    Standard deviations and root mean squares of a coordinate: of shifts in scene units, of turns in degrees. Images
    without a pose among them were given none, or a wrong one. Nothing where no poses were given.
    """
    table = scene.pose_priors
    if not len(table):
        return {}
    off = se3.log(se3.compose(scene.frames.rig_from_world[table.frame_idx], se3.inverse(table.rig_from_world)))
    sigma, rms = (np.sqrt((size**2).reshape(-1, 2, 3).mean(axis=(0, 2))) for size in (table.sigma, off))
    used = np.isin(scene.images.frame_idx, table.frame_idx)
    return {
        "given_poses": {
            "number": int(used.sum()),
            "sigma": float(sigma[0]),
            "sigma_deg": float(np.degrees(sigma[1])),
            "rms": float(rms[0]),
            "rms_deg": float(np.degrees(rms[1])),
            "without": [scene.images.names[row] for row in np.flatnonzero(~used)],
        }
    }
