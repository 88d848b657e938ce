# SPDX-License-Identifier: BSD-3-Clause
"""A scene from arrays of your own: poses, points, lines and where they were seen."""

import numpy as np

import groma
from groma.geometry import se3
from groma.scene import Cameras, LineObservations, Lines, PointObservations, Points, Scene

# One calibration, and five poses cam_from_world [qx qy qz qw tx ty tz]: a walk past a box.
camera = Cameras(ids=[1], models=("PINHOLE",), params=[[800.0, 800.0, 512.0, 384.0]], width=[1024], height=[768])
poses = np.array([[0.0, 0.05 * k, 0.0, np.sqrt(1 - (0.05 * k) ** 2), 0.4 * k, 0.1 * k**2, 5.0] for k in range(-2, 3)])

# 100 points and the twelve edges of the box, each seen in every image to one pixel.
rng = np.random.default_rng(0)
xyz = rng.uniform(-1, 1, (100, 3))
corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
edges = np.array([[a, b] for a in corners for b in corners if np.abs(a - b).sum() == 2 and (b - a).sum() > 0])


def seen(image_idx, places):
    """Pixels of places (..., 3) in an image, with noise."""
    in_cam = se3.transform_points(poses[image_idx], places.reshape(-1, 3))
    pixel = 800 * in_cam[:, :2] / in_cam[:, 2:] + [512, 384] + rng.normal(size=(len(in_cam), 2))
    return pixel.reshape(*places.shape[:-1], 2)


images = range(len(poses))
point_image, point_idx = np.divmod(np.arange(len(images) * len(xyz)), len(xyz))
line_image, line_idx = np.divmod(np.arange(len(images) * len(edges)), len(edges))
scene = Scene.from_images(
    camera,
    names=[f"{k}.jpg" for k in images],
    camera_idx=[0] * len(images),
    cam_from_world=poses,
    points=Points.at(xyz + 0.05 * rng.normal(size=xyz.shape)),
    point_observations=PointObservations.numbered(
        point_image, point_idx, np.concatenate([seen(k, xyz) for k in images])
    ),
    lines=Lines.through(edges + 0.05 * rng.normal(size=edges.shape)),
    line_observations=LineObservations(
        line_image, line_idx, np.concatenate([seen(k, edges).reshape(-1, 4) for k in images])
    ),
)

result = groma.adjust(scene)
print(result.report.termination.sentence)
for kind, rmse in result.report.rmse_px.items():
    print(f"{kind}: {rmse['before']:.2f} px -> {rmse['after']:.2f} px")
print("first line, moment and direction:", result.scene.lines.plucker[0].round(3))
print("its end points:", result.scene.lines.segments[0].round(3).tolist())
groma.write_scene(result.scene, "model", force=True)  # a COLMAP model, with the lines beside it
