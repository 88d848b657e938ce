# SPDX-License-Identifier: BSD-3-Clause
"""Worlds for rendered turns: rooms with plain and printed walls, and two streets that cross."""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np

from groma.geometry import so3

#: Side of a pattern, texels; patterns repeat.
TEXELS = 512


@dataclass
class World:
    """Rectangles: corner and two perpendicular sides (3, 3), number of the pattern, and its texels per metre."""

    rng: np.random.Generator
    rectangles: list[np.ndarray] = field(default_factory=list)
    pattern: list[int] = field(default_factory=list)
    scale: list[float] = field(default_factory=list)
    patterns: list[np.ndarray] = field(default_factory=list)
    #: How far each rectangle moves from frame to frame, metres.
    speed: list[np.ndarray] = field(default_factory=list)

    def paint(self, image: np.ndarray) -> int:
        """Add a pattern; return its number."""
        self.patterns.append(np.clip(image, 4, 250).astype(np.float32))
        return len(self.patterns) - 1

    def add(self, corner, first, second, pattern: int, scale: float) -> None:
        """Add a rectangle."""
        self.rectangles.append(np.array([corner, first, second], float))
        self.pattern.append(pattern)
        self.scale.append(scale)
        self.speed.append(np.zeros(3))

    def drive(self, at, step) -> None:
        """Add a car that is at a place (x, z) in the first frame and goes a step in each."""
        low, first = np.array([at[0] - 2.1, 0.1, at[1] - 0.9]), len(self.speed)
        paints = [self.paint(self.printed(level, 40, 60)) for level in (60, 190)]
        self.box(low, low + np.array([4.2, 1.5, 1.8]), paints, 120.0)
        self.speed[first:] = [np.array([step[0], 0.0, step[1]])] * (len(self.speed) - first)

    def box(self, low, high, patterns: list[int], scale: float, turn: float = 0.0) -> None:
        """Add the six sides of a box, turned about the vertical axis through its middle."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        middle, size = 0.5 * (low + high), high - low
        R = so3.exp(np.array([[0.0, turn, 0.0]]))[0]
        for axis in range(3):
            one, two = (axis + 1) % 3, (axis + 2) % 3
            for side in (0.0, 1.0):
                corner = -0.5 * size
                corner[axis] += side * size[axis]
                sides = np.zeros((2, 3))
                sides[0, one], sides[1, two] = size[one], size[two]
                number = patterns[int(self.rng.integers(len(patterns)))]
                self.add(middle + R @ corner, R @ sides[0], R @ sides[1], number, scale)

    def smooth(self, level: float, spread: float, coarse: int) -> np.ndarray:
        """A pattern of soft blotches some texels wide."""
        noise = cv2.resize(
            self.rng.normal(size=(TEXELS // coarse,) * 2), (TEXELS, TEXELS), interpolation=cv2.INTER_CUBIC
        )
        return level + spread * noise

    def printed(self, level: float, count: int, contrast: float) -> np.ndarray:
        """A pattern of rectangles in shades."""
        image = self.smooth(level, 3.0, 32)
        for _ in range(count):
            u, v = self.rng.integers(0, TEXELS - 30, 2)
            w, h = self.rng.integers(8, 120, 2)
            image[v : v + h, u : u + w] += self.rng.uniform(-contrast, contrast)
        return cv2.GaussianBlur(image, (0, 0), 0.8)


def make_room(seed: int, plain: bool = False, size: float = 1.0) -> World:
    """A room of 6 x 5 metres, or that times a size: plain or printed walls, pictures, boards and boxes."""
    rng = np.random.default_rng(seed)
    world = World(rng)
    # Plain walls show little more than a change of shade.
    walls = [
        world.paint(world.smooth(rng.uniform(110, 190), 3.0, 64) if plain else world.printed(150, 60, 25))
        for _ in range(4)
    ]
    floor = world.paint(world.smooth(95, 6.0, 16) if plain else world.printed(100, 120, 30))
    ceiling = world.paint(world.smooth(205, 2.0, 64))
    prints = [world.paint(world.printed(rng.uniform(70, 180), 90, 70)) for _ in range(4)]
    shades = [world.paint(world.smooth(level, 2.5, 64)) for level in (45, 80, 120, 170, 225)]
    x, y, z = 3.0 * size, 1.3, 2.5 * size
    per_metre = TEXELS / 6.0
    world.add([-x, -y, z], [2 * x, 0, 0], [0, 2 * y, 0], walls[0], per_metre)
    world.add([-x, -y, -z], [2 * x, 0, 0], [0, 2 * y, 0], walls[1], per_metre)
    world.add([x, -y, -z], [0, 0, 2 * z], [0, 2 * y, 0], walls[2], per_metre)
    world.add([-x, -y, -z], [0, 0, 2 * z], [0, 2 * y, 0], walls[3], per_metre)
    world.add([-x, y, -z], [2 * x, 0, 0], [0, 0, 2 * z], floor, per_metre)
    world.add([-x, -y, -z], [2 * x, 0, 0], [0, 0, 2 * z], ceiling, per_metre)
    # Pictures and doors, a centimetre or two in front of the walls.
    for wall in range(4):
        along, depth = (2 * x, z) if wall < 2 else (2 * z, x)
        sign = 1.0 if wall % 2 == 0 else -1.0
        for item in range(4):
            width, height = rng.uniform(0.3, 1.1, 2)
            s, t = rng.uniform(0.1, along - width - 0.1), rng.uniform(0.1, 2 * y - height - 0.3)
            number = (
                prints[int(rng.integers(4))] if rng.random() < (0.5 if plain else 0.7) else shades[int(rng.integers(5))]
            )
            at = sign * (depth - 0.015 - 0.004 * item)
            corner = [-x + s, -y + t, at] if wall < 2 else [at, -y + t, -z + s]
            side = [width, 0, 0] if wall < 2 else [0, 0, width]
            world.add(corner, side, [0, height, 0], number, 260.0)
    # Furniture around the walls.
    for k in range(7):
        angle = 2 * np.pi * (k + rng.uniform(0.2, 0.8)) / 7
        size = np.array([rng.uniform(0.3, 0.9), rng.uniform(0.4, 1.5), rng.uniform(0.3, 0.8)])
        middle = np.array([0.72 * x * np.sin(angle), y - size[1] / 2, 0.72 * z * np.cos(angle)])
        sides = shades if plain or k % 2 else [*prints, *shades[:2]]
        world.box(middle - size / 2, middle + size / 2, sides, 260.0, rng.uniform(-0.5, 0.5))
    return world


def make_corner(seed: int, half: float = 8.0, bare: bool = False) -> World:
    """Two streets of some half width that cross: facades whose windows repeat, cars, posts; bare ones have no cars."""
    rng = np.random.default_rng(seed)
    world = World(rng)
    road = world.paint(world.smooth(105, 7.0, 4) + world.smooth(0, 4.0, 32))
    facades = []
    for _ in range(4):
        image = world.smooth(rng.uniform(120, 180), 5.0, 4)
        step = 128
        for v in range(0, TEXELS, step):
            for u in range(0, TEXELS, step):
                image[v + 30 : v + 100, u + 34 : u + 94] = rng.uniform(50, 60)
                image[v + 24 : v + 30, u + 28 : u + 100] += 40
                image[v + 60 : v + 64, u + 34 : u + 94] = 150
        facades.append(world.paint(cv2.GaussianBlur(image, (0, 0), 0.8)))
    paints = [world.paint(world.printed(level, 12, 35)) for level in (50, 90, 200)]
    marks = world.paint(np.full((TEXELS, TEXELS), 225.0))
    world.add([-80, 1.65, -40], [200, 0, 0], [0, 0, 200], road, 40.0)
    storey = TEXELS / 13.0
    # The first street goes along z, the second along x, crossing at z = 40.
    for sign in (-1.0, 1.0):
        for low, high in ((-40.0, 40.0 - half), (40.0 + half, 120.0)):
            at = low
            while at < high - 1.0:
                length = min(rng.uniform(9, 18), high - at)
                tall = rng.uniform(8, 13)
                back = sign * (half + rng.uniform(0, 0.6))
                number = facades[int(rng.integers(4))]
                world.add([back, 1.65 - tall, at], [0, 0, length], [0, tall, 0], number, storey)
                # The same along the second street.
                away = at - 40.0
                if away + length < -half + 1e-6 or away > half - 1e-6:
                    world.add([away, 1.65 - tall, 40 + back], [length, 0, 0], [0, tall, 0], number, storey)
                at += length
    for street in (0, 1):
        for k in range(-6, 14):
            along = 7.0 * k + rng.uniform(-1, 1)
            if abs(along - (40.0 if street == 0 else 0.0)) < half + 4.0:
                continue
            for sign in (-1.0, 1.0):
                if rng.random() < (0.85 if bare else 0.35):
                    continue
                across = sign * (half - 2.2)
                low = (
                    np.array([across - 0.9, 0.25, along - 2.1])
                    if street == 0
                    else np.array([along - 2.1, 0.25, 40 + across - 0.9])
                )
                size = np.array([1.8, 1.4, 4.2]) if street == 0 else np.array([4.2, 1.4, 1.8])
                world.box(low, low + size, paints, 120.0, rng.uniform(-0.05, 0.05))
            post = (
                np.array([half - 0.6, -4.0, along + 3.0])
                if street == 0
                else np.array([along + 3.0, -4.0, 40 + half - 0.6])
            )
            world.box(post, post + np.array([0.14, 5.6, 0.14]), paints, 120.0)
            stripe = [-0.08, 1.64, along] if street == 0 else [along, 1.64, 39.92]
            world.add(
                stripe,
                [0.16, 0, 0] if street == 0 else [3.0, 0, 0],
                [0, 0, 3.0] if street == 0 else [0, 0, 0.16],
                marks,
                10.0,
            )
    return world
