# SPDX-License-Identifier: BSD-3-Clause
"""Exact depths of the photographs of the house corner (:mod:`_facade`), by name; 0 beside the walls."""

import numpy as np
from _facade import HEIGHT, WALLS, WIDTH, meet

from groma.cameras import model as camera_model
from groma.geometry import quaternion


def facade_depths(scene):
    """Depths (H, W) of every image of the scene that ``facade`` returned, by its stem."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = camera_model(scene.cameras.models[0]).unproject(
        scene.cameras.params_of(0), np.column_stack([u.ravel(), v.ravel()])
    )
    rays = rays / rays[:, 2:]
    found = {}
    for name, pose, place in zip(scene.images.names, scene.cam_from_world, scene.cam_centers_in_world, strict=True):
        R = quaternion.to_matrix(pose[None, :4])[0]
        depth = np.full(len(rays), np.inf)
        for wall in WALLS:
            s, t, z = meet(wall, place, rays @ R)
            front = (s > 0) & (s < 1) & (t > 0) & (t < 1) & (z > 0) & (z < depth)
            depth[front] = z[front]
        depth[np.isinf(depth)] = 0.0
        found[name.split(".")[0]] = depth.reshape(HEIGHT, WIDTH)
    return found
