# SPDX-License-Identifier: BSD-3-Clause
"""Small photographs of a house corner, two walls of tiles, with exact cameras and points: enough for lines and SIFT."""

import cv2
import numpy as np
from _renderings import board

from groma.cameras import model as camera_model
from groma.geometry import quaternion
from groma.scene import Cameras, PointObservations, Points, Scene

WIDTH, HEIGHT, FOCAL = 480, 360, 420.0
BOARD = (480, 360)  # pixels of a wall's texture
#: Corner, direction along and direction down of the two walls; 4 x 3 units each.
WALLS = np.array([[[-4, -1.5, 0], [1, 0, 0.15], [0, 1, 0]], [[0, -1.5, 0.6], [1, 0, -0.25], [0, 1, 0]]], float)


def facade(folder, num_images=5, seed=0, model="SIMPLE_PINHOLE", extra=(), num_points=120, motions=None):
    """Write photographs into a new folder; return the scene of their cameras and of points on the walls.

    With motions (N, 6) each is read row by row, while the camera moves and turns so far in its own axes.
    """
    motions = np.zeros((num_images, 6)) if motions is None else motions
    folder.mkdir(parents=True)
    rng = np.random.default_rng(seed)
    textures = []
    for _ in WALLS:
        clean = board(rng, *BOARD, tiles=40)
        textures.append(np.clip(clean + cv2.GaussianBlur(rng.normal(0, 40, clean.shape), None, 1.2), 0, 255))
    params = np.array([FOCAL, WIDTH / 2, HEIGHT / 2, *extra])
    camera = camera_model(model)
    u, v = np.meshgrid(np.arange(2 * WIDTH) / 2 + 0.25, np.arange(2 * HEIGHT) / 2 + 0.25)
    rays = camera.unproject(params, np.column_stack([u.ravel(), v.ravel()]))
    xyz = np.concatenate([points_on(wall, rng.uniform(0.05, 0.95, (num_points // 2, 2))) for wall in WALLS])
    poses, image_idx, point_idx, pixels = [], [], [], []
    for i in range(num_images):
        place = np.array([-1.8 + 3.6 * i / max(num_images - 1, 1), -0.3 + 0.25 * (i % 3), -4.6 + 0.2 * (i % 2)])
        R = looking(place, np.array([0.0, 0.0, 0.3]))
        poses.append([*quaternion.from_matrix(R), *(-R @ place)])
        image = np.full(len(rays), 90.0)
        depth = np.full(len(rays), np.inf)
        for wall, texture in zip(WALLS, textures, strict=True):
            s, t, z = meet(wall, *read_row_by_row(R, place, motions[i], rays, v.ravel()))
            level = cv2.remap(
                texture.astype(np.float32),
                (s * BOARD[0] - 0.5).astype(np.float32).reshape(u.shape),
                (t * BOARD[1] - 0.5).astype(np.float32).reshape(u.shape),
                cv2.INTER_LINEAR,
            ).ravel()
            front = (s > 0) & (s < 1) & (t > 0) & (t < 1) & (z > 0) & (z < depth)
            image[front], depth[front] = level[front], z[front]
        image = image.reshape(HEIGHT, 2, WIDTH, 2).mean(axis=(1, 3)) + rng.normal(0, 1.0, (HEIGHT, WIDTH))
        cv2.imwrite(str(folder / f"{i:04d}.png"), np.clip(np.round(image), 0, 255).astype(np.uint8))
        seen = np.full((len(xyz), 2), HEIGHT / 2)
        for _ in range(30 if motions[i].any() else 1):
            centers, turns = cameras_of_rows(R, place, motions[i], seen[:, 1])
            seen = camera.project(params, np.einsum("nij,nj->ni", turns, xyz - centers))
        inside = ((seen > 2) & (seen < [WIDTH - 2, HEIGHT - 2])).all(1)
        image_idx.append(np.full(inside.sum(), i))
        point_idx.append(np.flatnonzero(inside))
        pixels.append(seen[inside] + rng.normal(0, 0.2, (inside.sum(), 2)))
    scene = Scene.from_images(
        cameras=Cameras(
            ids=np.array([1]), models=(model,), params=params[None], width=np.array([WIDTH]), height=np.array([HEIGHT])
        ),
        names=tuple(f"{i:04d}.png" for i in range(num_images)),
        camera_idx=np.zeros(num_images, np.int64),
        cam_from_world=np.array(poses),
    )
    return scene.replace(
        points=Points(
            ids=np.arange(len(xyz)) + 1, xyz=xyz, color=np.zeros((len(xyz), 3), np.uint8), error=np.zeros(len(xyz))
        ),
        point_observations=PointObservations(
            np.concatenate(image_idx), np.concatenate(point_idx), np.concatenate(pixels), number(image_idx)
        ),
    )


def cameras_of_rows(R, place, motion, rows):
    """Centres (n, 3) and rotations from the world (n, 3, 3) of the cameras that see rows of an image."""
    rows, of = np.unique(rows, return_inverse=True)
    s = np.clip(rows, -HEIGHT, 2 * HEIGHT)[:, None] / HEIGHT - 0.5
    return (place + s * (motion[:3] @ R))[of], (quaternion.to_matrix(quaternion.exp(-s * motion[3:])) @ R)[of]


def read_row_by_row(R, place, motion, rays, rows):
    """Centres and directions in the world of rays in the camera."""
    if not motion.any():
        return place, rays @ R
    centers, turns = cameras_of_rows(R, place, motion, rows)
    return centers, np.einsum("nji,nj->ni", turns, rays)


def number(image_idx):
    return np.concatenate([np.arange(len(rows)) for rows in image_idx])


def points_on(wall, st):
    return wall[0] + 4.0 * st[:, :1] * wall[1] + 3.0 * st[:, 1:] * wall[2]


def looking(place, at):
    """Rotation (3, 3) from the world to a camera that looks at a point, upright (y down)."""
    z = (at - place) / np.linalg.norm(at - place)
    x = np.cross([0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def meet(wall, place, rays):
    """Where rays meet a wall: shares of its width and height, and the distance."""
    normal = np.cross(wall[1], wall[2])
    z = ((wall[0] - place) @ normal) / (rays @ normal)
    away = place + z[:, None] * rays - wall[0]
    return away @ wall[1] / (4.0 * wall[1] @ wall[1]), away @ wall[2] / 3.0, z
