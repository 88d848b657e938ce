# SPDX-License-Identifier: BSD-3-Clause
"""A closed square corridor: walls, floor and ceiling with points and segments on them.

Cameras walk round twice, the second time looking back, so the camera graph has the band of a video and the fill of a
revisit. Walls do not hide what lies behind them; depth does: nothing is seen beyond 12 units.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, check_kind
from groma.geometry import quaternion
from groma.scene.camera import Cameras
from groma.scene.landmarks import Lines
from groma.scene.observations import Relations
from groma.scene.synthetic.noise import Structure, SyntheticScene, assemble, project_pinhole, rotated

WIDTH, HEIGHT, FOCAL = 1280, 960, 800.0
#: Half width and height of the corridor, range of depths that are seen.
HALF, TALL, NEAR, FAR = 1.5, 2.7, 0.6, 12.0
#: Images, points, lines, planes, mean views of a point and of a line.
SIZES = {
    "tiny": (12, 600, 200, 16, 7, 6),
    "small": (50, 5_000, 2_000, 16, 9, 8),
    "medium": (300, 50_000, 20_000, 64, 10, 8),
    "large": (1500, 400_000, 100_000, 256, 9, 8),
}
#: Start: rotation (degrees), camera centre, points and end points, normals (radians); standard deviations.
START = (0.5, 0.03, 0.05, 0.01)


@dataclass(frozen=True)
class _Loop:
    """The centre line: a square of the given perimeter, walked counter-clockwise."""

    perimeter: float

    def at(self, arclength: FloatArray) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return position (N, 2), heading (N, 2) and leg (N,)."""
        side = self.perimeter / 4
        along = np.mod(arclength, self.perimeter)
        leg = np.minimum((along // side).astype(np.int64), 3)
        corner = side * np.array([[0, 0], [1, 0], [1, 1], [0, 1.0]])
        heading = np.array([[1, 0], [0, 1], [-1, 0], [0, -1.0]])[leg]
        return corner[leg] + (along - leg * side)[:, None] * heading, heading, leg

    def on_wall(self, arclength: FloatArray, face: IntArray, across: FloatArray) -> tuple[FloatArray, IntArray]:
        """Return points on a face (0 left, 1 right, 2 floor, 3 ceiling), ``across`` from 0 to 1, and their leg."""
        position, heading, leg = self.at(arclength)
        side = np.select([face == 0, face == 1], [HALF, -HALF], (across - 0.5) * 2 * HALF)
        height = np.select([face < 2, face == 2], [across * TALL, 0.0], TALL)
        return np.column_stack([position + side[:, None] * _left(heading), height]), leg


def corridor(
    size: int | Literal["tiny", "small", "medium", "large"] = "small", seed: int = 0, noise_px: float = 0.5
) -> SyntheticScene:
    """Make a walk round a square corridor.

    Parameters
    ----------
    size : int or str
        Number of images (100 points and 40 lines each), or "tiny", "small", "medium", "large": 12, 50, 300, 1500.
    seed : int
        Everything random follows from it.
    noise_px : float
        Standard deviation of pixel coordinates.

    Returns
    -------
    SyntheticScene
        Truth and start. Every point is seen at least twice, every line three times, planes by what lies on them.

    Raises
    ------
    InputError
        If ``size`` is neither a number of at least 2 nor one of the names.
    """
    if isinstance(size, str):
        if size not in SIZES:
            raise InputError(f"size must be a number of images or one of {', '.join(SIZES)}; got {size!r}.")
        numbers = SIZES[size]
    else:
        check_kind(size, (int, np.integer), "size", f"Pass a number of images, or one of {', '.join(SIZES)}.")
        if size < 2:
            raise InputError(f"size must be at least 2 images; got {size}.")
        numbers = (size, 100 * size, 40 * size, 16 * max(1, round(size / 75)), 9, 8)
    count, num_points, num_lines, num_planes, track, line_track = numbers
    rng = np.random.default_rng([seed, count])
    loop = _Loop(max(24.0, count / 4))
    panels = num_planes // 4  # a multiple of four: no panel goes round a corner
    poses, centers, arclength = _walk(rng, loop, count)

    place, face, across = _places(rng, loop, num_points)
    xyz = loop.on_wall(place, face, across)[0]
    point_plane = (place / loop.perimeter * panels).astype(np.int64) * 4 + face
    line_place, segments, line_plane = _segments(rng, loop, num_lines, panels)

    params = np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])
    point_obs, line_obs, trims = _see(rng, loop, params, poses, arclength, (place, xyz), (line_place, segments))
    keep, seen = _thin(rng, point_obs[:, 0], num_points, track, 2)
    point_obs = np.column_stack([(np.cumsum(seen) - 1)[point_obs[keep, 0]], point_obs[keep, 1]])
    keep, line_seen = _thin(rng, line_obs[:, 0], num_lines, line_track, 3)
    line_obs = np.column_stack([(np.cumsum(line_seen) - 1)[line_obs[keep, 0]], line_obs[keep, 1]])
    trims = trims[keep]
    xyz, point_plane, segments, line_plane = xyz[seen], point_plane[seen], segments[line_seen], line_plane[line_seen]

    planes, anchors = _panels(loop, panels)
    relations = Relations(
        point_on_plane=np.column_stack([np.arange(len(xyz)), point_plane]),
        line_on_plane=np.column_stack([np.arange(len(segments)), line_plane]),
    )
    camera = Cameras(np.array([1]), ("PINHOLE",), params[None], np.array([WIDTH]), np.array([HEIGHT]))
    exact = Structure(xyz, segments, planes, relations, point_obs, line_obs, trims)
    truth = assemble(rng, camera, poses, exact, noise_px)

    rotation_deg, shift, structure, tilt = START
    turned = rotated(rng, poses, rotation_deg)
    turned[:, 4:] = -quaternion.rotate(turned[:, :4], centers + rng.normal(0, shift, centers.shape))
    normal = quaternion.rotate(quaternion.exp(rng.normal(0, tilt, (len(planes), 3))), planes[:, :3])
    offset = -np.einsum("ij,ij->i", normal, anchors) + rng.normal(0, structure, len(planes))
    start = truth.replace(
        points=truth.points.replace(xyz=xyz + rng.normal(0, structure, xyz.shape)),
        lines=Lines.through(segments + rng.normal(0, structure, segments.shape)),
    )
    start = start.with_poses(turned).with_planes(np.column_stack([normal, offset]))
    return SyntheticScene(truth, start, noise_px)


