# SPDX-License-Identifier: BSD-3-Clause
"""Rendered facades with a row of equal windows: what stands beside them tells one from the next, or nothing does."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from _turning import Film, Renderer
from _turning_worlds import TEXELS, World

from groma.geometry import quaternion, so3
from groma.io import write_scene
from groma.io.sequences import SequenceCamera
from groma.scene import Cameras, Scene

#: Metres from window to window, of the whole facade, and its height; texels per metre, about as many as pixels.
STEP, LENGTH, TALL, FINE = 3.0, 60.0, 7.5, 75.0
CAMERA = SequenceCamera("PINHOLE", np.array([525.0, 525.0, 320.0, 240.0]), 640, 480)
#: Where cameras stand along the facade: those of the map, and queries by their kind; *another* is another facade.
MAPPED = np.arange(8.0, 24.0, 1.2)
QUERIES = {
    "mapped": np.arange(8.5, 23.0, 0.9),
    "further": np.arange(32.0, 54.0, 1.1),
    "another": np.arange(8.5, 50.0, 2.1),
}


def facade(seed: int, other: bool = False) -> World:
    """A wall along x in the plane z = 0, with two rows of equal windows; plaster, posters and doors are its own."""
    windows, own = np.random.default_rng([seed, 0]), np.random.default_rng([seed, 1 + other])
    world = World(own)
    for left in np.arange(0.0, LENGTH, 6.0):
        plaster = world.paint(world.smooth(150.0, 2.5, 4) + world.smooth(0.0, 3.0, 32))
        world.add([left, -TALL, 0.0], [6.0, 0, 0], [0, TALL, 0], plaster, TEXELS / 6.0)
    world.add([-20.0, 0.0, -20.0], [LENGTH + 40.0, 0, 0], [0, 0, 20.0], world.paint(world.smooth(105, 7.0, 4)), 40.0)
    glass = world.paint(_window(windows))
    for left in np.arange(0.9, LENGTH - 1.2, STEP):
        for top in (-3.0, -6.3):
            world.add([left, top, -0.03], [1.2, 0, 0], [0, 1.7, 0], glass, FINE)
    for left in own.uniform(1.0, LENGTH - 2.0, 10):
        number, (width, height) = world.paint(world.printed(120.0, 60, 60.0)), own.uniform(0.4, 1.0, 2)
        world.add([left, -own.uniform(1.2, 2.4), -0.05], [width, 0, 0], [0, height, 0], number, FINE * 2)
    return world


def _window(rng: np.random.Generator) -> np.ndarray:
    """A window of 1.2 by 1.7 metres: frame, bars, and a curtain that is its own."""
    image = np.full((TEXELS, TEXELS), 205.0)
    image[8:120, 8:82] = 60.0 + 15.0 * cv2.resize(rng.normal(size=(14, 10)), (74, 112), interpolation=cv2.INTER_CUBIC)
    image[50:55, 8:82], image[8:120, 43:47] = 190.0, 190.0
    return cv2.GaussianBlur(image, (0, 0), 0.8)


def write(folder: Path, seed: int) -> Path:
    """Render photographs and queries into a folder, and ``queries.npz`` of their poses; return the poses of the map."""
    rng = np.random.default_rng([seed, 9])
    taken: dict[str, dict[str, np.ndarray]] = {"mapped": {}, "queries": {}}
    for kind, places in {"": MAPPED, **QUERIES}.items():
        renderer, group = Renderer(facade(seed, kind == "another"), CAMERA), "queries" if kind else "mapped"
        (folder / group).mkdir(parents=True, exist_ok=True)
        for number, along in enumerate(places):
            pose = _pose(along + rng.uniform(-0.2, 0.2), rng)
            light = renderer.picture(pose, pose, Film(0.1))[0] + rng.normal(0.0, 2.0, (CAMERA.height, CAMERA.width))
            name = f"{kind}_{number:02d}.png".lstrip("_")
            cv2.imwrite(str(folder / group / name), np.clip(light, 0, 255).astype(np.uint8))
            taken[group][name] = pose
    camera = Cameras(np.array([1]), ("PINHOLE",), CAMERA.params[None], np.array([640]), np.array([480]))
    for group, poses in taken.items():
        scene = Scene.from_images(camera, list(poses), np.zeros(len(poses), int), np.array(list(poses.values())))
        write_scene(scene, folder / f"{group}.npz", force=True)
    return folder / "mapped.npz"


def _pose(along: float, rng: np.random.Generator) -> np.ndarray:
    """A camera 5 to 8 metres before the facade, at eye height, turned by some degrees."""
    center = np.array([along, -1.7 + rng.uniform(-0.2, 0.2), -rng.uniform(5.0, 8.0)])
    yaw, pitch, roll = np.radians(rng.uniform([-20.0, 4.0, -2.0], [20.0, 12.0, 2.0]))
    R = (so3.exp(np.array([[0.0, yaw, 0.0]])) @ so3.exp(np.array([[pitch, 0.0, roll]])))[0].T
    return np.concatenate([quaternion.from_matrix(R[None])[0], -R @ center])
