# SPDX-License-Identifier: BSD-3-Clause
"""Seeded synthetic scenes with exact truth, for tests, docs and benchmarks.

:func:`holistic` is the published benchmark of points, lines and planes; :func:`corridor` a walk round a square
corridor. Both give the truth and a perturbed start; the measurements, with their noise, are the same in both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError, check_kind
from groma.geometry import quaternion
from groma.scene.camera import Cameras
from groma.scene.landmarks import Lines
from groma.scene.observations import Relations
from groma.scene.synthetic.corridor import corridor
from groma.scene.synthetic.noise import Structure, SyntheticScene, assemble, check_deviations, rotated

WIDTH, HEIGHT, FOCAL = 1024, 768, 800.0
#: Half extent of the cube, radius of the camera sphere, least depth of anything observed.
HALF_EXTENT, RADIUS, NEAR = 3.0, 5.0, 0.3
LINE_LENGTH = (0.5, 3.0)
#: Views of a feature, both ends included.
TRACK = (4, 8)
LINES_PER_PLANE, POINTS_PER_PLANE, POINTS_PER_LINE = 2, 10, 3
#: Images tried first for a feature's views; all are tried only where these do not suffice.
_CANDIDATES = 96
#: Numbers held at once while visibility is tested.
_CHUNK = 2_000_000


def holistic(
    num_images: int = 50,
    seed: int = 0,
    views: Literal["random", "near"] = "random",
    noise_px: float = 1.0,
    rotation_deg: float = 1.0,
    translation: float = 0.05,
    structure: float = 0.1,
) -> SyntheticScene:
    """Make the published holistic benchmark: points, lines and planes in a cube, seen from a sphere.

    N cameras of 1024 x 768 pixels (f = 800) on a sphere of radius 5 look at the centre of a cube of half extent 3
    that holds 10 N points, N lines 0.5 to 3 long and N // 5 axis-parallel planes. On each plane lie two lines and ten
    points, on each line three points. A point or line is seen in 4 to 8 images.

    Parameters
    ----------
    num_images : int
        N, at least 2. Below 8 images tracks are shorter: half of the images, at least two.
    seed : int
        Everything random follows from it.
    views : "random" or "near"
        Images of a feature: any that see it (a dense camera graph), or neighbours in azimuth (a band).
    noise_px : float
        Standard deviation of pixel coordinates.
    rotation_deg, translation, structure : float
        Perturbation of the start: standard deviation per coordinate of the rotation (degrees), of the translation in
        cam_from_world, and of points, line end points and plane offsets (scene units). Plane normals turn by a fifth
        of ``structure``, radians.

    Returns
    -------
    SyntheticScene
        Truth and start.

    References
    ----------
    arXiv 2609.04026, appendix A.3.
    """
    check_kind(num_images, (int, np.integer), "num_images", "Pass a number of images.")
    if num_images < 2:
        raise InputError(f"num_images must be at least 2; got {num_images}.")
    if views not in ("random", "near"):
        raise InputError(f"views must be 'random' or 'near'; got {views!r}.")
    check_deviations(rotation_deg=rotation_deg, translation=translation, structure=structure)
    rng = np.random.default_rng([seed, num_images])
    poses = _sphere_of_cameras(rng, num_images)
    choose = _ViewChoice(rng, poses, views)
    track = (min(TRACK[0], max(2, num_images // 2)), min(TRACK[1], num_images))

    exact = _structure(rng, choose, num_images, track)
    intrinsics = np.array([[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]])
    camera = Cameras(np.array([1]), ("PINHOLE",), intrinsics, np.array([WIDTH]), np.array([HEIGHT]))
    truth = assemble(rng, camera, poses, exact, noise_px)

    turned = rotated(rng, poses, rotation_deg)
    turned[:, 4:] += rng.normal(0, translation, (num_images, 3))
    moved = exact.planes.copy()
    moved[:, :3] = quaternion.rotate(
        quaternion.exp(rng.normal(0, structure / 5, (len(exact.planes), 3))), exact.planes[:, :3]
    )
    moved[:, 3] += rng.normal(0, structure, len(exact.planes))
    start = truth.replace(
        points=truth.points.replace(xyz=exact.xyz + rng.normal(0, structure, exact.xyz.shape)),
        lines=Lines.through(exact.segments + rng.normal(0, structure, exact.segments.shape)),
    )
    return SyntheticScene(truth, start.with_poses(turned).with_planes(moved), noise_px)


def _structure(rng: np.random.Generator, choose: _ViewChoice, num_images: int, track: tuple[int, int]) -> Structure:
    """Return planes, lines on some of them, points on both, and which images see them."""
    planes = np.zeros((num_images // 5, 4))
    planes[:, :3] = np.eye(3)[rng.integers(0, 3, len(planes))]
    planes[:, 3] = -rng.uniform(-0.8 * HALF_EXTENT, 0.8 * HALF_EXTENT, len(planes))

    line_plane = np.full(num_images, -1)
    line_plane[: LINES_PER_PLANE * len(planes)] = np.repeat(np.arange(len(planes)), LINES_PER_PLANE)
    segments, line_obs = _draw_until_seen(rng, choose, line_plane, planes, track, _draw_segments, 2)

    on_line = POINTS_PER_LINE * num_images
    point_line = np.repeat(np.arange(num_images), POINTS_PER_LINE)
    along = np.tile([0.0, 0.5, 1.0], num_images) + np.tile([1, 0, -1], num_images) * rng.uniform(0, 0.2, on_line)
    edge_points = segments[point_line, 0] + along[:, None] * (segments[:, 1] - segments[:, 0])[point_line]
    edge_obs = choose(edge_points[:, None], rng.integers(track[0], track[1] + 1, on_line), track[0])[0]
    free_plane = np.full(10 * num_images - on_line, -1)
    extra = POINTS_PER_PLANE - POINTS_PER_LINE * LINES_PER_PLANE
    free_plane[: extra * len(planes)] = np.repeat(np.arange(len(planes)), extra)
    free_points, free_obs = _draw_until_seen(rng, choose, free_plane, planes, track, _draw_points, 1)

    xyz = np.concatenate([edge_points, free_points[:, 0]])
    point_plane = np.concatenate([line_plane[point_line], free_plane])
    point_obs = np.concatenate([edge_obs, free_obs + np.array([on_line, 0])])
    relations = Relations(
        point_on_plane=_pairs(point_plane),
        line_on_plane=_pairs(line_plane),
        point_on_line=np.column_stack([np.arange(on_line), point_line]),
    )
    return Structure(xyz, segments, planes, relations, point_obs, line_obs)


def _sphere_of_cameras(rng: np.random.Generator, count: int) -> FloatArray:
    """Return poses of cameras on a jittered Fibonacci sphere that look at its centre."""
    step = np.arange(count) + 0.5
    height = 1 - 2 * step / count
    angle = np.pi * (1 + 5**0.5) * step
    radius = np.sqrt(1 - height**2)
    center = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    center += rng.normal(0, 0.3 / np.sqrt(count), center.shape)
    center *= RADIUS / np.linalg.norm(center, axis=1, keepdims=True)
    center = center[rng.permutation(count)]
    forward = -center / RADIUS
    up = np.where(np.abs(forward[:, 2:]) > 0.98, [[1.0, 0, 0]], [[0, 0, 1.0]])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return np.hstack([quaternion.from_matrix(rotation), -np.einsum("nij,nj->ni", rotation, center)])


class _ViewChoice:
    """Choose for each feature some of the images that see all of its points."""

    def __init__(self, rng: np.random.Generator, poses: FloatArray, views: str) -> None:
        self.rng, self.views, self.count = rng, views, len(poses)
        self.rotation, self.translation = quaternion.to_matrix(poses[:, :4]), poses[:, 4:]
        center = -np.einsum("nij,ni->nj", self.rotation, self.translation)
        self.by_azimuth = np.argsort(np.arctan2(center[:, 1], center[:, 0]), kind="stable")
        steps = np.arange(self.count)
        self.outward = steps[np.argsort(np.abs(steps - self.count // 2), kind="stable")] - self.count // 2

    def __call__(self, features: FloatArray, wanted: IntArray, least: int) -> tuple[IntArray, BoolArray]:
        """Return (feature, image) pairs, and which of the features (M, points, 3) are seen at least ``least`` times."""
        pairs, enough = self._choose(np.arange(len(features)), features, wanted, least, min(_CANDIDATES, self.count))
        if not enough.all() and self.count > _CANDIDATES:
            rest = np.flatnonzero(~enough)
            more, now = self._choose(rest, features[rest], wanted[rest], least, self.count)
            pairs, enough[rest] = np.concatenate([pairs, more]), now
        return pairs, enough

    def _choose(
        self, names: IntArray, features: FloatArray, wanted: IntArray, least: int, tries: int
    ) -> tuple[IntArray, BoolArray]:
        pairs: list[IntArray] = [np.zeros((0, 2), np.int64)]
        enough = np.zeros(len(features), bool)
        step = max(1, _CHUNK // (tries * features.shape[1] * 9))
        for begin in range(0, len(features), step):
            rows = slice(begin, begin + step)
            images = self._candidates(len(features[rows]), tries)
            good = self._sees(images, features[rows]) & ~_repeats(images)
            rank = np.cumsum(good, axis=1)
            need = np.minimum(wanted[rows], self.count)
            # With all images tried fewer views than wanted will do; with some, the feature waits for the full trial.
            enough[rows] = rank[:, -1] >= (least if tries == self.count else need)
            keep = good & (rank <= need[:, None]) & enough[rows, None]
            feature, column = np.nonzero(keep)
            pairs.append(np.column_stack([names[begin + feature], images[feature, column]]))
        return np.concatenate(pairs), enough

    def _candidates(self, rows: int, tries: int) -> IntArray:
        if self.views == "near":
            first = self.rng.integers(self.count, size=(rows, 1))
            return self.by_azimuth[(first + self.outward[None, :tries]) % self.count]
        if tries == self.count:
            return np.argsort(self.rng.random((rows, tries)), axis=1)
        return self.rng.integers(self.count, size=(rows, tries))  # drawn with repetition; repeats are struck out

    def _sees(self, images: IntArray, features: FloatArray) -> BoolArray:
        rotation, translation = self.rotation[images], self.translation[images]
        seen = np.ones(images.shape, bool)
        for point in features.swapaxes(0, 1):
            in_cam = np.einsum("mtij,mj->mti", rotation, point) + translation
            depth = in_cam[..., 2]
            # One pixel inside the border, without a division: |x| < z (width / 2 - 1) / f.
            for axis, half in ((0, WIDTH / 2 - 1), (1, HEIGHT / 2 - 1)):
                seen &= np.abs(in_cam[..., axis]) < depth * (half / FOCAL)
            seen &= depth > NEAR
        return seen


def _repeats(images: IntArray) -> BoolArray:
    """Return where a row holds an image that stood in the row before."""
    order = np.argsort(images, axis=1, kind="stable")
    ordered = np.take_along_axis(images, order, 1)
    again = np.zeros(images.shape, bool)
    np.put_along_axis(again, order[:, 1:], ordered[:, 1:] == ordered[:, :-1], 1)
    return again


def _draw_until_seen(
    rng: np.random.Generator,
    choose: _ViewChoice,
    on_plane: IntArray,
    planes: FloatArray,
    track: tuple[int, int],
    draw: Callable[[np.random.Generator, IntArray, FloatArray], FloatArray],
    points: int,
) -> tuple[FloatArray, IntArray]:
    """Draw features of some points each; draw those again that leave the cube or are seen too little."""
    features = np.zeros((len(on_plane), points, 3))
    pairs: list[IntArray] = [np.zeros((0, 2), np.int64)]
    wanted = rng.integers(track[0], track[1] + 1, len(on_plane))
    waiting = np.arange(len(on_plane))
    while len(waiting):
        drawn = draw(rng, on_plane[waiting], planes)
        features[waiting] = drawn
        inside = np.abs(drawn).max((1, 2)) <= HALF_EXTENT + 1e-9
        seen, enough = choose(drawn[inside], wanted[waiting[inside]], track[0])
        done = waiting[inside]
        pairs.append(np.column_stack([done[seen[:, 0]], seen[:, 1]]))
        waiting = np.setdiff1d(waiting, done[enough])
    return features, np.concatenate(pairs)


def _draw_points(rng: np.random.Generator, on_plane: IntArray, planes: FloatArray) -> FloatArray:
    """Return random points in the cube, (M, 1, 3), on their planes where they have one."""
    xyz = rng.uniform(-HALF_EXTENT, HALF_EXTENT, (len(on_plane), 3))
    held = on_plane >= 0
    plane = planes[on_plane[held]]
    xyz[held] -= (np.einsum("ij,ij->i", xyz[held], plane[:, :3]) + plane[:, 3])[:, None] * plane[:, :3]
    return xyz[:, None]


def _draw_segments(rng: np.random.Generator, on_plane: IntArray, planes: FloatArray) -> FloatArray:
    """Return random segments, (M, 2, 3), on their planes where they have one."""
    middle = _draw_points(rng, on_plane, planes)[:, 0]
    direction = rng.normal(size=middle.shape)
    held = on_plane >= 0
    normal = planes[on_plane[held], :3]
    direction[held] = np.cross(normal, direction[held])  # a uniformly random direction on the plane
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    half = rng.uniform(*LINE_LENGTH, (len(middle), 1)) / 2
    return np.stack([middle - half * direction, middle + half * direction], axis=1)


def _pairs(owner: IntArray) -> IntArray:
    rows = np.flatnonzero(owner >= 0)
    return np.column_stack([rows, owner[rows]])


__all__ = ["SyntheticScene", "corridor", "holistic"]
