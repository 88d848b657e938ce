# SPDX-License-Identifier: BSD-3-Clause
"""Scenes seen by cameras that move while their images are read; every pixel is exact, by the row where it appears."""

import numpy as np

from groma.geometry import quaternion, se3
from groma.scene import Cameras, LineObservations, Lines, PointObservations, Points, Scene

FOCAL, WIDTH, HEIGHT = 500.0, 640, 480


def look(centers, targets, roll):
    """Poses (N, 7) of cameras that look at targets, turned about their axes."""
    turned = quaternion.multiply(
        quaternion.exp(np.outer(roll, [0.0, 0.0, 1.0])), se3.looking_at(centers, targets)[:, :4]
    )
    return np.hstack([turned, -quaternion.rotate(turned, centers)])


def photographs(count=12, seed=0):
    """Poses around a box, some held upright, and a motion for each."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 1.2, count)
    centers = np.column_stack([7.0 * np.cos(angle), 7.0 * np.sin(angle), rng.uniform(-1.5, 1.5, count)])
    roll = np.where(np.arange(count) % 3 == 1, np.pi / 2, 0.0) + rng.normal(0.0, 0.1, count)
    motion = np.hstack([rng.normal(0.0, 0.03, (count, 3)), rng.normal(0.0, np.radians(1.0), (count, 3))])
    return look(centers, rng.normal(0.0, 0.5, (count, 3)), roll), motion


def video(count=24, share=0.6):
    """Poses of a smooth path, upright, each read in a share of the time to the next; the motion is that of the path."""

    def at(time):
        angle = 0.09 * time + 0.05 * np.sin(0.9 * time)
        centers = np.column_stack([7.0 * np.cos(angle), 7.0 * np.sin(angle), 0.8 * np.sin(0.4 * time)])
        targets = np.column_stack([0.3 * np.sin(1.1 * time), 0.2 * np.cos(0.7 * time), 0.5 * np.sin(0.8 * time)])
        return look(centers, targets, 0.1 * np.sin(1.3 * time)), centers

    time, half = np.arange(count) * 1.0, share / 2
    poses, _ = at(time)
    (before, c0), (after, c1) = at(time - half), at(time + half)
    turned = quaternion.multiply(after[:, :4], quaternion.conjugate(before[:, :4]))
    return poses, np.hstack([quaternion.rotate(poses[:, :4], c1 - c0), -quaternion.log(turned)])


def seen(pose, motion, points, by_columns=False):
    """Pixels of points in an image that is read while the camera moves: the row decides when, and when the row."""
    inside = quaternion.rotate(np.tile(pose[:4], (len(points), 1)), points) + pose[4:]
    offset = np.zeros(len(points))
    for _ in range(60):
        s = offset[:, None]
        moved = quaternion.rotate(quaternion.exp(-s * motion[3:]), inside - s * motion[:3])
        pixel = FOCAL * moved[:, :2] / moved[:, 2:] + np.array([WIDTH, HEIGHT]) / 2
        offset = pixel[:, 0] / WIDTH - 0.5 if by_columns else pixel[:, 1] / HEIGHT - 0.5
        offset = np.clip(offset, -2.0, 2.0)
    return pixel, (moved[:, 2] > 0.5) & (pixel > 0.0).all(1) & (pixel < [WIDTH, HEIGHT]).all(1)


def rolling_scene(poses, motions, noise=0.3, seed=1, by_columns=False, lines=30):
    """A box of points and edges on it, seen by cameras that move; at the true poses and places, without motions."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2.0, 2.0, (250, 3))
    corner = rng.uniform(-1.5, 1.5, (lines, 3))
    ends = np.stack([corner, corner + rng.normal(0.0, 0.8, (lines, 3))], axis=1)
    tables = {kind: ([], [], []) for kind in ("points", "lines")}
    for image, (pose, motion) in enumerate(zip(poses, motions, strict=True)):
        pixel, good = seen(pose, motion, points, by_columns)
        segment, whole = seen(pose, motion, ends.reshape(-1, 3), by_columns)
        whole = whole.reshape(-1, 2).all(1)
        found = {"points": (pixel, good), "lines": (segment.reshape(-1, 4), whole)}
        for kind, (values, kept) in found.items():
            rows = np.flatnonzero(kept)
            measured = values[rows] + rng.normal(0.0, noise, values[rows].shape)
            for column, part in zip(tables[kind], (np.full(len(rows), image), rows, measured), strict=True):
                column.append(part)
    joined = {kind: [np.concatenate(column) for column in columns] for kind, columns in tables.items()}
    params, size = np.array([[FOCAL, WIDTH / 2, HEIGHT / 2]]), np.array([[WIDTH], [HEIGHT]])
    return Scene.from_images(
        Cameras(np.array([1]), ("SIMPLE_PINHOLE",), params, *size),
        [f"{k}.png" for k in range(len(poses))],
        np.zeros(len(poses), int),
        poses,
        points=Points(np.arange(250) + 1, points, np.zeros((250, 3), int), np.zeros(250)),
        point_observations=PointObservations.numbered(*joined["points"]),
        lines=Lines.through(ends),
        line_observations=LineObservations(*joined["lines"]),
    )


def disturbed(scene, seed=2):
    """Poses and landmarks away from the truth."""
    rng = np.random.default_rng(seed)
    centers = scene.cam_centers_in_world + rng.normal(0.0, 0.03, (scene.num_images, 3))
    turned = quaternion.multiply(
        quaternion.exp(rng.normal(0.0, 0.005, (scene.num_images, 3))), scene.cam_from_world[:, :4]
    )
    scene = scene.with_poses(np.hstack([turned, -quaternion.rotate(turned, centers)]))
    return scene.with_points(scene.points.xyz + rng.normal(0.0, 0.03, (scene.num_points, 3)))
