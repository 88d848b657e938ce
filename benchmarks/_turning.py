# SPDX-License-Identifier: BSD-3-Clause
"""Rendered sequences of a camera that turns fast: rooms with a depth camera, a street corner with a stereo pair.

A world is a list of rectangles with a pattern each. Several rays per pixel, each at another moment of the exposure,
give motion blur and soft edges at once. Poses and depths are exact until noise is added. :class:`Film` says what the
camera does to the picture: long exposures, rows read one after the other, exposure that follows the brightness, noise.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from _turning_worlds import World, make_corner, make_room

from groma._numba import loop
from groma.geometry import quaternion, se3, so3
from groma.io.sequences import Frame, SequenceCamera

#: Rays of a pixel, each at another moment of the exposure.
RAYS = np.array([[0.125, 0.625], [0.375, 0.125], [0.625, 0.875], [0.875, 0.375]]) - 0.5
SKY = 205.0
RATE = 30.0


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


@dataclass(frozen=True)
class Film:
    """What a camera makes of the light; times are shares of the time between frames."""

    #: How long light falls in, and from how many moments of it a pixel is made.
    exposure: float
    moments: int = 4
    #: From the first row to the last.
    rolling: float = 0.0
    #: How much later depth is measured than grey levels.
    depth_lag: float = 0.0
    #: Standard deviation of the noise, grey levels.
    noise: float = 2.0
    #: The brightness goes up and down.
    flicker: bool = False
    #: The exposure follows the mean brightness some frames later.
    follows: bool = False
    #: Gain and offset of the right image.
    right: tuple[float, float] = (0.96, 0.0)
    #: Depth beyond this is unknown, metres.
    max_depth: float = 5.0


@dataclass(frozen=True, eq=False)
class Renderer:
    """A world and a camera."""

    world: World
    camera: SequenceCamera

    def picture(
        self, before: np.ndarray, after: np.ndarray, film: Film, time: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Grey levels and exact depth (H, W), 0 for the sky; the camera moves from one pose to the other.

        Parameters
        ----------
        before, after : (7,)
            cam_from_world half a frame before and after.
        film
            How long light falls in, and when.
        time : float
            Frames since the start, for what moves in the world.
        """
        height, width = self.camera.height, self.camera.width
        total, moment = np.zeros((height, width)), np.zeros((height, width))
        motion = se3.log(se3.compose(after[None], se3.inverse(before[None])))[0]

        def pose_at(share: float) -> np.ndarray:
            return se3.compose(se3.exp(share * motion[None]), before[None])[0]

        # Each row is exposed during its own part of the time.
        whole = film.exposure + film.rolling
        count = int(np.ceil(film.moments * whole / film.exposure))
        middle = 0.5 + film.rolling * ((np.arange(height) + 0.5) / height - 0.5)
        weights = np.zeros(height)
        for k in range(count):
            share = 0.5 + whole * ((k + 0.5) / count - 0.5)
            weight = (np.abs(share - middle) <= 0.5 * film.exposure + 0.5 * whole / count).astype(float)
            moment[:] = 0.0
            self._cast(pose_at(share), RAYS[k % len(RAYS)], moment, time)
            total += weight[:, None] * moment
            weights += weight
        inverse = self._cast(pose_at(0.5 + film.depth_lag), np.zeros(2), None, time)
        with np.errstate(divide="ignore"):
            depth = np.where(inverse > 0, 1.0 / inverse, 0.0)
        return total / weights[:, None], depth

    def _cast(self, pose: np.ndarray, jitter: np.ndarray, out: np.ndarray | None, time: float) -> np.ndarray:
        fx, fy, cx, cy = self.camera.params
        height, width = self.camera.height, self.camera.width
        R = quaternion.to_matrix(pose[:4])
        world = np.array(self.world.rectangles)
        world[:, 0] += time * np.array(self.world.speed)
        local = world @ R.T
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


def noisy_depth(depth: np.ndarray, rng: np.random.Generator, max_depth: float, holes: float = 0.08) -> np.ndarray:
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
    bad = jump | (patches > np.quantile(patches, 1.0 - holes)) | (depth > max_depth) | (depth < 0.4)
    return np.where(bad, 0.0, out).astype(np.float32)


