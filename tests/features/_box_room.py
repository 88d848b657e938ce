# SPDX-License-Identifier: BSD-3-Clause
"""A room with panels on its walls and a box in it, rendered by ray casting for any camera, with its true edges."""

import cv2
import numpy as np

from groma import cameras as camera_models
from groma.geometry import quaternion
from groma.scene import Cameras, PointObservations, Points, Scene

#: Half the sides of the room, scene units.
HALF = np.array([3.0, 2.5, 1.5])


def room(folder, camera, count=8, samples=2, noise=2.0, seed=0):
    """Write images of the room and return their scene with points, and the true edges (E, 2, 3).

    ``camera`` is a model's name, its parameters, width and height.
    """
    rng = np.random.default_rng(seed)
    polygons, shades = _polygons(rng)
    edges = np.concatenate([np.stack([one, np.roll(one, -1, axis=0)], axis=1) for one in polygons])
    poses = _poses(rng, count)
    name, params, width, height = camera
    model, params = camera_models.model(name), np.array(params, float)
    grid = [(np.arange(n * samples) + 0.5) / samples for n in (width, height)]
    pixels = np.stack(np.meshgrid(*grid), axis=-1).reshape(-1, 2)
    rays = model.unproject(params, pixels)
    seen = np.isfinite(rays).all(axis=1)
    seen[seen] = np.abs(model.project(params, rays[seen]) - pixels[seen]).max(axis=1) < 0.1
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{i:02d}.png" for i in range(count)]
    for pose, file in zip(poses, names, strict=True):
        grey = np.zeros(len(rays))
        hit, _ = _cast(polygons, pose, rays[seen])
        grey[seen] = shades[hit]
        image = grey.reshape(height, samples, width, samples).mean((1, 3)) + rng.normal(0.0, noise, (height, width))
        cv2.imwrite(str(folder / file), np.clip(image, 0, 255).astype(np.uint8))
    points, observations = _points(rng, polygons, poses, model, params, (width, height))
    cameras = Cameras(np.array([1]), (name,), params[None], np.array([width]), np.array([height]))
    scene = Scene.from_images(
        cameras, names, np.zeros(count, int), poses, points=points, point_observations=observations
    )
    return scene, edges


def distance_to_edges(places, edges):
    """Distances (N,) of places (N, 3) from the nearest of edges (E, 2, 3)."""
    along = edges[:, 1] - edges[:, 0]
    share = np.einsum("nei,ei->ne", places[:, None] - edges[None, :, 0], along) / (along**2).sum(1)
    nearest = edges[:, 0] + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(places[:, None] - nearest, axis=2).min(axis=1)


def _quad(axis, side, center, size):
    """A rectangle across an axis: (4, 3)."""
    others = [k for k in range(3) if k != axis]
    corners = np.zeros((4, 3))
    corners[:, axis] = side
    for k, other in enumerate(others):
        corners[:, other] = center[k] + size[k] * np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])[k]
    return corners


def _polygons(rng):
    polygons, shades = [], []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for sign in (-1.0, 1.0):
            polygons.append(_quad(axis, sign * HALF[axis], (0.0, 0.0), HALF[others]))
            shades.append(rng.uniform(90.0, 160.0))
            for place in (-0.5, 0.5):  # two panels before each wall
                center = np.array([place, 0.0]) * HALF[others] + rng.uniform(-0.1, 0.1, 2)
                size = rng.uniform(0.22, 0.38, 2) * HALF[others]
                polygons.append(_quad(axis, sign * (HALF[axis] - 0.01), center, size))
                shades.append(rng.choice([30.0, 220.0]))
    for low, high in (([1.2, 0.9, -1.5], [2.0, 1.6, -0.6]), ([-2.2, -1.8, -1.5], [-1.5, -1.0, -0.3])):
        low, high = np.array(low), np.array(high)
        for axis in range(3):
            others = [k for k in range(3) if k != axis]
            for side in (low, high):
                polygons.append(_quad(axis, side[axis], 0.5 * (low + high)[others], 0.5 * (high - low)[others]))
                shades.append(rng.choice([60.0, 110.0, 190.0, 240.0]))
    return polygons, np.array(shades)


def _poses(rng, count):
    """Cameras on a closed path through the room, upright but for some degrees, turned anyhow: (C, 7)."""
    poses = []
    for k in range(count):
        a = 2.0 * np.pi * k / count
        center = np.array([1.0 * np.cos(a), 0.9 * np.sin(a), 0.3 * np.sin(2 * a)]) + rng.normal(0, 0.05, 3)
        turn = rng.uniform(0, 2 * np.pi)
        z = np.array([np.cos(turn), np.sin(turn), rng.normal(0, 0.08)])
        z /= np.linalg.norm(z)
        x = np.cross(z, [rng.normal(0, 0.08), rng.normal(0, 0.08), 1.0])
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z])
        poses.append(np.concatenate([quaternion.from_matrix(rotation[None])[0], -rotation @ center]))
    return np.array(poses)


def _cast(polygons, pose, rays):
    """For each ray (N, 3), the polygon that it meets first, and at how many lengths of the ray."""
    turn = quaternion.to_matrix(pose[None, :4])[0]
    center, along = -turn.T @ pose[4:], np.ascontiguousarray((rays @ turn).T)
    with np.errstate(divide="ignore"):
        inverse = 1.0 / along
    nearest, hit = np.full(len(rays), np.inf), np.zeros(len(rays), int)
    for k, polygon in enumerate(polygons):
        low, high = polygon.min(axis=0), polygon.max(axis=0)
        axis = int((high - low).argmin())
        away = (low[axis] - center[axis]) * inverse[axis]
        inside = (away > 1e-6) & (away < nearest)
        for other in (one for one in range(3) if one != axis):
            rows = np.flatnonzero(inside)
            place = center[other] + away[rows] * along[other, rows]
            inside[rows] = (place >= low[other]) & (place <= high[other])
        nearest[inside], hit[inside] = away[inside], k
    return hit, nearest


def _points(rng, polygons, poses, model, params, size):
    """Points on all surfaces, observed with 0.3 pixels of noise."""
    parts = []
    for polygon in polygons:
        s, t = rng.uniform(0.05, 0.95, (2, 40, 1))
        parts.append(polygon[0] + s * (polygon[1] - polygon[0]) + t * (polygon[3] - polygon[0]))
    xyz, table = np.concatenate(parts), []
    for i, pose in enumerate(poses):
        local = quaternion.rotate(pose[:4], xyz) + pose[4:]
        pixel = model.project(params, local)
        seen = np.isfinite(pixel).all(1) & np.all((pixel > 1) & (pixel < np.array(size) - 1), axis=1)
        back = model.unproject(params, pixel[seen])
        unit = local[seen] / np.linalg.norm(local[seen], axis=1)[:, None]
        seen[seen] = np.linalg.norm(back - unit, axis=1) < 1e-3
        _, away = _cast(polygons, pose, np.ascontiguousarray(local[seen]))
        rows = np.flatnonzero(seen)[away > 1.0 - 1e-6]
        table.append((np.full(len(rows), i), rows, pixel[rows] + rng.normal(0, 0.3, (len(rows), 2))))
    image, point, pixel = (np.concatenate(column) for column in zip(*table, strict=True))
    used, point = np.unique(point, return_inverse=True)
    return Points.at(xyz[used]), PointObservations(image, point, pixel, np.arange(len(image)))
