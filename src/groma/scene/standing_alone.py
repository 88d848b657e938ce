# SPDX-License-Identifier: BSD-3-Clause
"""The tables of cameras and images that stand alone: one rig per camera, one frame per image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from groma.scene.camera import CAMERA, Cameras, Rigs, Sensors
from groma.scene.image import Frames, Images


def standing_alone(
    cameras: Cameras, names: Sequence[str], camera_idx: npt.ArrayLike, cam_from_world: npt.ArrayLike
) -> dict[str, Any]:
    """Return the tables by name; for the parameters see :meth:`groma.scene.Scene.from_images`."""
    index = np.asarray(camera_idx, np.int64)
    every, count = np.arange(len(cameras)), len(names)
    sensors = Sensors(
        rig_idx=every,
        kind=np.full(len(cameras), CAMERA),
        sensor_ids=cameras.ids,
        camera_idx=every,
        cam_from_rig=np.tile([0, 0, 0, 1, 0, 0, 0.0], (len(cameras), 1)),
        is_reference=np.ones(len(cameras), int),
        has_pose=np.ones(len(cameras), int),
    )
    return {
        "cameras": cameras,
        "rigs": Rigs(cameras.ids),
        "sensors": sensors,
        "frames": Frames(np.arange(count) + 1, index, np.asarray(cam_from_world, float)),
        "images": Images(np.arange(count) + 1, tuple(names), index, np.arange(count), index),
    }
