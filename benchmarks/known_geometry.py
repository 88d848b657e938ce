# SPDX-License-Identifier: BSD-3-Clause
"""Gravity, heights, distances, poses with covariance, held cameras: are predicted errors those that occur?

    python benchmarks/known_geometry.py --data DATA [--draws 30]
    python benchmarks/known_geometry.py --landmarks [--draws 30]
    python benchmarks/known_geometry.py --skew [--draws 30]

Cameras, points and who sees what are those of castle-P30 (``measurements.py castle``); pixels (0.3 px) and
measurements are drawn anew each time. The squared error of a camera in units of its covariance is 3 on average if the
covariance is right. Then the wrong phones (gravity 2 to 10 degrees off) that the test names, and the right ones.

``--landmarks``: made blocks of twenty cameras with points, lines and planes, three positions, ten distances (5 mm) of
cameras from lines and planes, and those of planes that are parallel. Then one of the distances has an error: the share
that the test finds, against the power that theory gives for its redundancy.

``--skew``: the same blocks with three positions and the shortest distances of eight pairs of lines that are far from
parallel (5 mm).
"""

import argparse
from pathlib import Path

import numpy as np
from measurements import PIXEL, projected, spread, with_control, with_positions
from scipy.stats import norm

import groma
from groma.adjustment.survey.records import GATES
from groma.adjustment.survey.reliability import reliability
from groma.adjustment.terms.objects import rows_by_kind
from groma.geometry import quaternion, se3
from groma.geometry.incidence import closest_points
from groma.io import read_scene
from groma.scene import CameraPoses, Distances, Held, KnownDirections, KnownPlanes, Scene
from groma.scene.survey import UNKNOWN, Kind
from groma.scene.synthetic.scenes import holistic

#: Standard deviations: gravity (degrees), heights, distances, and of poses (position, degrees).
GRAVITY, HEIGHT, DISTANCE, POSE = 0.5, 0.01, 0.005, (0.02, 0.3)
DOWN = np.array([0.0, 0.0, -1.0])


def with_gravity(scene: Scene, rng: np.random.Generator, wrong: dict[int, float]) -> Scene:
    """Return the scene with gravity in every camera; of some it is so many degrees off."""
    count = scene.num_images
    seen = quaternion.rotate(scene.cam_from_world[:, :4], np.tile(DOWN, (count, 1)))
    turns = rng.normal(size=(count, 3)) * np.radians(GRAVITY)
    for row, degrees in wrong.items():
        across = np.cross(seen[row], rng.normal(size=3))
        turns[row] += np.radians(degrees) * across / np.linalg.norm(across)
    seen = quaternion.rotate(quaternion.exp(turns), seen)
    every = np.arange(count)
    table = KnownDirections(every * 0, every, np.tile(DOWN, (count, 1)), seen, np.full(count, np.radians(GRAVITY)))
    return scene.replace(known_directions=table)


