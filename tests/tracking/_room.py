# SPDX-License-Identifier: BSD-3-Clause
"""A room with painted walls, rendered by ray casting: grey images, depth, right images, and the true poses."""

from functools import cache, lru_cache

import cv2
import numpy as np

from groma.geometry import quaternion, se3, so3
from groma.io.sequences import Frame, SequenceCamera

WIDTH, HEIGHT, FOCAL, BASELINE = 320, 240, 260.0, 0.12
#: Half sizes of the room; the camera is near its middle.
ROOM = np.array([2.2, 1.4, 2.6])
TEXELS = 96  # per scene unit


def camera(baseline: float | None = None) -> SequenceCamera:
    return SequenceCamera("PINHOLE", np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]), WIDTH, HEIGHT, baseline)


@cache
def _paintings() -> np.ndarray:
    """Six walls, one below the other (6 n, n): soft noise, and dark and bright rectangles with sharp edges."""
    rng = np.random.default_rng(7)
    size = int(2 * ROOM.max() * TEXELS) + 2
    walls = np.empty((6, size, size), np.float32)
    for wall in walls:
        noise = cv2.resize(rng.normal(size=(size // 6, size // 6)).astype(np.float32), (size, size))
        wall[:] = 120 + 14 * noise
        for _ in range(45):
            u, v = rng.integers(0, size - 60, 2)
            w, h = rng.integers(20, 110, 2)
            wall[v : v + h, u : u + w] += rng.choice([-55, 55])
        cv2.GaussianBlur(wall, (0, 0), 1.0, dst=wall)
    return np.clip(walls, 5, 250).reshape(-1, size)


def render(cam_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Grey image and depth of one camera."""
    gray, depth = _rendered(np.asarray(cam_from_world, float).tobytes())
    return gray.copy(), depth.copy()


@lru_cache(256)  # tests of a file look from the same places
def _rendered(pose: bytes) -> tuple[np.ndarray, np.ndarray]:
    cam_from_world = np.frombuffer(pose)
    world = se3.inverse(cam_from_world[None])[0]
    R = quaternion.to_matrix(world[:4])
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    y = ((np.arange(HEIGHT) + 0.5 - HEIGHT / 2) / FOCAL)[:, None]
    along = [row[0] * x + row[1] * y + row[2] for row in R]
    with np.errstate(divide="ignore"):
        distance = [(np.copysign(ROOM[k], along[k]) - world[4 + k]) / along[k] for k in range(3)]
    depth = np.minimum(np.minimum(distance[0], distance[1]), distance[2])
    is_x, is_z = depth == distance[0], depth == distance[2]
    place = [world[4 + k] + depth * along[k] for k in range(3)]
    is_far = np.where(is_x, along[0], np.where(is_z, along[2], along[1])) > 0
    wall = 2 * np.where(is_x, 0, np.where(is_z, 2, 1)) + is_far
    s = (np.where(is_x, place[1], place[0]) + ROOM.max()) * TEXELS
    t = (np.where(is_z, place[1], place[2]) + ROOM.max()) * TEXELS
    walls = _paintings()
    below = t + wall * walls.shape[1]
    gray = cv2.remap(walls, s.astype(np.float32), below.astype(np.float32), cv2.INTER_LINEAR)
    return np.round(gray).astype(np.uint8), depth.astype(np.float32)


def poses(count: int, turn: float = 0.02, step: float = 0.02) -> np.ndarray:
    """(count, 7) cam_from_world of a smooth motion: sideways and forward, turning about all axes."""
    t = np.arange(count)
    twist = np.zeros((count, 6))
    twist[:, 0], twist[:, 1], twist[:, 2] = step * t, 0.3 * step * np.sin(0.3 * t), 0.5 * step * t
    twist[:, 4], twist[:, 3], twist[:, 5] = turn * t, 0.3 * turn * np.sin(0.2 * t), 0.2 * turn * np.sin(0.25 * t)
    return se3.inverse(se3.exp(twist))


def frames(kind: str, cam_from_world: np.ndarray, rate: float = 30.0, seed: int = 0) -> list[Frame]:
    """Frames of a kind; grey levels and depths carry noise (1 level; 0.2 % of the squared depth)."""
    rng = np.random.default_rng(seed)
    shift = np.array([0, 0, 0, 1, -BASELINE, 0, 0])
    out = []
    for k, pose in enumerate(cam_from_world):
        gray, depth = render(pose)
        gray = np.clip(gray + rng.normal(size=gray.shape), 0, 255).astype(np.uint8)
        right = render(se3.compose(shift[None], pose[None])[0])[0] if kind == "stereo" else None
        noisy = (depth + 0.002 * depth**2 * rng.normal(size=depth.shape)).astype(np.float32)
        out.append(Frame(k / rate, gray, noisy if kind == "rgbd" else None, right, f"{k:04d}.png"))
    return out


def position_error(trajectory, truth: np.ndarray, rate: float = 30.0, scale: bool = False) -> float:
    """Root mean square distance of camera centres after alignment, scene units."""
    rows = np.round(trajectory.timestamps * rate).astype(int)
    a, b = trajectory.world_from_cam[:, 4:], se3.inverse(truth[rows])[:, 4:]
    a0, b0 = a - a.mean(0), b - b.mean(0)
    U, D, V = np.linalg.svd(b0.T @ a0)
    S = np.diag([1, 1, np.sign(np.linalg.det(U @ V))])
    factor = (D * np.diag(S)).sum() / (a0**2).sum() if scale else 1.0
    return float(np.sqrt(((factor * a0 @ (U @ S @ V).T - b0) ** 2).sum(axis=1).mean()))


def lap(count: int) -> np.ndarray:
    """A lap and a fifth around the middle of the room, looking outward and ahead; (count, 7) cam_from_world."""
    angle = 2 * np.pi * 1.2 * np.arange(count) / (count - 1)
    center = np.stack([np.sin(angle), 0.1 * np.sin(3 * angle), np.cos(angle)], axis=1)
    R = so3.exp(np.outer(angle + 0.4, [0.0, 1.0, 0.0]))
    return se3.inverse(np.hstack([quaternion.from_matrix(R), center]))
