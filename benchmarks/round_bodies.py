# SPDX-License-Identifier: BSD-3-Clause
"""Planes found in points on surfaces of known form: round bodies have none, walls have one.

    python benchmarks/round_bodies.py [--seeds 0 1 2] [--turned DEG ...] [--tilt DEG ...]

Points are drawn on each surface and seen by held cameras with 0.4 pixels of noise; they are triangulated, and planes
are searched. Printed are the numbers of planes by seed, and the share of the points on them. Several values of
``--turned`` (how much quarters of a plane may be turned) and ``--tilt`` (how well a normal must be known) give a column
for each pair.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from itertools import product

import numpy as np

from groma.adjustment.assemble import assemble, disassemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.geometry import quaternion, se3
from groma.mapping.structure import find
from groma.mapping.structure.bending import BendingGates, bending
from groma.scene import Cameras, PointObservations, Points, Scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

NOISE, FOCAL, SIZE = 0.4, 900.0, (960, 720)
Surface = Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]


def waves(rng: np.random.Generator, places: np.ndarray, size: float, length: float) -> np.ndarray:
    """Heights of a rough surface at places (N, 3): the sum of thirty waves of about this length, root mean square."""
    of = rng.normal(size=(30, 3)) * 2.0 * np.pi / length
    return size * np.sqrt(2.0 / 30.0) * np.sin(places @ of.T + rng.uniform(0.0, 2.0 * np.pi, 30)).sum(axis=1)


def body(count: int, axes: tuple[float, float, float], rough: float = 0.0, length: float = 1.0) -> Surface:
    """An ellipsoid, or one with bumps; points and outward normals of the smooth one."""

    def drawn(rng):
        unit = rng.normal(size=(count, 3))
        unit /= np.linalg.norm(unit, axis=1, keepdims=True)
        normals = unit / axes
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        places = unit * axes
        return places + waves(rng, places, rough, length)[:, None] * normals, normals

    return drawn


def column(count: int, radius: float, rough: float = 0.0, length: float = 1.0) -> Surface:
    """A cylinder that is three units high, or a trunk."""

    def drawn(rng):
        angle = rng.uniform(0.0, 2.0 * np.pi, count)
        normals = np.stack([np.cos(angle), np.sin(angle), np.zeros(count)], axis=1)
        places = radius * normals + np.outer(rng.uniform(-1.5, 1.5, count), [0.0, 0.0, 1.0])
        return places + waves(rng, places, rough, length)[:, None] * normals, normals

    return drawn


def wall(count: int, bend: float = 0.0, rough: float = 0.0, length: float = 0.1, steps: float = 0.0) -> Surface:
    """A wall of four by three units: bent by an arc of this height, rough, or of panels a unit wide."""

    def drawn(rng):
        x, z = rng.uniform(-2.0, 2.0, count), rng.uniform(-1.5, 1.5, count)
        panel = rng.normal(0.0, 1.0, (4, 3))[np.int64(x + 2.0), np.int64(z + 1.5)]
        flat = np.stack([x, np.zeros(count), z], axis=1)
        away = bend * (1.0 - (x / 2.0) ** 2) + waves(rng, flat, rough, length) + steps * panel
        return flat - np.outer(away, [0.0, 1.0, 0.0]), np.tile([0.0, -1.0, 0.0], (count, 1))

    return drawn


ROUND: dict[str, Surface] = {
    "ball": body(2000, (1.0, 1.0, 1.0)),
    "egg": body(2000, (1.0, 1.0, 1.4)),
    "column": column(3000, 0.5),
    "column, sparse": column(300, 0.5),
    "column, wide": column(5000, 1.2),
    "trunk": column(3000, 0.5, 0.02, 0.5),
    "trunk, fine bark": column(3000, 0.5, 0.01, 0.1),
    "bumpy": body(2000, (1.0, 0.8, 1.2), 0.03, 0.5),
    "bumpy, fine": body(2000, (1.0, 0.8, 1.2), 0.01, 0.1),
}
WALLS: dict[str, Surface] = {
    "flat": wall(2000),
    "rough": wall(2000, rough=0.003),
    "rougher": wall(2000, rough=0.006),
    "as rough as stone": wall(2000, rough=0.01),
    "as rough as rubble": wall(2000, rough=0.022),
    "panels": wall(2000, steps=0.003),
    "bent by 0.01": wall(2000, bend=0.01),
    "bent by 0.03": wall(2000, bend=0.03),
    "bent by 0.1": wall(2000, bend=0.1),
    "bent by 0.3": wall(2000, bend=0.3),
}


def seen(surface: Surface, around: bool, seed: int) -> Scene:
    """Points of a surface, triangulated from images with noise by cameras around it, or before it."""
    rng = np.random.default_rng(seed)
    places, normals = surface(rng)
    angle = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False) if around else np.linspace(-2.2, -0.9, 14)
    centers = 6.0 * np.stack([np.cos(angle), np.sin(angle), 0.25 * np.sin(3.0 * angle)], axis=1)
    poses = se3.looking_at(centers, np.zeros(3))
    image, point, pixel = [], [], []
    for row, pose in enumerate(poses):
        in_cam = quaternion.rotate(pose[:4], places) + pose[4:]
        at = FOCAL * in_cam[:, :2] / in_cam[:, 2:] + np.array(SIZE) / 2.0
        toward = np.einsum("ni,ni->n", normals, centers[row] - places) / np.linalg.norm(centers[row] - places, axis=1)
        shown = np.flatnonzero((toward > 0.3) & (at > 0.0).all(axis=1) & (at < SIZE).all(axis=1))
        image.append(np.full(len(shown), row))
        point.append(shown)
        pixel.append(at[shown] + rng.normal(0.0, NOISE, (len(shown), 2)))
    images, points = np.concatenate(image), np.concatenate(point)
    known, points = np.unique(points, return_inverse=True)
    camera = Cameras(
        np.ones(1, int), ("SIMPLE_PINHOLE",), np.array([[FOCAL, *np.array(SIZE) / 2.0]]), *np.array(SIZE)[:, None]
    )
    tables = {
        "points": Points.at(places[known]),
        "point_observations": PointObservations(images, points, np.concatenate(pixel), np.arange(len(images))),
    }
    names, none = [f"{row}.png" for row in range(len(poses))], np.zeros(len(poses), int)
    scene = Scene.from_images(camera, names, none, poses, **tables)
    problem = assemble(scene, AssemblyOptions(refine_poses=False)).problem
    return disassemble(scene, solve(problem, SolverOptions(max_iterations=15)).problem)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--turned", type=float, nargs="+", default=[np.rad2deg(BendingGates().turned)])
    parser.add_argument("--tilt", type=float, nargs="+", default=[np.rad2deg(find.StructureOptions().planes.max_tilt)])
    arguments = parser.parse_args()
    settings = list(product(arguments.turned, arguments.tilt))
    print("| surface |" + "".join(f" turned {turned:.1f}°, tilt {tilt:.1f}° |" for turned, tilt in settings))
    print("|---|" + "---|" * len(settings))
    for around, group in ((True, ROUND), (False, WALLS)):
        for name, surface in group.items():
            scenes = [seen(surface, around, seed) for seed in arguments.seeds]
            print(f"| {name} |" + "".join(f" {counted(scenes, *one)} |" for one in settings), flush=True)


def counted(scenes: list[Scene], turned: float, tilt: float) -> str:
    """Numbers of planes in scenes, and share of the points on them."""
    gates, usual = BendingGates(turned=np.deg2rad(turned)), find.StructureOptions()
    options = replace(usual, planes=replace(usual.planes, max_tilt=np.deg2rad(tilt)))
    find.bending = lambda *given: bending(*given, gates)
    found = [find.find_structure(scene, options) for scene in scenes]
    share = np.mean([len(one.relations.point_on_plane) / one.num_points for one in found])
    return f"{' '.join(str(one.num_planes) for one in found)}; {100.0 * share:.0f} %"


if __name__ == "__main__":
    main()
