# SPDX-License-Identifier: BSD-3-Clause
"""Buildings whose faces are known exactly: a furnished room, oblique wings, a gabled house, stairs, towers."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from _rendered_boxes import BOX_SIDES, BoxSettings, RenderedScene, World, render

from groma.geometry import se3
from groma.geometry.algebra import unit

X, Y, Z = np.eye(3)
#: Lengths and sines that are none.
NOTHING = 1e-6
SHADES = [50.0, 80.0, 150.0, 180.0, 210.0, 240.0]


@dataclass(frozen=True)
class BuildingSettings:
    """What is built, and its seed."""

    kind: str
    seed: int
    #: As of boxes.
    texture: float = 10.0
    noise: float = 2.0
    blur: float = 0.6


@dataclass
class _Site:
    """Where faces are put up."""

    rng: np.random.Generator
    world: World

    def face(self, corners: list, shade: float, plane: int | None = None) -> int:
        """A quadrilateral, in its own plane or that of another; return the number of the plane."""
        world = self.world
        world.polygons.append(np.array(corners, float))
        world.shades.append(float(shade))
        world.planes.append(len(world.polygons) - 1 if plane is None else plane)
        return world.planes[-1]

    def box(self, center: list, half: list, turn: float = 0.0, floor: int | None = None) -> None:
        """A box; its bottom may be in the plane of the floor."""
        c, s = np.cos(turn), np.sin(turn)
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        corners = np.array(center) + corners @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T
        for side, shade in zip(BOX_SIDES, self.rng.permutation(SHADES), strict=True):
            self.face(corners[list(side)].tolist(), shade, floor if (corners[list(side), 2] == 0.0).all() else None)

    def wall(self, start: np.ndarray, along: np.ndarray, up: np.ndarray, normal: np.ndarray, rough: float = 0.0) -> int:
        """A wall with windows, columns of rectangles that lie off it by little."""
        rng, length, height = self.rng, float(np.linalg.norm(along)), float(np.linalg.norm(up))
        plane = self.face([start, start + along, start + along + up, start + up], rng.choice(SHADES[2:]))
        along, up, left = along / length, up / height, rng.uniform(0.2, 0.5)
        while left + (width := rng.uniform(0.35, 0.9)) < length - 0.15:
            low = rng.uniform(0.15, 0.4)
            while low + (tall := rng.uniform(0.35, 0.9)) < height - 0.1:
                for inner in (0.0, 0.06)[: rng.choice([1, 2], p=[0.6, 0.4])]:
                    off = start + (2e-4 + inner / 300 + abs(rng.normal(0.0, rough))) * normal
                    corners = [(left + inner, low + inner), (left + width - inner, low + inner)]
                    corners += [(left + width - inner, low + tall - inner), (left + inner, low + tall - inner)]
                    self.face([off + a * along + b * up for a, b in corners], rng.choice([30, 70, 100, 200]), plane)
                low += tall + rng.uniform(0.15, 0.4)
            left += width + rng.uniform(0.15, 0.5)
        return plane

    def walls(self, a: float, b: float, height: float, inside: bool) -> list[int]:
        """Four walls around the origin: back, front, right, left."""
        turn = -1.0 if inside else 1.0
        sides = ((b * Y, a * X, Y), (-b * Y, a * X, -Y), (a * X, b * Y, X), (-a * X, b * Y, -X))
        return [self.wall(at - way, 2 * way, height * Z, turn * normal) for at, way, normal in sides]

    def floor(self, a: float, b: float) -> int:
        return self.face([[-a, -b, 0], [a, -b, 0], [a, b, 0], [-a, b, 0]], 115)

    def boxes(self, number: int, free: tuple[float, float], extent: tuple[float, float], floor: int) -> None:
        """Boxes on the floor, in a rectangle with a free one in its middle, away from each other."""
        placed: list[np.ndarray] = []
        while len(placed) < number:
            at = self.rng.uniform(-1, 1, 2) * extent
            if (np.abs(at) < free).all() or any(np.linalg.norm(at - other) < 0.8 for other in placed):
                continue
            placed.append(at)
            half = self.rng.uniform(0.12, 0.3, 3)
            self.box([*at, half[2]], half.tolist(), self.rng.uniform(0, np.pi), floor)


def render_building(settings: BuildingSettings) -> RenderedScene:
    """Make the building of a seed and its images."""
    rng = np.random.default_rng([settings.seed, len(settings.kind)])
    site = _Site(rng, World([], [], np.zeros((0, 2, 3)), [], []))
    poses, focal = KINDS[settings.kind](site)
    faces = site.world.polygons
    edges = [np.stack([face, np.roll(face, -1, axis=0)], axis=1) for face in faces]
    world = replace(site.world, edges=np.concatenate([*edges, _crossings(faces)]))
    images = BoxSettings(width=640, height=480, focal=focal, num_images=len(poses), texture=settings.texture)
    return render(world, np.array(poses), replace(images, noise=settings.noise, blur=settings.blur), rng)


def _crossings(faces: list[np.ndarray]) -> np.ndarray:
    """(K, 2, 3) where faces pass through each other, as steps through windows: edges that are no side of a face."""
    corner = np.array([face[:3] for face in faces])
    normals = unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    found = []
    for i, j in combinations(range(len(faces)), 2):
        along = np.cross(normals[i], normals[j])
        if np.linalg.norm(along) < NOTHING:
            continue
        planes = np.array([normals[i], normals[j], along])
        start = np.linalg.solve(planes, [normals[i] @ faces[i][0], normals[j] @ faces[j][0], along @ faces[i][0]])
        inward = np.concatenate([unit(np.cross(normals[k], np.roll(faces[k], -1, axis=0) - faces[k])) for k in (i, j)])
        # Inside is where room + t slope is positive for all sides of both.
        room, slope = ((start - np.concatenate([faces[i], faces[j]])) * inward).sum(1) - NOTHING, inward @ along
        even = np.abs(slope) < NOTHING
        at = -room / np.where(even, 1.0, slope)
        low, high = at[~even & (slope > 0.0)].max(), at[~even & (slope < 0.0)].min()
        if low < high and (room[even] > 0.0).all():
            found.append([start + low * along, start + high * along])
    return np.array(found).reshape(-1, 2, 3)


def _room(site: _Site) -> tuple[list, float]:
    """A table, a cupboard, a bed, shelves and stools, seen from inside."""
    rng, (a, b) = site.rng, site.rng.uniform([2.2, 1.8], [3.0, 2.4])
    floor = site.floor(a, b)
    site.face([[-a, -b, 2.6], [a, -b, 2.6], [a, b, 2.6], [-a, b, 2.6]], 225)
    site.walls(a, b, 2.6, inside=True)
    turn, at = rng.uniform(0, 0.6), rng.uniform(-0.4, 0.4, 2)
    site.box([*at, 0.74], [0.7, 0.4, 0.02], turn)
    c, s = np.cos(turn), np.sin(turn)
    for x, y in ((-0.64, -0.34), (-0.64, 0.34), (0.64, -0.34), (0.64, 0.34)):
        site.box([at[0] + c * x - s * y, at[1] + s * x + c * y, 0.36], [0.03, 0.03, 0.36], turn, floor)
    site.box([-a + 0.21, rng.uniform(-0.8, 0.8), 0.95], [0.2, 0.6, 0.95], 0.0, floor)
    site.box([rng.uniform(-0.8, 0.8), b - 0.46, 0.22], [0.8, 0.4, 0.2], rng.normal(0, 0.02))
    for k in range(3):
        site.box([a - 0.16, 0.0, 0.6 + 0.45 * k], [0.15, 0.7, 0.015])
    site.boxes(3, (1.1, 0.9), (a - 0.5, b - 0.9), floor)
    poses = []
    for way in 2 * np.pi * np.arange(22) / 22:
        center = np.array([0.75 * a * np.cos(way), 0.7 * b * np.sin(way), 1.5]) + rng.normal(0, 0.1, 3)
        target = np.array([-0.5 * a * np.cos(way), -0.5 * b * np.sin(way), 1.0]) + rng.normal(0, 0.25, 3)
        poses.append(se3.looking_at(center, target))
    return poses, 420.0


def _wings(site: _Site) -> tuple[list, float]:
    """Two wings at an oblique angle with flat roofs, boxes before them."""
    rng, angle = site.rng, np.deg2rad(site.rng.choice([20, 35, 50, 65, 115]))
    floor = site.floor(6.0, 6.0)
    for start, along in ((Y - 3.2 * X, 3.2 * X), (Y, 2.8 * (np.cos(angle) * X - np.sin(angle) * Y))):
        normal = np.cross(along, Z) / np.linalg.norm(along)
        site.wall(start, along, 2.4 * Z, normal, rng.choice([0.0, 0.004]))
        start = start + 2.4 * Z
        site.face([start, start + along, start + along - 1.5 * normal, start - 1.5 * normal], 220)
    site.boxes(5, (0.0, 0.0), (2.2, 1.6), floor)
    return _arc(rng, [4.6, 5.2], [-0.2, 0.8, 1.1], 18), 480.0


def _gable(site: _Site) -> tuple[list, float]:
    """A house with a pitched roof, a chimney, and boxes around it."""
    rng, (a, b, height) = site.rng, site.rng.uniform([1.2, 0.8, 1.1], [1.7, 1.1, 1.5])
    floor, rise = site.floor(4.0, 4.0), b * np.tan(np.deg2rad(site.rng.uniform(25, 48)))
    ends, ridge = site.walls(a, b, height, inside=False)[2:], 0.02 * rise / b
    for x, plane in zip((a, -a), ends, strict=True):
        upper = [[x, y, height + rise - ridge] for y in (0.02, -0.02)]
        site.face([[x, -b, height], [x, b, height], *upper], 190, plane)
    for side in (-1, 1):
        slope = np.array([0.0, -side * b, rise])
        eaves = np.array([-a - 0.12, side * b, height]) - 0.15 * slope / np.linalg.norm(slope)
        normal = np.array([0.0, side * rise, b]) / np.hypot(rise, b)
        site.wall(eaves, (2 * a + 0.24) * X, np.array([-a - 0.12, 0.0, height + rise]) - eaves, normal)
    site.box([rng.uniform(-0.6, 0.6) * a, 0.3 * b, height + rise - 0.05], [0.12, 0.12, 0.35])
    site.boxes(5, (a + 0.5, b + 0.5), (2.4, 2.4), floor)
    poses = []
    for way in 2 * np.pi * np.arange(20) / 20:
        center = np.array([4.2 * np.cos(way), 4.2 * np.sin(way), 2.3 + 0.7 * np.sin(3 * way)])
        poses.append(se3.looking_at(center + rng.normal(0, 0.08, 3), np.array([0, 0, 0.9]) + rng.normal(0, 0.08, 3)))
    return poses, 560.0


def _stairs(site: _Site) -> tuple[list, float]:
    """Stairs between two walls, to a third."""
    rng = site.rng
    half, deep, high, number = rng.uniform([1.2, 0.25, 0.14, 7], [1.7, 0.32, 0.2, 11])
    back = int(number) * np.array([0.0, deep, high])
    floor = site.face([[-3, -2.5, 0], [3, -2.5, 0], [3, 0, 0], [-3, 0, 0]], 115)
    for k in range(int(number)):
        at, across = k * np.array([0.0, deep, high]) - half * X, 2 * half * X
        site.face([at, at + across, at + across + high * Z, at + high * Z], rng.choice([140, 165]))
        at = at + high * Z
        site.face([at, at + across, at + across + deep * Y, at + deep * Y], rng.choice([205, 235]))
    for side in (-1, 1):
        site.wall(side * half * X - 0.5 * Y, back[1] * Y + 0.5 * Y, (back[2] + 1.6) * Z, -side * X)
    site.wall(back - half * X, 2 * half * X, 1.6 * Z, -Y)
    site.box([0.4, -1.2, 0.2], [0.3, 0.2, 0.2], rng.uniform(0, np.pi), floor)
    return _arc(rng, [2.0, 4.6], [0.0, 0.5 * back[1], 0.6 * back[2] + 0.4], 14), 480.0


def _tower(site: _Site) -> tuple[list, float]:
    """A tower of five to eight sides with slabs that stand out, and slender posts around it, seen from a helix."""
    rng, number = site.rng, int(site.rng.integers(5, 9))
    floor, height = site.floor(4.0, 4.0), site.rng.uniform(2.2, 3.0)
    turn = rng.uniform(0, np.pi) + 2 * np.pi * np.arange(number + 1) / number
    round_ = np.column_stack([np.cos(turn), np.sin(turn), 0.0 * turn])
    for first, last in zip(1.1 * round_[:-1], 1.1 * round_[1:], strict=True):
        normal = (first + last) / np.linalg.norm(first + last)
        site.wall(first, last - first, height * Z, normal, rng.choice([0.0, 0.004]))
    for low in (0.5 * height - 0.05, height):
        for level in (low, low + 0.1):
            site.face((1.3 * round_[:-1] + level * Z).tolist(), rng.choice(SHADES))
        for first, last in zip(1.3 * round_[:-1] + low * Z, 1.3 * round_[1:] + low * Z, strict=True):
            site.face([first, last, last + 0.1 * Z, first + 0.1 * Z], rng.choice(SHADES))
    for way in rng.uniform(0, 2 * np.pi, 5):
        tall = rng.uniform(0.4, 0.9)
        site.box([2.1 * np.cos(way), 2.1 * np.sin(way), tall], [0.04, 0.04, tall], rng.uniform(0, np.pi), floor)
    poses = []
    for share in np.arange(20) / 20:
        way = 4 * np.pi * share
        center = np.array([4.2 * np.cos(way), 4.2 * np.sin(way), 0.7 + 3.3 * share]) + rng.normal(0, 0.1, 3)
        poses.append(se3.looking_at(center, np.array([0, 0, 0.5 * height]) + rng.normal(0, 0.1, 3)))
    return poses, 520.0


def _arc(rng: np.random.Generator, radii: list, target: list, number: int) -> list:
    """Poses on an arc before the front of a building."""
    poses = []
    for way in np.pi * (0.2 + 0.6 * np.arange(number) / (number - 1)):
        center = np.array([radii[0] * np.cos(way), 1 - radii[1] * np.sin(way), 1.5]) + rng.normal(0, 0.15, 3)
        poses.append(se3.looking_at(center, np.array(target) + rng.normal(0, 0.15, 3)))
    return poses


#: By name: what puts up the faces of a building, and returns poses and focal length.
KINDS = {"room": _room, "wings": _wings, "gable": _gable, "stairs": _stairs, "tower": _tower}