def with_heights(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene with measured heights of all cameras."""
    every, height = np.arange(scene.num_images), scene.cam_centers_in_world[:, 2]
    measured = height + rng.normal(size=len(every)) * HEIGHT
    hesse = np.column_stack([np.tile([0.0, 0.0, 1.0], (len(every), 1)), -measured])
    anchors = np.zeros((len(every), 3))
    return scene.replace(known_planes=KnownPlanes(every * 0, every, anchors, hesse, np.full(len(every), HEIGHT)))


def with_distances(scene: Scene, true: np.ndarray, rng: np.random.Generator) -> Scene:
    """Return the scene with distances of ten cameras from a control point, and between two control points."""
    cameras = np.linspace(0, scene.num_images - 1, 10).astype(int)
    apart = np.linalg.norm(scene.cam_centers_in_world[cameras] - true[0], axis=1)
    numbers = np.append(apart, np.linalg.norm(true[1] - true[0])) + rng.normal(size=11) * DISTANCE
    kinds = np.append(np.full(10, Kind.IMAGE), Kind.CONTROL_POINT), np.full(11, Kind.CONTROL_POINT)
    ends = np.append(cameras, 0), np.append(np.zeros(10, int), 1)
    sigma = np.full(11, DISTANCE)
    return scene.replace(distances=Distances(kinds[0], ends[0], kinds[1], ends[1], np.zeros((11, 3)), numbers, sigma))


def with_poses(scene: Scene, rng: np.random.Generator) -> Scene:
    """Return the scene with measured poses whose six errors depend on each other."""
    count = scene.num_images
    root = (np.eye(6) + 0.4 * np.triu(np.ones((6, 6)), 1)) * np.repeat([POSE[0], np.radians(POSE[1])], 3)[:, None]
    errors = se3.exp(rng.normal(size=(count, 6)) @ root.T)
    poses = se3.compose(se3.inverse(errors), scene.cam_from_world)
    return scene.replace(camera_poses=CameraPoses(np.arange(count), poses, np.tile(root @ root.T, (count, 1, 1))))


def drawn_scenes(truth: Scene, drawn: Scene, rng: np.random.Generator) -> dict[str, Scene]:
    """Return one draw of every scene: what holds its frame, and what else was measured."""
    chosen = spread(truth, 2)
    placed = with_positions(with_control(drawn, rng, chosen, [UNKNOWN] * 2, 1.0), rng)
    few = placed.replace(camera_positions=placed.camera_positions.take([0, 10, 20]))
    known = with_distances(with_heights(with_gravity(few, rng, {}), rng), truth.points.xyz[chosen], rng)
    far = int(np.argmax(np.linalg.norm(truth.cam_centers_in_world - truth.cam_centers_in_world[0], axis=1)))
    return {
        "3 positions": few,
        "3 positions, gravity, heights, distances": known,
        "poses with covariance": with_poses(drawn, rng),
        "two cameras held": drawn.replace(held=Held([0, 0], [0, far])),
    }


def with_landmark_distances(scene: Scene, centers: np.ndarray, rng: np.random.Generator) -> Scene:
    """Return the scene with distances of its true lines and planes: of cameras, and of planes that are parallel."""
    ends, normals, offsets = scene.lines.segments, scene.planes.hesse[:, :3], scene.planes.hesse[:, 3]
    along = (ends[:, 1] - ends[:, 0]) / np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1, keepdims=True)
    rows = []
    for k, (line, plane) in enumerate(
        zip(rng.permutation(scene.num_lines)[:5], rng.integers(len(normals), size=5), strict=True)
    ):
        apart = centers[k] - ends[line, 0]
        rows.append((Kind.IMAGE, k, Kind.LINE, line, np.zeros(3), np.linalg.norm(np.cross(apart, along[line]))))
        high = abs(normals[plane] @ centers[k + 5] + offsets[plane])
        rows.append((Kind.IMAGE, k + 5, Kind.PLANE, plane, np.zeros(3), high))
    for first in range(len(normals)):
        for second in range(first + 1, len(normals)):
            if abs(normals[first] @ normals[second]) > 1.0 - 1e-9:
                on = scene.points.xyz[scene.relations.point_on_plane[scene.relations.point_on_plane[:, 1] == first, 0]]
                place = on.mean(axis=0)
                apart = abs(normals[second] @ place + offsets[second])
                rows.append((Kind.PLANE, first, Kind.PLANE, second, place, apart))
    first, one, second, other, places, lengths = (np.array(column) for column in zip(*rows, strict=True))
    measured = lengths + rng.normal(size=len(lengths)) * DISTANCE
    table = Distances(first, one, second, other, places, measured, np.full(len(lengths), DISTANCE))
    return scene.replace(distances=table)


def skew(draws: int) -> None:
    """Print predicted against actual errors with shortest distances of lines that are far from parallel."""
    told = groma.AdjustOptions(
        loss="none", point_sigma_px=0.5, line_sigma_px=0.5, structure_sigma_px=0.02, check_lens=False
    )
    rows: dict[str, list[tuple[float, ...]]] = {"3 positions": [], "with distances": []}
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        made = holistic(20, noise_px=0.5, seed=draw)
        placed = with_positions(made.truth, rng)
        few = placed.replace(camera_positions=placed.camera_positions.take([0, 7, 14]))
        pairs = closest_points(few.lines.plucker[:, None], few.lines.plucker)
        good = np.argwhere(np.triu((pairs.sine > 0.3) & (pairs.distance > 0.1)))
        first, second = good[rng.permutation(len(good))[:8]].T
        apart = pairs.distance[first, second] + rng.normal(size=len(first)) * DISTANCE
        kinds, sigma = np.full(len(first), Kind.LINE), np.full(len(first), DISTANCE)
        every = np.ones(len(first), bool)
        table = Distances(kinds, first, kinds, second, np.zeros((len(first), 3)), apart, sigma, is_shortest=every)
        true = made.truth.cam_centers_in_world
        for name, scene in (("3 positions", few), ("with distances", few.replace(distances=table))):
            result = groma.adjust(scene, told)
            centers, off = result.uncertainty().centers, result.scene.cam_centers_in_world - true
            squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(centers), off)
            tests = reliability(result.scene, result.problem).measurements
            size = [one.normalized**2 for one in tests if one.kind == "distance" and one.normalized is not None]
            sigma_of = np.trace(centers, axis1=1, axis2=2).mean()
            rows[name].append((squares.mean(), (off**2).sum(axis=1).mean(), sigma_of, np.mean(size or [np.nan])))
    for name, values in rows.items():
        ratio, off, sigma, size = np.mean(values, axis=0)
        print(
            f"{name}: NEES {ratio:.2f} (3), rms error {1e3 * off**0.5:.1f}, predicted {1e3 * sigma**0.5:.1f}, "
            f"squared normalised residuals {size:.2f} (1)"
        )


def landmarks(draws: int) -> None:
    """Print predicted against actual errors with distances of lines and planes, and gross errors found."""
    told = groma.AdjustOptions(
        loss="none", point_sigma_px=0.5, line_sigma_px=0.5, structure_sigma_px=0.02, check_lens=False
    )
    sizes, limit = np.array([0.0, 4.0, 5.0, 6.0, 8.0]), norm.isf(GATES.level / 2)
    found, theory, rows = np.zeros(len(sizes)), np.zeros(len(sizes)), {"3 positions": [], "with distances": []}
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        made = holistic(20, noise_px=0.5, seed=draw)
        true = made.truth.cam_centers_in_world
        placed = with_positions(made.truth, rng)
        few = placed.replace(camera_positions=placed.camera_positions.take([0, 7, 14]))
        known = with_landmark_distances(few, true, rng)
        for name, scene in (("3 positions", few), ("with distances", known)):
            result = groma.adjust(scene, told)
            centers, off = result.uncertainty().centers, result.scene.cam_centers_in_world - true
            squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(centers), off)
            sigma = np.trace(centers, axis1=1, axis2=2).mean()
            rows[name].append((squares.mean(), (off**2).sum(axis=1).mean(), sigma))
        wrong, table = int(rng.integers(len(known.distances))), known.distances
        groups = rows_by_kind(("frames", "lines", "planes"), table.first_kind, table.second_kind)
        order = [row for _, rows_ in groups for row in rows_.tolist()]
        for k, size in enumerate(sizes):
            distance = known.distances.distance.copy()
            distance[wrong] += size * DISTANCE
            result = groma.adjust(known.replace(distances=known.distances.replace(distance=distance)), told)
            tests = [one for one in reliability(result.scene, result.problem).measurements if one.kind == "distance"]
            one = tests[order.index(wrong)]
            mean = size * np.sqrt(one.redundancy)
            found[k] += one.is_suspect
            theory[k] += norm.sf(limit - mean) + norm.cdf(-limit - mean)
    for name, values in rows.items():
        ratio, off, sigma = np.mean(values, axis=0)
        print(f"{name}: NEES {ratio:.2f} (3), rms error {1e3 * off**0.5:.1f}, predicted {1e3 * sigma**0.5:.1f}")
    print("size/sigma  found  theory")
    for row in zip(sizes, found / draws, theory / draws, strict=True):
        print("{:10.1f}  {:5.2f}  {:6.3f}".format(*row))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--points", type=int, default=2000, help="points of the castle that take part")
    parser.add_argument("--landmarks", action="store_true", help="distances of lines and planes, in made blocks")
    parser.add_argument("--skew", action="store_true", help="shortest distances of lines, in made blocks")
    arguments = parser.parse_args()
    if arguments.skew:
        skew(arguments.draws)
        return
    if arguments.landmarks:
        landmarks(arguments.draws)
        return
    truth = read_scene(arguments.data / "strecha_castle_p30" / "sparse_gt")
    thinned = np.random.default_rng(0).permutation(truth.num_points) < arguments.points
    truth = truth.keep(points=thinned).replace(keypoints=type(truth.keypoints)())
    exact, table = projected(truth), truth.point_observations
    options = groma.AdjustOptions(loss="none", point_sigma_px=PIXEL, check_lens=False)
    rows: dict[str, list[tuple[float, float, float]]] = {}
    named, blamed = {2: 0, 4: 0, 10: 0}, 0
    for draw in range(arguments.draws):
        rng = np.random.default_rng(draw)
        drawn = truth.replace(point_observations=table.replace(pixel=exact + rng.normal(size=exact.shape) * PIXEL))
        for name, scene in drawn_scenes(truth, drawn, rng).items():
            result = groma.adjust(scene, options)
            found = result.uncertainty()
            free = np.trace(found.centers, axis1=1, axis2=2) > 0.0
            off = (result.scene.cam_centers_in_world - truth.cam_centers_in_world)[free]
            squares = np.einsum("ni,nij,nj->n", off, np.linalg.inv(found.centers[free]), off)
            sizes = (off**2).sum(axis=1).mean(), np.trace(found.centers[free], axis1=1, axis2=2).mean()
            rows.setdefault(name, []).append((squares.mean(), *sizes))
        wrong = dict(zip(rng.choice(truth.num_images, 3, replace=False).tolist(), named, strict=True))
        result = groma.adjust(with_gravity(with_positions(drawn, rng), rng, wrong), options)
        tests = reliability(result.scene, result.problem).suspects
        suspects = {one.name for one in tests if one.kind == "known direction"}
        for row, degrees in wrong.items():
            named[degrees] += truth.images.names[row] in suspects
        blamed += len(suspects - {truth.images.names[row] for row in wrong})
    for name, values in rows.items():
        ratio, off, sigma = np.mean(values, axis=0)
        rms, predicted = 1e3 * np.sqrt([off, sigma])
        print(f"{name}: NEES {ratio:.2f} (3), rms error {rms:.1f} mm, predicted {predicted:.1f} mm")
    print(f"wrong phones named, by degrees: {named} of {arguments.draws}; right ones blamed: {blamed}")


if __name__ == "__main__":
    main()
