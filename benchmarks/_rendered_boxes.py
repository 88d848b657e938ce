# SPDX-License-Identifier: BSD-3-Clause
"""Rendered rooms of boxes and round bodies whose edges are known exactly.

A world is a list of convex polygons with a grey value each. Seen from a camera, whether a pixel's ray hits a polygon
and at what depth depends on the pixel through linear functions only, so a picture is a few dozen array operations.

Round bodies are cylinders, frusta of cones and ellipsoids. Their rims are edges; their contours are none.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from groma.geometry import quaternion, se3
from groma.scene import Cameras, PointObservations, Points, Scene

#: Places per edge at which its visibility is tested.
PLACES = 200
#: Half the side of the floor, scene units.
FLOOR = 3.0
#: Straight pieces of a rim.
RIM = 64
BACKGROUND = 30.0
#: Corners of the six sides of a box, with x, y, z from low to high, the last the fastest; which side is its bottom.
BOX_SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOTTOM = 4
#: Rays per pixel, in either direction.
SAMPLES = 3


@dataclass(frozen=True)
class BoxSettings:
    """What a world of boxes looks like, and from where."""

    seed: int = 0
    num_images: int = 24
    width: int = 960
    height: int = 720
    focal: float = 850.0
    num_boxes: int = 8
    #: Cylinders, cones and ellipsoids, in turn.
    num_round: int = 0
    #: Standard deviation of the blotches on the faces, grey values.
    texture: float = 0.0
    #: Samples along a face's side of the pattern of blotches: more make them smaller.
    blotches: int = 64
    #: Standard deviation of the noise of a pixel, grey values.
    noise: float = 2.0
    #: Standard deviation of the blur, pixels.
    blur: float = 0.6
    #: "ring": on a wavy ring around the boxes; "random": anywhere above, from near and far, tilted.
    cameras: str = "ring"
    #: Rectangles on a facade behind the boxes, and how far they lie off its plane, scene units: most are upright and
    #: nearly in its plane, some turned by a few degrees, some well in front.
    num_panels: int = 0
    rough: float = 0.0


@dataclass(frozen=True, eq=False)
class RenderedScene:
    """Images, their exact cameras, points on the surfaces, and the edges that at least two images see."""

    scene: Scene
    images: list[np.ndarray]
    #: (E, 2, 3) visible pieces of edges.
    edges: np.ndarray
    #: Corners of the faces, the face that each point lies on (-1: a round body), and the plane that each face is meant
    #: to lie in.
    faces: list[np.ndarray]
    face_of_point: np.ndarray
    plane_of_face: np.ndarray


@dataclass(frozen=True, eq=False)
class _Round:
    """A body that an affine map makes of x^2 + y^2 <= (1 - taper z)^2, 0 <= z <= 1, or of the unit ball."""

    world_from_body: np.ndarray
    #: None for the ball.
    taper: float | None
    shade: float


@dataclass(eq=False)
class World:
    """Faces, edges and round bodies."""

    polygons: list[np.ndarray]
    shades: list[float]
    edges: np.ndarray
    rounds: list[_Round]
    #: Numbers of planes, one for each polygon; faces of one plane have the same.
    planes: list[int]


def render_boxes(settings: BoxSettings) -> RenderedScene:
    """Make the world of a seed, its images and its visible edges."""
    rng = np.random.default_rng(settings.seed)
    world = _boxes(settings, rng)
    if settings.num_panels:
        _add_facade(world, settings, rng)
    places = {"random": _scattered, "ring": _ring, "front": _front}[settings.cameras]
    return render(world, places(settings, rng), settings, rng)


def render(world: World, poses: np.ndarray, settings: BoxSettings, rng: np.random.Generator) -> RenderedScene:
    """Make the images of a world from some poses (C, 7), its points and its visible edges."""
    camera = np.array([settings.focal, settings.focal, settings.width / 2, settings.height / 2])
    blotches = [_blotches(rng, settings.blotches) for _ in world.polygons] if settings.texture else None
    images = [_picture(world, pose, camera, settings, blotches, rng) for pose in poses]
    points, observations, face_of_point = _points(world, poses, camera, settings, rng)
    scene = Scene.from_images(
        Cameras(np.array([1]), ("PINHOLE",), camera[None], np.array([settings.width]), np.array([settings.height])),
        [f"{i:03d}.png" for i in range(len(poses))],
        np.zeros(len(poses), int),
        poses,
        points=points,
        point_observations=observations,
    )
    edges = _visible(world, poses, camera, settings)
    return RenderedScene(scene, images, edges, world.polygons, face_of_point, np.array(world.planes))


# -------------------------------------------------------------------------------------------------------------- world
def _boxes(settings: BoxSettings, rng: np.random.Generator) -> World:
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    pairs = [(a, b) for a in range(8) for b in range(a) if (corners[a] != corners[b]).sum() == 1]
    floor = FLOOR * np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    polygons, shades, edges = [floor], [120.0], [floor[[k, (k + 1) % 4]] for k in range(4)]
    placed: list[tuple[np.ndarray, float]] = []
    while len(placed) < settings.num_boxes:
        half = rng.uniform(0.12, 0.4, 3)
        center, reach = np.append(rng.uniform(-1.4, 1.4, 2), half[2]), float(np.hypot(half[0], half[1]))
        if any(np.linalg.norm((center - other)[:2]) < reach + far + 0.03 for other, far in placed):
            continue
        placed.append((center, reach))
        a = rng.uniform(0.0, np.pi)
        turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
        box = center + (corners * half) @ turn.T
        polygons += [box[list(side)] for side in BOX_SIDES]
        shades += rng.permutation([50.0, 80, 150, 180, 210, 240]).tolist()
        edges += [box[list(pair)] for pair in pairs]
    rounds: list[_Round] = []
    while len(rounds) < settings.num_round:
        radius, height = rng.uniform(0.06, 0.3), rng.uniform(0.25, 0.9)
        center = np.append(rng.uniform(-1.6, 1.6, 2), 0.0)
        if any(np.linalg.norm((center - other)[:2]) < radius + far + 0.03 for other, far in placed):
            continue
        placed.append((center, radius))
        ball = len(rounds) % 3 == 2
        body = _Round(
            np.column_stack([np.diag([radius, radius, height / 2 if ball else height]), center]),
            None if ball else (0.0, 0.5)[len(rounds) % 3],
            float(rng.choice([60.0, 90, 170, 200, 230])),
        )
        if ball:
            body.world_from_body[2, 3] = height / 2
        rounds.append(body)
        edges += _rims(body)
    # Boxes stand on the floor: their first side, at the bottom, is in its plane.
    planes = [0, *(0 if k % 6 == BOTTOM else k + 1 for k in range(len(polygons) - 1))]
    return World(polygons, shades, np.array(edges), rounds, planes)


def _add_facade(world: World, settings: BoxSettings, rng: np.random.Generator) -> None:
    """A wall at the end of the floor with rectangles: joints, panels, boards; some askew."""
    wall, first = len(world.polygons), len(world.polygons)
    world.polygons.append(FLOOR * np.array([[-1.0, 1, 0], [1, 1, 0], [1, 1, 1], [-1, 1, 1]]))
    world.shades.append(140.0)
    world.planes.append(wall)
    edges, taken = [world.polygons[-1][[k, (k + 1) % 4]] for k in range(4)], []
    while len(world.polygons) - first <= settings.num_panels:
        half = rng.uniform(0.08, 0.45, 2)
        center = np.array([rng.uniform(-2.5, 2.5), rng.uniform(0.5, 2.5)])
        if any((np.abs(center - other) < 1.3 * (half + far)).all() for other, far in taken):
            if len(taken) > 20 and rng.uniform() < 0.01:
                break
            continue
        taken.append((center, half))
        kind = rng.choice(["upright", "turned", "in front"], p=[0.7, 0.15, 0.15])
        angle = rng.uniform(0.02, 0.15) * rng.choice([-1, 1]) if kind == "turned" else 0.0
        across = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        corners = center + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half) @ across.T
        away = rng.uniform(0.03, 0.15) if kind == "in front" else 2e-4 + abs(rng.normal(0.0, settings.rough))
        panel = np.column_stack([corners[:, 0], np.full(4, FLOOR - away), corners[:, 1]])
        world.planes.append(len(world.polygons) if kind == "in front" else wall)
        world.polygons.append(panel)
        world.shades.append(float(rng.choice([40.0, 70, 100, 190, 220])))
        edges += [panel[[k, (k + 1) % 4]] for k in range(4)]
    world.edges = np.concatenate([world.edges, edges])


def _front(settings: BoxSettings, rng: np.random.Generator) -> np.ndarray:
    """Poses (C, 7) on an arc before the facade."""
    poses = []
    for k in range(settings.num_images):
        a = np.pi * (0.15 + 0.7 * k / max(settings.num_images - 1, 1))
        center = np.array([3.5 * np.cos(a), 3.0 - 5.0 * np.sin(a), 1.4]) + rng.normal(0, 0.15, 3)
        poses.append(se3.looking_at(center, np.array([0.6 * np.cos(a), FLOOR, 1.2]) + rng.normal(0, 0.1, 3)))
    return np.array(poses)


def _rims(body: _Round) -> list[np.ndarray]:
    """Straight pieces (2, 3) of the rims of a body."""
    if body.taper is None:
        return []
    around = 2 * np.pi * np.arange(RIM + 1) / RIM
    circle = np.column_stack([np.cos(around), np.sin(around)])
    rims = [np.column_stack([circle * (1.0 - body.taper * z), np.full(RIM + 1, z)]) for z in (0.0, 1.0)]
    places = [rim @ body.world_from_body[:, :3].T + body.world_from_body[:, 3] for rim in rims]
    return [rim[[k, k + 1]] for rim in places for k in range(RIM)]


def _ring(settings: BoxSettings, rng: np.random.Generator) -> np.ndarray:
    """Poses (C, 7) on a wavy ring around the boxes, looking inwards."""
    poses = []
    for k in range(settings.num_images):
        a = 2 * np.pi * k / settings.num_images
        center = np.array([3.6 * np.cos(a), 3.6 * np.sin(a), 1.4 + 0.5 * np.sin(3 * a)]) + rng.normal(0, 0.05, 3)
        poses.append(se3.looking_at(center, np.array([0, 0, 0.3])))
    return np.array(poses)


def _scattered(settings: BoxSettings, rng: np.random.Generator) -> np.ndarray:
    """Poses (C, 7) at random places around and above the boxes, turned about their axes by some degrees."""
    poses = []
    while len(poses) < settings.num_images:
        away, around, up = rng.uniform(2.2, 5.0), rng.uniform(0, 2 * np.pi), rng.uniform(0.12, 1.1)
        center = away * np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
        if np.hypot(center[0], center[1]) < 2.0 and center[2] < 1.2:
            continue  # among the boxes
        upright = se3.looking_at(center, np.array([0, 0, 0.3]) + rng.normal(0, 0.3, 3))
        poses.append(se3.compose(se3.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.0, -rng.normal(0, 0.15)])), upright))
    return np.array(poses)


def _blotches(rng: np.random.Generator, size: int) -> np.ndarray:
    """A smooth random pattern of unit deviation, without edges."""
    pattern = cv2.GaussianBlur(rng.normal(size=(size, size)), (0, 0), 3.0)
    return ((pattern - pattern.mean()) / pattern.std()).astype(np.float32)


# ------------------------------------------------------------------------------------------------------------ pictures
def _inside(polygon: np.ndarray, rays: np.ndarray, margin: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth along rays (n, 3) to a polygon in the camera frame, and whether they hit it."""
    normal = np.cross(polygon[1] - polygon[0], polygon[2] - polygon[0])
    inverse = rays @ normal / (normal @ polygon[0])
    hit = inverse > 1e-9
    turn = np.sign(normal @ polygon[0])
    for a, b in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        side = np.cross(a, b)
        hit &= turn * (rays @ side) > margin * np.linalg.norm(side)
    return inverse, hit


