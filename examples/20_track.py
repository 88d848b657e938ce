# SPDX-License-Identifier: BSD-3-Clause
"""Track a depth camera frame by frame: here in front of a painted wall that is rendered on the way."""

import cv2
import numpy as np

from groma.geometry import quaternion, se3
from groma.io.sequences import Frame, SequenceCamera
from groma.tracking import Tracker

# A wall two metres away, painted with soft noise and rectangles; 200 pixels of paint a metre.
rng = np.random.default_rng(0)
wall = 120 + 15 * cv2.resize(rng.normal(size=(150, 200)).astype(np.float32), (1200, 900))
for u, v in rng.integers(0, 800, (60, 2)):
    wall[v : v + 70, u : u + 90] += rng.choice([-50, 50])
wall = cv2.GaussianBlur(np.clip(wall, 0, 255), (0, 0), 1.0)
paint_from_wall = np.array([[200.0, 0, 600], [0, 200, 450], [0, 0, 1]])

width, height, focal = 320, 240, 260.0
camera = SequenceCamera("PINHOLE", np.array([focal, focal, width / 2, height / 2]), width, height)
# OpenCV counts pixels from the centre of the first one, groma from the corner of the image.
img_from_cam = np.array([[focal, 0, width / 2 - 0.5], [0, focal, height / 2 - 0.5], [0, 0, 1]])


def take(cam_from_world: np.ndarray, timestamp: float) -> Frame:
    """Return what the camera sees: the wall is the plane z = 2."""
    R, t = quaternion.to_matrix(cam_from_world[:4]), cam_from_world[4:]
    cam_from_wall = np.column_stack([R[:, 0], R[:, 1], 2.0 * R[:, 2] + t])
    img_from_paint = img_from_cam @ cam_from_wall @ np.linalg.inv(paint_from_wall)
    gray = cv2.warpPerspective(wall, img_from_paint, (width, height)).astype(np.uint8)
    v, u = np.mgrid[0:height, 0:width]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(img_from_cam).T
    depth = (2.0 + R[:, 2] @ t) / (rays @ R[:, 2])
    return Frame(timestamp, gray, (depth * (1 + 0.002 * rng.normal(size=depth.shape))).astype(np.float32))


# The camera moves 0.6 m sideways while it turns by 12 degrees.
motion = np.linspace(0, 1, 25)[:, None] * [0.6, 0.1, 0.2, 0.02, -0.2, 0.05]
truth = se3.inverse(se3.exp(motion))

tracker = Tracker(camera)
for k, pose in enumerate(truth):
    tracked = tracker.process(take(pose, k / 30))
    if k % 8 == 0:
        print(f"frame {k:2d}: {tracked.status}, {tracked.counts.get('points', 0)} points agree")
result = tracker.finish()

error = np.linalg.norm(result.trajectory.world_from_cam[:, 4:] - se3.inverse(truth)[:, 4:], axis=1)
print(f"Largest position error {1000 * error.max():.1f} mm over {np.linalg.norm(motion[-1, :3]):.2f} m")
scene = result.scene
print(f"Map: {scene.num_points} points, {scene.num_lines} lines, {scene.num_planes} planes")
print("Plane of the wall (n, w):", np.round(scene.planes.hesse[0], 3))
