# SPDX-License-Identifier: BSD-3-Clause
r"""Scenes for the test of covariances: all noise is of known size, that of the relations included.

A relation is a measurement of zero: a point *is* on a plane, up to a noise. So that the errors of an adjustment can be
predicted, the truth itself must miss its relations by exactly that noise, independently for every relation. Points and
lines are therefore moved off what they lie on, in an order in which nothing is moved twice: planes stay, lines leave
their plane or turn away from their direction, points leave their line, and points on no line their plane.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.terms.relations import lengths_per_pixel
from groma.scene import Scene
from groma.scene.landmarks import Directions, Lines
from groma.scene.observations import Relations
from groma.scene.synthetic.noise import project_pinhole
from groma.scene.synthetic.scenes import NEAR, holistic

#: How well landmarks keep to what they lie on, as a length in the images, pixels.
STRUCTURE_SIGMA_PX = 0.1
#: Directions that the lines on no plane run along, and the longest that these lines are.
NUM_DIRECTIONS, LONGEST = 2, 1.5


def drawn(num_images: int, noise_px: float, rng: np.random.Generator, relations: bool) -> Scene:
    """Return a true scene measured with noise, with relations that hold up to their own noise, or without any."""
    scene = holistic(num_images, int(rng.integers(2**31)), noise_px=0.0).truth
    scene = _related(scene, rng) if relations else scene.replace(relations=Relations())
    params, poses = scene.cameras.params[0, :4], scene.cam_from_world
    seen, table = scene.point_observations, scene.line_observations
    pixel, depth = project_pinhole(params, poses[seen.image_idx], scene.points.xyz[seen.point_idx])
    ends = scene.lines.segments[table.line_idx]
    first, second = (project_pinhole(params, poses[table.image_idx], ends[:, k]) for k in (0, 1))
    segment, least = np.hstack([first[0], second[0]]), np.minimum(first[1], second[1])
    measured = scene.replace(
        point_observations=seen.replace(pixel=pixel + rng.normal(0, noise_px, pixel.shape)),
        line_observations=table.replace(segment=segment + rng.normal(0, noise_px, segment.shape)),
    )
    return measured.replace(
        point_observations=measured.point_observations.take(np.flatnonzero(depth > NEAR)),
        line_observations=measured.line_observations.take(np.flatnonzero(least > NEAR)),
    )


def _related(scene: Scene, rng: np.random.Generator) -> Scene:
    """Give directions to the lines on no plane, and move everything by the noise of its relations."""
    on_plane, on_line = scene.relations.line_on_plane, scene.relations.point_on_line
    loose = np.setdiff1d(np.arange(scene.num_lines), on_plane[:, 0])
    vectors = rng.normal(size=(NUM_DIRECTIONS, 3))
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    along = np.column_stack([loose, np.arange(len(loose)) % NUM_DIRECTIONS])
    in_plane = np.setdiff1d(np.arange(scene.num_points), on_line[:, 0])
    rest = scene.relations.point_on_plane[np.isin(scene.relations.point_on_plane[:, 0], in_plane)]

    old = scene.lines.segments
    ends = _turned_to(old, loose, vectors[along[:, 1]])
    xyz = _carried(scene.points.xyz, on_line, old, ends)
    exact = scene.replace(
        points=scene.points.replace(xyz=xyz),
        lines=Lines.through(ends),
        directions=Directions(np.arange(1, NUM_DIRECTIONS + 1), vectors),
        relations=Relations(
            point_on_plane=rest, line_on_plane=on_plane, line_along_direction=along, point_on_line=on_line
        ),
    )
    per_line = STRUCTURE_SIGMA_PX * lengths_per_pixel(exact, "line")
    per_point = STRUCTURE_SIGMA_PX * lengths_per_pixel(exact, "point")

    # lines leave their planes by their ends, and turn away from their directions
    moved, normal = ends.copy(), scene.planes.hesse[:, :3]
    line, plane = on_plane.T
    moved[line] += (per_line[line, None] * rng.normal(size=(len(line), 2)))[:, :, None] * normal[plane][:, None]
    half = 0.5 * (ends[loose, 1] - ends[loose, 0])
    turn = _across(half, rng) * per_line[loose, None]
    moved[loose] += np.stack([-turn, turn], axis=1)
    # points leave their lines, or their planes
    xyz = _carried(xyz, on_line, ends, moved)
    point, line = on_line.T
    xyz[point] += _across(moved[line, 1] - moved[line, 0], rng) * per_point[point, None]
    point, plane = rest.T
    xyz[point] += (per_point[point] * rng.normal(size=len(point)))[:, None] * normal[plane]
    return exact.replace(points=exact.points.replace(xyz=xyz), lines=Lines.through(moved))


def _turned_to(segments: FloatArray, chosen: IntArray, vectors: FloatArray) -> FloatArray:
    """Return segments of which the chosen ones have a new direction, about their middle."""
    result = segments.copy()
    middle = segments[chosen].mean(axis=1)
    length = np.linalg.norm(segments[chosen, 1] - segments[chosen, 0], axis=1)
    half = 0.5 * np.minimum(length, LONGEST)[:, None] * vectors
    result[chosen] = np.stack([middle - half, middle + half], axis=1)
    return result


def _carried(xyz: FloatArray, on_line: IntArray, before: FloatArray, after: FloatArray) -> FloatArray:
    """Return points that keep their place along their line when it moves."""
    result = xyz.copy()
    point, line = on_line.T
    along = before[line, 1] - before[line, 0]
    share = np.einsum("ni,ni->n", xyz[point] - before[line, 0], along) / np.einsum("ni,ni->n", along, along)
    result[point] = after[line, 0] + share[:, None] * (after[line, 1] - after[line, 0])
    return result


def _across(vectors: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return normal random vectors (n, 3) of unit variance in the two directions across the given ones."""
    unit = vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    noise = rng.normal(size=unit.shape)
    return noise - np.einsum("ni,ni->n", noise, unit)[:, None] * unit