def _picture(world, pose, camera, settings, blotches, rng) -> np.ndarray:
    width, height = settings.width * SAMPLES, settings.height * SAMPLES
    x = ((np.arange(width) + 0.5) / SAMPLES - camera[2]) / camera[0]
    y = ((np.arange(height) + 0.5) / SAMPLES - camera[3]) / camera[1]
    R = quaternion.to_matrix(pose[None, :4])[0]
    nearest, grey = np.zeros((height, width), np.float32), np.full((height, width), BACKGROUND, np.float32)
    for k, (polygon, shade) in enumerate(zip(world.polygons, world.shades, strict=True)):
        local = polygon @ R.T + pose[4:]
        columns, rows = slice(0, width), slice(0, height)
        if local[:, 2].min() > 1e-3:
            near = local[:, :2] / local[:, 2:]
            columns = slice(*np.searchsorted(x, [near[:, 0].min(), near[:, 0].max()]))
            rows = slice(*np.searchsorted(y, [near[:, 1].min(), near[:, 1].max()]))
        at_x, at_y = x[columns].astype(np.float32), y[rows].astype(np.float32)

        def over(v: np.ndarray, at_x: np.ndarray = at_x, at_y: np.ndarray = at_y) -> np.ndarray:
            """The linear function v of the ray, at all pixels."""
            v = v.astype(np.float32)
            return at_x * v[0] + (at_y * v[1] + v[2])[:, None]

        normal = np.cross(local[1] - local[0], local[-1] - local[0])
        offset = normal @ local[0]
        inverse = over(normal / offset)
        hit = inverse > np.maximum(nearest[rows, columns], 1e-9)
        for a, b in zip(local, np.roll(local, -1, axis=0), strict=True):
            hit &= over(np.sign(offset) * np.cross(a, b)) > 0
        value = np.float32(shade)
        if blotches is not None and hit.any():
            # Place in the polygon along its two sides at the first corner, which are perpendicular.
            scaled = [(settings.blotches - 1) * v / (v @ v) for v in (local[1] - local[0], local[-1] - local[0])]
            s, t = (over(v) / np.where(hit, inverse, 1) - np.float32(v @ local[0]) for v in scaled)
            value = value + np.float32(settings.texture) * cv2.remap(blotches[k], s, t, cv2.INTER_LINEAR)
        nearest[rows, columns] = np.where(hit, inverse, nearest[rows, columns])
        grey[rows, columns] = np.where(hit, value, grey[rows, columns])
    for body in world.rounds:
        columns, rows = _frame_of(body, pose, x, y)
        rays = np.stack([*np.meshgrid(x[columns], y[rows]), np.ones((len(y[rows]), len(x[columns])))], axis=-1)
        inverse, hit, normal = _round_hit(body, pose, rays)
        hit &= inverse > np.maximum(nearest[rows, columns], 1e-9)
        value = body.shade * (0.65 + 0.35 * (normal @ np.array([0.48, 0.36, 0.8])))
        nearest[rows, columns] = np.where(hit, inverse, nearest[rows, columns])
        grey[rows, columns] = np.where(hit, value, grey[rows, columns])
    small = grey.reshape(settings.height, SAMPLES, settings.width, SAMPLES).mean((1, 3))
    blurred = cv2.GaussianBlur(small, (0, 0), settings.blur) if settings.blur else small
    return np.clip(blurred + rng.normal(0, settings.noise, small.shape), 0, 255).astype(np.uint8)


