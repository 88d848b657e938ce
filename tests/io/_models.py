# SPDX-License-Identifier: BSD-3-Clause
"""Small scenes for the tests of formats."""

import numpy as np

from groma.geometry import quaternion
from groma.scene import (
    Cameras,
    Directions,
    Frames,
    Images,
    Keypoints,
    LineObservations,
    Lines,
    Planes,
    PointObservations,
    Points,
    Relations,
    Rigs,
    Scene,
    Sensors,
)


def rig_scene(seed: int = 0) -> Scene:
    """Two rigs (one of two cameras, one of a single camera), three frames, all kinds of landmarks and relations."""
    rng = np.random.default_rng(seed)

    def poses(count: int) -> np.ndarray:
        turns = quaternion.exp(rng.normal(0, 1, (count, 3)))
        return np.hstack([turns / np.linalg.norm(turns, axis=1, keepdims=True), rng.normal(0, 2, (count, 3))])

    mounted = poses(3)
    mounted[[0, 2]] = [0, 0, 0, 1, 0, 0, 0]
    images = np.repeat(np.arange(5), 4)
    numbers = np.tile(np.arange(4), 5)
    is_point = numbers < 3
    return Scene(
        cameras=Cameras(
            ids=[2, 5, 9],
            models=("PINHOLE", "SIMPLE_PINHOLE", "PINHOLE"),
            params=[[500, 510, 320, 240], [400, 320, 240, 0], [450, 450, 100, 80.5]],
            width=[640, 640, 200],
            height=[480, 480, 161],
        ),
        rigs=Rigs([4, 7]),
        sensors=Sensors([0, 0, 1], [0, 0, 0], [2, 5, 9], [0, 1, 2], mounted, [1, 0, 1], [1, 1, 1]),
        frames=Frames([3, 6, 8], [0, 0, 1], poses(3)),
        images=Images(
            [10, 11, 12, 13, 20],
            ("a/1.png", "b/1.png", "a/2.png", "b/2.png", "mono_é.png"),
            [0, 1, 0, 1, 2],
            [0, 0, 1, 1, 2],
            [0, 1, 0, 1, 2],
        ),
        points=Points([1, 4, 1000], rng.normal(0, 3, (3, 3)), rng.integers(0, 256, (3, 3)), [0.25, -1.0, 1.5]),
        point_observations=PointObservations(
            images[is_point], numbers[is_point], rng.uniform(0, 160, (15, 2)), numbers[is_point]
        ),
        keypoints=Keypoints(images[~is_point], rng.uniform(0, 160, (5, 2)), numbers[~is_point]),
        lines=Lines.through(rng.normal(0, 2, (2, 2, 3)), ids=[6, 8]),
        line_observations=LineObservations([0, 2, 4], [0, 1, 1], rng.uniform(0, 160, (3, 4))),
        planes=Planes([1], [[0, 0.6, 0.8, -2.5]]),
        directions=Directions([3], [[0.6, 0, 0.8]]),
        relations=Relations([[0, 0]], [[1, 0]], [[0, 0], [1, 0]], [[2, 1]]),
    )
