# SPDX-License-Identifier: BSD-3-Clause
"""Segments of lines whose truth is known, in images with exact poses."""

from dataclasses import dataclass

import numpy as np

from groma import cameras as camera_models
from groma.features.matches import LineMatches
from groma.features.segments import Segments
from groma.geometry import quaternion, se3
from groma.mapping.lines.line_map import LineMap
from groma.scene import Cameras, PointObservations, Points, Scene

WIDTH, HEIGHT = 800, 600


@dataclass(frozen=True)
class Wireframe:
    scene: Scene
    segments: list[Segments]
    #: Per image, the true line of each segment; -1 for clutter.
    truth: list[np.ndarray]
    lines: np.ndarray  # (L, 2, 3)

    def matches(self, i: int, j: int) -> LineMatches:
        known = {n: k for k, n in enumerate(self.truth[j]) if n >= 0}
        pairs = [(k, known[n]) for k, n in enumerate(self.truth[i]) if n in known]
        return LineMatches(np.array(pairs, np.int64).reshape(-1, 2), np.ones(len(pairs)))


def wireframe(
    centers: np.ndarray,
    lines: np.ndarray,
    rng: np.random.Generator,
    sigma: float = 0.2,
    num_clutter: int = 0,
    model: str = "PINHOLE",
    params: tuple = (700.0, 700.0, 400.0, 300.0),
    num_points: int = 150,
    targets: np.ndarray | None = None,
) -> Wireframe:
    camera = camera_models.model(model)
    targets = np.zeros_like(centers) if targets is None else targets
    poses = se3.looking_at(centers, targets)
    xyz = rng.uniform(-1.2, 1.2, (num_points, 3))
    segments, truth, seen = [], [], []
    for i, pose in enumerate(poses):

        def project(points, pose=pose):
            points = quaternion.rotate(np.broadcast_to(pose[:4], (len(points), 4)), points) + pose[4:]
            return camera.project(np.array(params), points)

        # Each image sees another part of each line.
        part = np.column_stack([rng.uniform(0.0, 0.15, len(lines)), rng.uniform(0.85, 1.0, len(lines))])
        ends = [project(lines[:, 0] + part[:, k : k + 1] * (lines[:, 1] - lines[:, 0])) for k in (0, 1)]
        ends = np.hstack(ends) + rng.normal(0.0, sigma, (len(lines), 4))
        inside = np.isfinite(ends).all(1) & (ends > 0).all(1) & (ends < [WIDTH, HEIGHT] * 2).all(1)
        inside &= np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]) > 20.0
        angle, length = rng.uniform(0, 2 * np.pi, num_clutter), rng.uniform(20, 80, num_clutter)
        start = rng.uniform(100, 500, (num_clutter, 2))
        clutter = np.hstack([start, start + length[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])])
        order = rng.permutation(inside.sum() + num_clutter)
        segments.append(Segments.from_ends(np.vstack([ends[inside], clutter])[order], max(sigma, 0.05)))
        truth.append(np.concatenate([np.flatnonzero(inside), np.full(num_clutter, -1)])[order])
        pixel = project(xyz)
        good = np.flatnonzero(np.isfinite(pixel).all(1) & (pixel > 0).all(1) & (pixel < [WIDTH, HEIGHT]).all(1))
        seen.append((np.full(len(good), i), good, pixel[good]))
    tables = {}
    if num_points:
        image, point, pixel = (np.concatenate(column) for column in zip(*seen, strict=True))
        tables["points"] = Points.at(xyz)
        tables["point_observations"] = PointObservations(image, point, pixel, point)
    cameras = Cameras(np.array([1]), (model,), np.array([params]), np.array([WIDTH]), np.array([HEIGHT]))
    names = [f"{i}.png" for i in range(len(poses))]
    return Wireframe(
        Scene.from_images(cameras, names, np.zeros(len(poses), int), poses, **tables), segments, truth, lines
    )


def arc(count: int, step: float = 0.12, radius: float = 4.0, rise: float = 0.25) -> np.ndarray:
    """Camera centres on an arc, going up and down."""
    a = step * (np.arange(count) - 0.5 * (count - 1))
    return np.column_stack([radius * np.sin(a), -radius * np.cos(a), rise * np.sin(2.3 * np.arange(count))])


def random_lines(count: int, rng: np.random.Generator) -> np.ndarray:
    middle, along = rng.uniform(-0.9, 0.9, (count, 3)), rng.normal(size=(count, 3))
    along *= rng.uniform(0.2, 0.5, (count, 1)) / np.linalg.norm(along, axis=1, keepdims=True)
    return np.stack([middle - along, middle + along], axis=1)


def true_lines(world: Wireframe, line_map: LineMap) -> np.ndarray:
    """The true line of each mapped line; -2 where its observations disagree."""
    owners = np.array(
        [world.truth[i][s] for i, s in zip(line_map.image_idx, line_map.segment_idx, strict=True)], np.int64
    )
    out = np.full(line_map.num_lines, -2)
    for n in range(line_map.num_lines):
        mine = np.unique(owners[line_map.line_idx == n])
        out[n] = mine[0] if len(mine) == 1 else -2
    return out


def distance_to_truth(world: Wireframe, line_map: LineMap, line: int, true: int) -> float:
    a, b = world.lines[true]
    d = (b - a) / np.linalg.norm(b - a)
    return np.linalg.norm(np.cross(line_map.segments[line] - a, d), axis=1).max()