def _walk(rng: np.random.Generator, loop: _Loop, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    arclength = np.linspace(0, 2 * loop.perimeter, count, endpoint=False) + rng.normal(0, 0.05, count)
    position, heading, _ = loop.at(arclength)
    sideways = position + rng.uniform(-0.8, 0.8, (count, 1)) * _left(heading)
    center = np.column_stack([sideways, rng.uniform(1.0, 1.9, count)])
    back = np.where(np.arange(count) >= count // 2, np.pi, 0.0)
    yaw = np.arctan2(heading[:, 1], heading[:, 0]) + back + rng.uniform(-0.6, 0.6, count)
    pitch = rng.uniform(-0.15, 0.15, count)
    forward = np.column_stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.column_stack([np.sin(yaw), -np.cos(yaw), np.zeros(count)])
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    poses = np.hstack([quaternion.from_matrix(rotation), -np.einsum("nij,nj->ni", rotation, center)])
    return poses, center, np.mod(arclength, loop.perimeter)


def _left(heading: FloatArray) -> FloatArray:
    return np.stack([-heading[:, 1], heading[:, 0]], axis=1)


def _places(rng: np.random.Generator, loop: _Loop, count: int) -> tuple[FloatArray, IntArray, FloatArray]:
    return rng.uniform(0, loop.perimeter, count), rng.integers(0, 4, count), rng.uniform(0, 1, count)


def _segments(
    rng: np.random.Generator, loop: _Loop, count: int, panels: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return arclength, end points and plane of segments along and across the corridor; none cuts a corner."""
    place, face, across = _places(rng, loop, count)
    length = rng.uniform(0.3, 2.5, count)
    along = rng.random(count) < 0.6
    begin, leg = loop.on_wall(place, face, across)
    turned = np.clip(across + length / TALL * np.where(across < 0.5, 1, -1), 0, 1)
    other = np.where(along, across, turned)
    end, end_leg = loop.on_wall(np.where(along, place + length, place), face, other)
    back, _ = loop.on_wall(np.where(along, place - length, place), face, other)
    end = np.where(((leg != end_leg) & along)[:, None], back, end)
    plane = (place / loop.perimeter * panels).astype(np.int64) * 4 + face
    return place, np.stack([begin, end], axis=1), plane


def _panels(loop: _Loop, panels: int) -> tuple[FloatArray, FloatArray]:
    """Return the planes, four faces for every panel, and a point in the middle of each."""
    middle = np.repeat((np.arange(panels) + 0.5) * loop.perimeter / panels, 4)
    face = np.tile(np.arange(4), panels)
    anchors = loop.on_wall(middle, face, np.full(len(face), 0.5))[0]
    heading = loop.at(middle)[1]
    normal = np.where((face < 2)[:, None], np.column_stack([_left(heading), np.zeros(len(face))]), [[0, 0, 1.0]])
    return np.column_stack([normal, -np.einsum("ij,ij->i", normal, anchors)]), anchors


def _see(
    rng: np.random.Generator,
    loop: _Loop,
    params: FloatArray,
    poses: FloatArray,
    arclength: FloatArray,
    points: tuple[FloatArray, FloatArray],
    lines: tuple[FloatArray, FloatArray],
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return (point, image) pairs, (line, image) pairs, and the part of each line that is seen."""
    near_points, near_lines = _Nearby(loop, points[0]), _Nearby(loop, lines[0])
    point_pairs, line_pairs, shares = [], [], []
    for image, pose in enumerate(poses):
        row = near_points(arclength[image])
        row = row[_visible(*project_pinhole(params, pose, points[1][row]))]
        point_pairs.append(np.column_stack([row, np.full(len(row), image)]))
        row = near_lines(arclength[image])
        share = np.column_stack([rng.uniform(0, 0.3, len(row)), rng.uniform(0.7, 1.0, len(row))])
        begin, end = lines[1][row, 0], lines[1][row, 1]
        ends = [project_pinhole(params, pose, begin + part[:, None] * (end - begin)) for part in share.T]
        good = _visible(*ends[0]) & _visible(*ends[1]) & (np.linalg.norm(ends[0][0] - ends[1][0], axis=1) > 20)
        line_pairs.append(np.column_stack([row[good], np.full(good.sum(), image)]))
        shares.append(share[good])
    return np.concatenate(point_pairs), np.concatenate(line_pairs), np.concatenate(shares)


class _Nearby:
    """Find what lies within sight along the loop."""

    def __init__(self, loop: _Loop, place: FloatArray) -> None:
        self.perimeter, self.order = loop.perimeter, np.argsort(place, kind="stable")
        self.sorted = place[self.order]

    def __call__(self, place: float) -> IntArray:
        found = []
        for center in (place - self.perimeter, place, place + self.perimeter):
            begin, end = np.searchsorted(self.sorted, [center - FAR, center + FAR])
            found.append(self.order[begin:end])
        return np.unique(np.concatenate(found))


def _visible(pixel: FloatArray, depth: FloatArray) -> BoolArray:
    inside = ((pixel > 0) & (pixel < [WIDTH, HEIGHT])).all(-1)
    return inside & (depth > NEAR) & (depth < FAR)


def _thin(rng: np.random.Generator, owner: IntArray, count: int, mean: int, least: int) -> tuple[IntArray, BoolArray]:
    """Keep at random about ``mean`` observations of each landmark; drop landmarks left with fewer than ``least``."""
    order = np.lexsort((rng.random(len(owner)), owner))
    first = np.searchsorted(owner[order], np.arange(count))
    rank = np.arange(len(owner)) - first[owner[order]]
    cap = rng.poisson(mean - 2, count) + 2
    kept = order[rank < cap[owner[order]]]
    alive = np.bincount(owner[kept], minlength=count) >= least
    return kept[alive[owner[kept]]], alive
