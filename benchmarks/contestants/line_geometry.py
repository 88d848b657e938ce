# SPDX-License-Identifier: BSD-3-Clause
"""Lines made, transformed and projected per second: ``line_geometry.py groma|numpy|spatialmath NUMBER``.

The same lines through two random points, the same pose and pinhole. spatialmath has objects, one line each, and no
projection of lines; its image lines are taken from the transformed moment. Prints lines per second and how far the
image lines are from the pixels of the two points, as a fraction of the pixels. Runs in an environment that has what it
measures.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from _common import report

POSE = np.array([0.1, -0.2, 3.0])
FOCAL, CENTER = 800.0, np.array([640.0, 480.0])
#: K times the moment is the image line.
LINE_INTRINSICS = np.array([[FOCAL, 0, 0], [0, FOCAL, 0], [-FOCAL * CENTER[0], -FOCAL * CENTER[1], FOCAL * FOCAL]])


def rotation() -> np.ndarray:
    """Return the rotation of the pose."""
    matrix = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    return matrix * np.sign(np.linalg.det(matrix))


def rate(work, count: int) -> tuple[float, object]:
    """Return items per CPU second, the best of five rounds, and the last result."""
    best, result = float("inf"), None
    for _ in range(5):
        begin = time.process_time()
        result = work()
        best = min(best, time.process_time() - begin)
    return count / max(best, 1e-9), result


def with_groma(first, second) -> tuple:
    """Return the three operations."""
    from groma.geometry import line3, projection, se3, transform

    turn = rotation()
    pose = se3.from_matrix(np.vstack([np.column_stack([turn, POSE]), [0, 0, 0, 1]]))
    intrinsics = np.array([[FOCAL, 0, CENTER[0]], [0, FOCAL, CENTER[1]], [0, 0, 1]])
    camera = projection.camera_matrix(intrinsics, pose)
    lines = line3.from_points(first, second)
    return (
        lambda: line3.from_points(first, second),
        lambda: transform.rigid_lines(pose, lines),
        lambda: projection.project_lines(camera, lines),
    )


def with_numpy(first, second) -> tuple:
    """Return the three operations."""
    turn = rotation()

    def make():
        return np.concatenate([np.cross(first, second), second - first], axis=1)

    lines = make()

    def transform():
        direction = lines[:, 3:] @ turn.T
        return np.concatenate([lines[:, :3] @ turn.T + np.cross(POSE, direction), direction], axis=1)

    return make, transform, lambda: transform()[:, :3] @ LINE_INTRINSICS.T


def with_spatialmath(first, second) -> tuple:
    """Return the three operations, one object at a time."""
    from spatialmath import SE3, Line3

    pose = SE3.Rt(rotation(), POSE, check=False)

    def make():
        return [Line3.Join(p, q) for p, q in zip(first, second, strict=True)]

    lines = make()

    def transform():
        moved = []
        for line in lines:
            try:
                moved.append(pose * line)
            except ValueError:  # it refuses its own rounding errors in some products
                moved.append(None)
        return moved

    def project():
        return np.array([np.full(3, np.nan) if line is None else LINE_INTRINSICS @ line.v for line in transform()])

    return make, transform, project


def main() -> None:
    program, count = sys.argv[1], int(sys.argv[2])
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(count, 3)), rng.normal(size=(count, 3))
    works = {"groma": with_groma, "numpy": with_numpy, "spatialmath": with_spatialmath}[program](first, second)
    rates = dict(
        zip(("made", "transformed", "transformed_and_projected"), (rate(w, count) for w in works), strict=True)
    )
    # an image line must pass through the pixels of the two points
    image = np.asarray(rates["transformed_and_projected"][1], dtype=float)
    image = image / np.linalg.norm(image[:, :2], axis=1)[:, None]
    error = np.zeros(count)
    for points in (first, second):
        place = points @ rotation().T + POSE
        pixel = FOCAL * place[:, :2] / place[:, 2:] + CENTER
        error = np.maximum(error, np.abs((image[:, :2] * pixel).sum(1) + image[:, 2]) / np.linalg.norm(pixel, axis=1))
    report(
        contestant=program,
        number=count,
        per_second={name: value for name, (value, _) in rates.items()},
        refused=int(np.isnan(error).sum()),
        median_error=float(np.nanmedian(error)),
    )


if __name__ == "__main__":
    main()