# -------------------------------------------------------------------------------------------------------- round bodies
def _frame_of(body: _Round, pose: np.ndarray, x: np.ndarray, y: np.ndarray) -> tuple[slice, slice]:
    """Columns and rows of a picture in which a body lies."""
    low = -1.0 if body.taper is None else 0.0
    corners = np.array([[a, b, c, 1.0] for a in (-1, 1) for b in (-1, 1) for c in (low, 1)])
    local = corners @ body.world_from_body.T @ quaternion.to_matrix(pose[None, :4])[0].T + pose[4:]
    if local[:, 2].min() < 1e-3:
        return slice(None), slice(None)
    near = local[:, :2] / local[:, 2:]
    limits = [slice(*np.searchsorted(axis, [v.min(), v.max()])) for axis, v in zip((x, y), near.T, strict=True)]
    return limits[0], limits[1]


def _round_hit(body: _Round, pose: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inverse depth along rays (..., 3) in the camera frame to a body, whether they hit it, and its normals there."""
    R = quaternion.to_matrix(pose[None, :4])[0]
    body_from_world = np.linalg.inv(body.world_from_body[:, :3])
    o, d = body_from_world @ (-R.T @ pose[4:] - body.world_from_body[:, 3]), rays @ R @ body_from_world.T
    flat, taper = np.array([1.0, 1.0, 1.0 if body.taper is None else 0.0]), body.taper or 0.0
    a = (d**2 @ flat) - (taper * d[..., 2]) ** 2
    b = (d * o) @ flat + taper * d[..., 2] * (1.0 - taper * o[2])
    c = o**2 @ flat - (1.0 - taper * o[2]) ** 2
    root = np.sqrt(np.maximum(b * b - a * c, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (-b - root) / a
        place = o + depth[..., None] * d
        hit = (b * b > a * c) & (depth > 1e-6)
        outward = place * flat + np.array([0, 0, 1.0]) * (taper * (1.0 - taper * place[..., 2:]))
        if body.taper is not None:
            hit &= (place[..., 2] > 0.0) & (place[..., 2] < 1.0)
            top = (1.0 - o[2]) / d[..., 2]
            over = (((o + top[..., None] * d)[..., :2] ** 2).sum(-1) < (1.0 - taper) ** 2) & (top > 1e-6)
            over &= ~hit | (top < depth)
            depth, hit = np.where(over, top, depth), hit | over
            outward = np.where(over[..., None], [0, 0, 1.0], outward)
        normal = outward @ body_from_world
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        return np.where(hit, 1.0 / depth, 0.0), hit, np.nan_to_num(normal)


# ---------------------------------------------------------------------------------------------------------- visibility
def _seen(world, places, pose, camera, settings) -> tuple[np.ndarray, np.ndarray]:
    """Pixels of places (n, 3), and whether an image sees them."""
    R = quaternion.to_matrix(pose[None, :4])[0]
    local = places @ R.T + pose[4:]
    ahead = local[:, 2] > 1e-6
    rays = local / np.where(ahead, local[:, 2], 1.0)[:, None]
    pixel = rays[:, :2] * camera[:2] + camera[2:]
    seen = ahead & (pixel > 0).all(1) & (pixel < [settings.width, settings.height]).all(1)
    for polygon in world.polygons:
        inverse, hit = _inside(polygon @ R.T + pose[4:], rays, 1e-6)
        seen &= ~(hit & (inverse * local[:, 2] > 1.0 + 1e-5))
    for body in world.rounds:
        inverse, hit, _ = _round_hit(body, pose, rays)
        seen &= ~(hit & (inverse * local[:, 2] > 1.0 + 1e-3))
    return pixel, seen


def _visible(world: World, poses: np.ndarray, camera: np.ndarray, settings: BoxSettings) -> np.ndarray:
    """Pieces of the edges that at least two images see."""
    number = PLACES if not world.rounds else PLACES // 5
    share = (np.arange(number) + 0.5) / number
    places = world.edges[:, None, 0] + share[None, :, None] * (world.edges[:, 1] - world.edges[:, 0])[:, None]
    count = sum(_seen(world, places.reshape(-1, 3), pose, camera, settings)[1].astype(int) for pose in poses)
    pieces = []
    for edge, seen in zip(world.edges, (np.asarray(count) >= 2).reshape(-1, number), strict=True):
        steps = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(int)))
        for begin, end in steps.reshape(-1, 2) / number:
            pieces.append([edge[0] + t * (edge[1] - edge[0]) for t in (begin, end)])
    return np.array(pieces)


def _points(world, poses, camera, settings, rng) -> tuple[Points, PointObservations, np.ndarray]:
    """Points on all surfaces, observed with 0.3 pixels of noise, and the face of each."""
    xyz = []
    for k, polygon in enumerate(world.polygons):
        s, t = rng.uniform(0.08, 0.92, (2, 300 if k == 0 else 25, 1))
        xyz.append(polygon[0] + s * (polygon[1] - polygon[0]) + t * (polygon[-1] - polygon[0]))
    for body in world.rounds:
        if body.taper is None:
            unit = rng.normal(size=(40, 3))
            unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        else:
            around, z = rng.uniform(0, 2 * np.pi, 40), rng.uniform(0.05, 0.95, 40)
            unit = np.column_stack([*((1.0 - body.taper * z) * [np.cos(around), np.sin(around)]), z])
        xyz.append(unit @ body.world_from_body[:, :3].T + body.world_from_body[:, 3])
    groups, xyz = xyz, np.concatenate(xyz)
    table = []
    for i, pose in enumerate(poses):
        pixel, seen = _seen(world, xyz, pose, camera, settings)
        rows = np.flatnonzero(seen)
        table.append((np.full(len(rows), i), rows, pixel[rows] + rng.normal(0, 0.3, (len(rows), 2))))
    image, point, pixel = (np.concatenate(column) for column in zip(*table, strict=True))
    faces = np.concatenate([np.full(len(rows), k if k < len(world.polygons) else -1) for k, rows in enumerate(groups)])
    return Points.at(xyz), PointObservations(image, point, pixel, np.arange(len(image))), faces
