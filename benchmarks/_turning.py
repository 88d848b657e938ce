# SPDX-License-Identifier: BSD-3-Clause
"""Rendered sequences of a camera that turns fast: rooms with a depth camera, a street corner with a stereo pair.

A world is a list of rectangles with a pattern each. Several rays per pixel, each at another moment of the exposure,
give motion blur and soft edges at once. Poses and depths are exact until noise is added.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np

from groma._numba import loop
from groma.geometry import quaternion, se3, so3
from groma.io.sequences import Frame, SequenceCamera

#: Side of a pattern, texels; patterns repeat.
TEXELS = 512
#: Moments of the exposure, each with a ray through another part of the pixel.
MOMENTS = np.array([[0.125, 0.625], [0.375, 0.125], [0.625, 0.875], [0.875, 0.375]]) - 0.5
SKY = 205.0
RATE = 30.0


# ------------------------------------------------------------------------------------------------------------- worlds
@dataclass
class World:
    """Rectangles: corner and two perpendicular sides (3, 3), number of the pattern, and its texels per metre."""

    rng: np.random.Generator
    rectangles: list[np.ndarray] = field(default_factory=list)
    pattern: list[int] = field(default_factory=list)
    scale: list[float] = field(default_factory=list)
    patterns: list[np.ndarray] = field(default_factory=list)

    def paint(self, image: np.ndarray) -> int:
        """Add a pattern; return its number."""
        self.patterns.append(np.clip(image, 4, 250).astype(np.float32))
        return len(self.patterns) - 1

    def add(self, corner, first, second, pattern: int, scale: float) -> None:
        """Add a rectangle."""
        self.rectangles.append(np.array([corner, first, second], float))
        self.pattern.append(pattern)
        self.scale.append(scale)

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


def make_room(seed: int, plain: bool = False) -> World:
    """A room of 6 x 5 metres: plain or printed walls, pictures, boards and boxes."""
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
    x, y, z = 3.0, 1.3, 2.5
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


def make_corner(seed: int) -> World:
    """Two streets that cross: facades whose windows repeat, cars, posts."""
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
    half, storey = 8.0, TEXELS / 13.0
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
                if rng.random() < 0.35:
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


# ---------------------------------------------------------------------------------------------------------- rendering
@loop
def _cast(rectangles, boxes, fx, fy, cx, cy, jx, jy, nearest, which):
    """Nearest rectangle along each ray and its inverse depth; rectangles (n, 3, 3) are in the camera."""
    for k in range(rectangles.shape[0]):
        c, a, b = rectangles[k, 0], rectangles[k, 1], rectangles[k, 2]
        nx, ny, nz = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
        offset = nx * c[0] + ny * c[1] + nz * c[2]
        if abs(offset) < 1e-12:
            continue
        aa, bb = a[0] * a[0] + a[1] * a[1] + a[2] * a[2], b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
        ca, cb = c[0] * a[0] + c[1] * a[1] + c[2] * a[2], c[0] * b[0] + c[1] * b[1] + c[2] * b[2]
        for i in range(boxes[k, 1], boxes[k, 3]):
            y = (i + 0.5 + jy - cy) / fy
            for j in range(boxes[k, 0], boxes[k, 2]):
                x = (j + 0.5 + jx - cx) / fx
                inverse = (nx * x + ny * y + nz) / offset
                if inverse <= nearest[i, j]:
                    continue
                s, t = x * a[0] + y * a[1] + a[2] - inverse * ca, x * b[0] + y * b[1] + b[2] - inverse * cb
                if s >= 0.0 and t >= 0.0 and s <= aa * inverse and t <= bb * inverse:
                    nearest[i, j], which[i, j] = inverse, k


@loop
def _shade(rectangles, pattern, scale, patterns, fx, fy, cx, cy, jx, jy, nearest, which, sky, out):
    """Add the grey levels of one picture to ``out``."""
    n = patterns.shape[1]
    for i in range(out.shape[0]):
        y = (i + 0.5 + jy - cy) / fy
        for j in range(out.shape[1]):
            k = which[i, j]
            if k < 0:
                out[i, j] += sky
                continue
            x = (j + 0.5 + jx - cx) / fx
            z = 1.0 / nearest[i, j]
            c, a, b = rectangles[k, 0], rectangles[k, 1], rectangles[k, 2]
            px, py, pz = x * z - c[0], y * z - c[1], z - c[2]
            u = (px * a[0] + py * a[1] + pz * a[2]) / np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2]) * scale[k]
            v = (px * b[0] + py * b[1] + pz * b[2]) / np.sqrt(b[0] * b[0] + b[1] * b[1] + b[2] * b[2]) * scale[k]
            u0, v0 = int(np.floor(u)), int(np.floor(v))
            fu, fv = u - u0, v - v0
            u0, v0 = u0 % n, v0 % n
            u1, v1 = (u0 + 1) % n, (v0 + 1) % n
            image = patterns[pattern[k]]
            top = image[v0, u0] * (1.0 - fu) + image[v0, u1] * fu
            low = image[v1, u0] * (1.0 - fu) + image[v1, u1] * fu
            out[i, j] += top * (1.0 - fv) + low * fv


@dataclass(frozen=True, eq=False)
class Renderer:
    """A world and a camera."""

    world: World
    camera: SequenceCamera

    def picture(self, before: np.ndarray, after: np.ndarray, exposure: float) -> tuple[np.ndarray, np.ndarray]:
        """Grey levels and exact depth (H, W), 0 for the sky; the camera moves from one pose to the other.

        Parameters
        ----------
        before, after : (7,)
            cam_from_world half a frame before and after.
        exposure : float
            Share of the time between frames during which light falls in.
        """
        total = np.zeros((self.camera.height, self.camera.width))
        motion = se3.log(se3.compose(after[None], se3.inverse(before[None])))[0]
        for k, jitter in enumerate(MOMENTS):
            share = 0.5 + exposure * ((k + 0.5) / len(MOMENTS) - 0.5)
            pose = se3.compose(se3.exp(share * motion[None]), before[None])[0]
            self._cast(pose, jitter, total)
        middle = se3.compose(se3.exp(0.5 * motion[None]), before[None])[0]
        inverse = self._cast(middle, np.zeros(2), None)
        with np.errstate(divide="ignore"):
            depth = np.where(inverse > 0, 1.0 / inverse, 0.0)
        return total / len(MOMENTS), depth

    def _cast(self, pose: np.ndarray, jitter: np.ndarray, out: np.ndarray | None) -> np.ndarray:
        fx, fy, cx, cy = self.camera.params
        height, width = self.camera.height, self.camera.width
        R = quaternion.to_matrix(pose[:4])
        local = np.array(self.world.rectangles) @ R.T
        local[:, 0] += pose[4:]
        corner, one, two = local[:, 0], local[:, 1], local[:, 2]
        corners = np.stack([corner, corner + one, corner + two, corner + one + two], axis=1)
        boxes = np.tile([0, 0, width, height], (len(local), 1))
        z = corners[..., 2]
        boxes[(z <= 0.01).all(axis=1)] = 0
        ahead = np.flatnonzero((z > 0.01).all(axis=1))
        pixel = corners[ahead, :, :2] / z[ahead, :, None] * (fx, fy) + (cx, cy)
        low, high = np.floor(pixel.min(axis=1)) - 1, np.ceil(pixel.max(axis=1)) + 1
        boxes[ahead] = np.clip(np.hstack([low, high]), 0, [width, height, width, height]).astype(int)
        nearest, which = np.full((height, width), 1e-9), np.full((height, width), -1)
        _cast(local, boxes, fx, fy, cx, cy, *jitter, nearest, which)
        if out is not None:
            numbers, scale = np.array(self.world.pattern), np.array(self.world.scale)
            _shade(
                local, numbers, scale, np.array(self.world.patterns), fx, fy, cx, cy, *jitter, nearest, which, SKY, out
            )
        return np.where(which >= 0, nearest, 0.0)


def noisy_depth(depth: np.ndarray, rng: np.random.Generator, holes: float = 0.08) -> np.ndarray:
    """Depth as a structured-light camera gives it: noise and steps of disparity, holes at jumps and in patches."""
    height, width = depth.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        # 580 pixels times 7.5 cm; neighbouring pixels err alike.
        disparity = 43.5 / depth
        coarse = cv2.resize(rng.normal(size=(height // 4, width // 4)), (width, height), interpolation=cv2.INTER_LINEAR)
        disparity = np.round(8.0 * (disparity + 0.12 * coarse)) / 8.0
        out = np.where(depth > 0, 43.5 / disparity, 0.0)
        near = cv2.erode(np.where(depth > 0, depth, 0.0), np.ones((5, 5)))
        far = cv2.dilate(depth, np.ones((5, 5)))
        jump = far - near > 0.05 * depth
    patches = cv2.resize(rng.random((height // 24, width // 24)), (width, height), interpolation=cv2.INTER_LINEAR)
    bad = jump | (patches > np.quantile(patches, 1.0 - holes)) | (depth > 5.0) | (depth < 0.4)
    return np.where(bad, 0.0, out).astype(np.float32)


# -------------------------------------------------------------------------------------------------------------- paths
def swinging(count: int, degrees: float, seed: int) -> np.ndarray:
    """cam_from_world (count, 7): a camera in the hand looks around a room, some degrees from frame to frame at most.

    It starts at rest, is at full speed three frames later, changes speed, and turns back at once now and then.
    """
    rng = np.random.default_rng(1000 + seed)
    path = np.linspace(0.0, 40.0, 4000)
    phase = rng.uniform(0, 2 * np.pi, 6)
    yaw = 1.7 * np.sin(0.5 * path + 0.3 * np.sin(path + phase[0])) + 0.4 * path / 6.0
    pitch = 0.25 * np.sin(1.3 * path + phase[1]) + 0.1 * np.sin(3.1 * path + phase[2])
    roll = 0.3 * np.sin(1.7 * path + phase[3])
    start = np.argmin(np.abs(path - rng.uniform(0.0, 2.0)))
    turn = (
        so3.exp(np.outer(yaw, [0, 1.0, 0]))
        @ so3.exp(np.outer(pitch, [1.0, 0, 0]))
        @ so3.exp(np.outer(roll, [0, 0, 1.0]))
    )
    step = np.linalg.norm(so3.log(turn[:-1].transpose(0, 2, 1) @ turn[1:]), axis=1)
    length = np.concatenate([[0.0], np.cumsum(step)])
    speed = np.radians(degrees) * (0.75 + 0.25 * np.cos(np.arange(count) * 0.7 + phase[4]))
    speed *= np.clip((np.arange(count) - 2) / 3.0, 0, 1)
    way = np.where(np.arange(count) % 17 < 12, 1.0, -1.0)
    at = np.abs(length[start] + np.cumsum(speed * way))
    # Twice as many poses as frames: the exposure is in the middle of two.
    fine = np.interp(np.arange(2 * count + 1) / 2.0, np.arange(count) + 0.5, at)
    rows = np.searchsorted(length, fine).clip(0, len(path) - 1)
    R = turn[rows]
    t = np.arange(2 * count + 1) / 2.0
    center = np.stack([0.25 * np.sin(0.05 * t + phase[5]), 0.05 * np.sin(0.11 * t), 0.2 * np.sin(0.07 * t)], axis=1)
    # The camera is held 15 cm before the axis it turns about.
    center += R @ [0.0, 0.0, 0.15]
    return _poses(R, center)


def cornering(degrees: float, seed: int, right: bool = True) -> np.ndarray:
    """cam_from_world (2 count + 1, 7): along the first street, around the corner, along the second."""
    rng = np.random.default_rng(2000 + seed)
    count = round(90.0 / degrees)
    speed = np.concatenate([np.zeros(14), _eased(count) * np.radians(90.0), np.zeros(10)])
    fine = np.repeat(speed, 2) / 2.0
    angle = np.concatenate([[0.0], np.cumsum(fine)])
    step = np.where(np.repeat(speed, 2) > 0, 0.7, 1.1) / 2.0
    heading = np.stack([np.sin(angle), np.zeros(len(angle)), np.cos(angle)], axis=1)
    center = np.concatenate([np.zeros((1, 3)), np.cumsum(step[:, None] * 0.5 * (heading[1:] + heading[:-1]), axis=0)])
    # The turn ends in the middle of the second street.
    end = 28 + 2 * count
    center[:, 2] += 40.0 - center[end, 2]
    center[:, 0] += -1.5
    t = np.arange(len(angle)) / 2.0
    sway = np.stack([0.004 * np.sin(0.9 * t), np.zeros(len(t)), 0.006 * np.sin(0.6 * t + rng.uniform(0, 6))], axis=1)
    center[:, 1] += 0.02 * np.sin(1.1 * t)
    mirror = 1.0 if right else -1.0
    center[:, 0] *= mirror
    return _poses(so3.exp(np.outer(mirror * angle, [0, 1.0, 0])) @ so3.exp(sway), center)


def _eased(count: int) -> np.ndarray:
    """Shares of a turn in each frame: rising over two frames, even, falling."""
    share = np.ones(count)
    share[[0, -1]] = 0.4
    if count > 4:
        share[[1, -2]] = 0.8
    return share / share.sum()


def _poses(R: np.ndarray, center: np.ndarray) -> np.ndarray:
    return se3.inverse(np.hstack([quaternion.from_matrix(R), center]))


# ---------------------------------------------------------------------------------------------------------- sequences
@dataclass(frozen=True, eq=False)
class Turning:
    """A rendered sequence: frames one by one, and their true poses."""

    name: str
    renderer: Renderer
    #: (2 N + 1, 7) cam_from_world, half a frame apart.
    half_poses: np.ndarray
    exposure: float
    seed: int
    #: Whether the brightness changes.
    flicker: bool = False

    @property
    def poses(self) -> np.ndarray:
        """(N, 7) true cam_from_world, in the middle of the exposures."""
        before, after = self.half_poses[:-2:2], self.half_poses[2::2]
        half = 0.5 * se3.log(se3.compose(after, se3.inverse(before)))
        return se3.compose(se3.exp(half), before)

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[Frame]:
        rng = np.random.default_rng(self.seed)
        baseline = self.renderer.camera.baseline
        shift = np.array([0, 0, 0, 1, -(baseline or 0.0), 0, 0])
        for k in range(len(self)):
            ends = self.half_poses[2 * k], self.half_poses[2 * k + 2]
            gain = 1.0 + 0.25 * np.sin(0.8 * k) if self.flicker else 1.0
            gray, depth = self.renderer.picture(*ends, self.exposure)
            left, right = _film(gray, gain, rng), None
            if baseline:
                ends = [se3.compose(shift[None], pose[None])[0] for pose in ends]
                right = _film(self.renderer.picture(*ends, self.exposure)[0], 0.96 * gain, rng)
            known = None if baseline else noisy_depth(depth, rng)
            yield Frame(k / RATE if not baseline else k / 10.0, left, known, right, f"{k:04d}.png")


def _film(gray: np.ndarray, gain: float, rng: np.random.Generator) -> np.ndarray:
    return np.clip(gain * gray + rng.normal(0, 2.0, gray.shape), 0, 255).astype(np.uint8)


def room_sequence(
    degrees: float, seed: int, plain: bool = False, count: int = 60, exposure: float | None = None
) -> Turning:
    """A depth camera that swings by up to some degrees from frame to frame."""
    camera = SequenceCamera("PINHOLE", np.array([525.0, 525.0, 320.0, 240.0]), 640, 480)
    # An exposure of a tenth of the time between frames, and blur of at most 0.8 degrees (7 pixels).
    exposure = min(0.3, 0.8 / degrees) if exposure is None else exposure
    name = f"{'plain ' if plain else ''}room, {degrees:g} degrees, seed {seed}"
    return Turning(name, Renderer(make_room(seed, plain), camera), swinging(count, degrees, seed), exposure, seed)


def corner_sequence(degrees: float, seed: int, right: bool = True, flicker: bool = True) -> Turning:
    """A stereo pair on a car around a corner."""
    camera = SequenceCamera("PINHOLE", np.array([707.0912, 707.0912, 602.3873, 183.6104]), 1226, 370, 0.53715)
    name = f"corner, {degrees:g} degrees, seed {seed}{'' if right else ', left'}"
    world = make_corner(seed)
    return Turning(name, Renderer(world, camera), cornering(degrees, seed, right), 0.04, seed, flicker)
