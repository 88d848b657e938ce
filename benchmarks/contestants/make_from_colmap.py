# SPDX-License-Identifier: BSD-3-Clause
"""Write a COLMAP model as a BAL file with a start that is off: ``make_from_colmap.py MODEL FILE``.

Each image gets a camera of its own; where a camera has two focal lengths, pixels are scaled to their mean. Focal
lengths are 1 % too long, cameras turned by 0.2 degrees and shifted by 0.2 % of their median distance from what they see
(standard deviations, seeded). Models without distortion, or with one or two radial terms.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

from groma import cameras
from groma.geometry import se3
from groma.io import read_scene, write_bal
from groma.scene import Scene


def with_one_focal_length(scene: Scene) -> Scene:
    """Return the scene with PINHOLE cameras (fx, fy, cx, cy) turned into SIMPLE_PINHOLE (f, cx, cy)."""
    table, observed = scene.cameras, scene.point_observations
    pixel, params, models = observed.pixel.copy(), table.params.copy(), list(table.models)
    camera_of = scene.images.camera_idx[observed.image_idx]
    for row, name in enumerate(models):
        if name == "PINHOLE":
            (fx, fy, *center), mine = params[row, :4], camera_of == row
            focal = 0.5 * (fx + fy)
            pixel[mine] = center + (pixel[mine] - center) * [focal / fx, focal / fy]
            params[row, :4], models[row] = [focal, *center, 0.0], "SIMPLE_PINHOLE"
    width = max(cameras.model(name).num_parameters for name in models)
    return scene.replace(
        cameras=table.replace(models=tuple(models), params=params[:, :width]),
        point_observations=observed.replace(pixel=pixel),
    )


def main() -> None:
    model, path = Path(sys.argv[1]), Path(sys.argv[2])
    scene = read_scene(model).points_only()
    scene = with_one_focal_length(scene)
    params = scene.cameras.params.copy()
    params[:, 0] *= 1.01
    observed = scene.point_observations
    centers = scene.cam_centers_in_world[observed.image_idx]
    distance = float(np.median(np.linalg.norm(scene.points.xyz[observed.point_idx] - centers, axis=1)))
    rng = np.random.default_rng(0)
    tangent = rng.normal(size=(scene.num_images, 6)) * ([0.002 * distance] * 3 + [np.deg2rad(0.2)] * 3)
    moved = se3.compose(se3.exp(tangent), scene.cam_from_world)
    draft = path.with_suffix(".draft.txt")
    write_bal(scene.with_params(params).with_poses(moved), draft, force=True)
    os.replace(draft, path)


if __name__ == "__main__":
    main()