# -------------------------------------------------------------------------------------------------------------- paths
def swinging(count: int, degrees: float, seed: int, pure: bool = False) -> np.ndarray:
    """cam_from_world (count, 7): a camera in the hand looks around a room, some degrees from frame to frame at most.

    It starts at rest, is at full speed three frames later, changes speed, and turns back at once now and then. ``pure``
    turns stay in one place.
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
    R = turn[np.searchsorted(length, fine).clip(0, len(path) - 1)]
    t = np.arange(2 * count + 1) / 2.0
    center = np.stack([0.25 * np.sin(0.05 * t + phase[5]), 0.05 * np.sin(0.11 * t), 0.2 * np.sin(0.07 * t)], axis=1)
    # The camera is held 15 cm before the axis it turns about.
    center += R @ [0.0, 0.0, 0.15]
    if pure:
        center = R @ [0.0, 0.0, 0.02]
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
    film: Film
    seed: int

    @property
    def poses(self) -> np.ndarray:
        """(N, 7) true cam_from_world, in the middle of the exposures."""
        before, after = self.half_poses[:-2:2], self.half_poses[2::2]
        return se3.compose(se3.exp(0.5 * se3.log(se3.compose(after, se3.inverse(before)))), before)

    def __len__(self) -> int:
        return len(self.poses)

    def __iter__(self) -> Iterator[Frame]:
        rng = np.random.default_rng(self.seed)
        baseline = self.renderer.camera.baseline
        shift = np.array([0, 0, 0, 1, -(baseline or 0.0), 0, 0])
        film, follow = self.film, 1.0
        for k in range(len(self)):
            ends = self.half_poses[2 * k], self.half_poses[2 * k + 2]
            gray, depth = self.renderer.picture(*ends, film, k)
            gain = 1.0 + 0.25 * np.sin(0.8 * k) if film.flicker else 1.0
            if film.follows:
                gain *= follow
                follow += 0.35 * (110.0 / max(float(gray.mean()), 20.0) - follow)
            left, right = _exposed(gain * gray, film.noise, rng), None
            if baseline:
                ends = [se3.compose(shift[None], pose[None])[0] for pose in ends]
                light = gain * self.renderer.picture(*ends, film, k)[0]
                right = _exposed(film.right[0] * light + film.right[1], film.noise, rng)
            known = None if baseline else noisy_depth(depth, rng, film.max_depth)
            yield Frame(k / RATE if not baseline else k / 10.0, left, known, right, f"{k:04d}.png")


def _exposed(light: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    return np.clip(light + rng.normal(0, noise, light.shape), 0, 255).astype(np.uint8)


#: Depth cameras in the hand: a short exposure; the blur and the noise of a dim room; and all at once.
FILMS = {
    "": None,
    "blurred": Film(0.4, 8),
    "dim": Film(0.7, 10, noise=7.0, follows=True),
    "real": Film(0.4, 6, rolling=0.5, depth_lag=0.2, noise=4.0, follows=True, max_depth=4.0),
}


def room_sequence(
    degrees: float, seed: int, plain: bool = False, count: int = 60, film: str = "", size: float = 1.0,
    pure: bool = False,
) -> Turning:  # fmt: skip
    """A depth camera that swings by up to some degrees from frame to frame."""
    camera = SequenceCamera("PINHOLE", np.array([525.0, 525.0, 320.0, 240.0]), 640, 480)
    # An exposure of a tenth of the time between frames, and blur of at most 0.8 degrees (7 pixels).
    exposed = FILMS[film] or Film(min(0.3, 0.8 / degrees))
    words = [film, "plain" if plain else "", "large" if size > 1 else "", "room"]
    place = ", one place" if pure else ""
    name = f"{' '.join(word for word in words if word)}, {degrees:g} degrees{place}, seed {seed}"
    path = swinging(count, degrees, seed, pure)
    return Turning(name, Renderer(make_room(seed, plain, size), camera), path, exposed, seed)


def corner_sequence(
    degrees: float, seed: int, right: bool = True, traffic: bool = False, wide: bool = False, uneven: bool = False
) -> Turning:
    """A stereo pair on a car around a corner: with a car that crosses, in wide empty streets, with uneven cameras."""
    camera = SequenceCamera("PINHOLE", np.array([707.0912, 707.0912, 602.3873, 183.6104]), 1226, 370, 0.53715)
    words = ["wide" if wide else "", "uneven" if uneven else "", "corner", "with traffic" if traffic else ""]
    name = f"{' '.join(word for word in words if word)}, {degrees:g} degrees, seed {seed}{'' if right else ', left'}"
    path = cornering(degrees, seed, right)
    world = make_corner(seed, half=22.0 if wide else 8.0, bare=wide)
    if traffic:
        # It crosses before the camera where that turns.
        world.drive([-12.0 if right else 12.0, 34.0], [0.9 if right else -0.9, 0.0])
    film = Film(0.04, flicker=True, right=(0.7, 25.0) if uneven else (0.96, 0.0))
    return Turning(name, Renderer(world, camera), path, film, seed)
