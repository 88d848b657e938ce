# SPDX-License-Identifier: BSD-3-Clause
"""Whether lens distortion that the cameras lack is recognised, and only where it is.

    python benchmarks/lens.py MODEL ...

MODEL is a scene of rectified photographs whose cameras have no distortion. It is adjusted as it is, and with its points
seen through a lens with each k1 of :data:`LENSES`, of which the cameras know nothing.
"""

from __future__ import annotations

import sys

import numpy as np

import groma
from groma.cameras import in_model, model
from groma.scene import Scene

#: Radial distortion of first order; 0 is the scene as it is.
LENSES = (0.0, -0.001, -0.005, -0.02, -0.1)


def through_lens(scene: Scene, k1: float) -> Scene:
    """Return the scene as lenses with a radial distortion would have seen it."""
    table, opencv = scene.point_observations, model("OPENCV")
    camera, pixel = scene.images.camera_idx[table.image_idx], table.pixel.copy()
    for row, name in enumerate(scene.cameras.models):
        mine, params = camera == row, scene.cameras.params_of(row)
        bent = in_model(params, model(name), opencv)
        bent[opencv.parameter_names.index("k1")] = k1
        pixel[mine] = opencv.project(bent, model(name).unproject(params, table.pixel[mine]))
    return scene.replace(point_observations=table.replace(pixel=pixel))


def main() -> None:
    """Print a row for each scene and lens: rms of the inliers with and without distortion, and whether it was told."""
    print(f"{'scene':<40}{'k1':>8}{'plain, px':>11}{'OPENCV, px':>12}  told")
    for path in sys.argv[1:]:
        scene = groma.read_scene(path).points_only()
        for k1 in LENSES:
            bent = through_lens(scene, k1)
            plain = groma.adjust(bent).report
            cured = groma.adjust(bent, groma.AdjustOptions(camera_model="OPENCV", check_lens=False)).report
            rms = [report.inliers["points"]["rmse_px"]["after"] for report in (plain, cured)]
            told = np.any(["lens distortion" in text for text in plain.warnings])
            print(f"{path[-40:]:<40}{k1:>8g}{rms[0]:>11.3f}{rms[1]:>12.3f}  {'yes' if told else 'no'}", flush=True)


if __name__ == "__main__":
    main()
