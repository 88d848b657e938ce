# SPDX-License-Identifier: BSD-3-Clause
"""Depth images of planes, exact or with noise."""

import numpy as np

#: fx, fy, cx, cy of a camera with 160 x 120 pixels.
PINHOLE = np.array([150.0, 148.0, 81.0, 59.0])
SHAPE = (120, 160)


def plane(normal, distance):
    """Plane (n, w) at a distance from the camera, which lies on its positive side."""
    normal = np.asarray(normal, float)
    return np.append(normal / np.linalg.norm(normal), distance)


#: A floor and a wall that meet in a line.
FLOOR, WALL = plane([0.05, -1.0, -0.3], 0.8), plane([-0.2, 0.1, -1.0], 2.2)


def rays(pinhole=PINHOLE, shape=SHAPE):
    u, v = np.meshgrid(np.arange(shape[1]) + 0.5, np.arange(shape[0]) + 0.5)
    return np.stack([(u - pinhole[2]) / pinhole[0], (v - pinhole[3]) / pinhole[1], np.ones_like(u)], -1)


def render(planes, pinhole=PINHOLE, shape=SHAPE):
    """Depth of the nearest plane in front of each pixel, and its row."""
    directions = rays(pinhole, shape)
    away = -np.array([p[3] / np.where(np.abs(directions @ p[:3]) > 1e-9, directions @ p[:3], 1e-9) for p in planes])
    away[away <= 0] = np.inf
    return away.min(0), away.argmin(0)


def noisy(depth, noise, rng):
    """Depth with white noise, as float32; rounding to 32 bits is far below the noise."""
    return (depth + noise.sigma(depth) * rng.standard_normal(depth.shape)).astype(np.float32)
