# SPDX-License-Identifier: BSD-3-Clause
"""Measurements of other instruments: are predicted errors right, are gross errors found, is it exact in UTM?

    python benchmarks/measurements.py castle --data DATA [--draws 50]
    python benchmarks/measurements.py photographs --data DATA
    python benchmarks/measurements.py one-map --data DATA [--draws 50]
    python benchmarks/measurements.py detection [--blocks 60]
    python benchmarks/measurements.py utm [--images 1000]
    python benchmarks/measurements.py picture --data DATA --picture docs/images/measurements.svg

``castle``: cameras, points and who sees what are those of castle-P30, so the geometry is real and the truth exact;
pixels (0.3 px) and measurements are drawn anew each time. Positions (2 cm), then four control and two check points,
then one scale bar: squared errors of the cameras in units of their covariance (NEES, 3 a camera), of the check points,
and of the distance between the first camera and the one farthest from it (1).
``photographs``: the photographs themselves, their poses by pycolmap, positions of the survey with 2 cm of noise, one of
them 0.3 m off. ``one-map``: the photographs' own map, in the frame of the survey, is the truth; positions of it
are drawn with 2 cm, in every fifth draw once more with one of them 0.3 m off: what comes from positions is seen, what
comes from pixels is in the truth, too. ``detection``: gross errors of many sizes in one position of made blocks; the
share that the test finds, against the power that theory gives for the redundancy of that position. ``utm``: a block
flown over a town, with positions and control points, in coordinates of UTM and at the origin.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.stats import norm

import groma
from groma.adjustment.survey.given import Survey
from groma.adjustment.survey.records import GATES
from groma.adjustment.survey.reliability import reliability
from groma.geometry import quaternion
from groma.io import read_scene
from groma.io.survey import CoordinateSystem, Places
from groma.mapping.noise.weighted import weighted
from groma.mapping.surveyed import adjust_surveyed
from groma.scene import (
    CameraPositions,
    Cameras,
    ControlPoints,
    Distances,
    Marks,
    PointObservations,
    Points,
    Scene,
    Similarity,
)
from groma.scene.survey import CHECK, CONTROL, UNKNOWN, Kind, diagonal_covariance
from groma.scene.synthetic import holistic
from groma.scene.synthetic.noise import project_pinhole
from groma.solver.covariance.marginals import Covariances
from groma.solver.covariance.quantities import distance_between_cameras

PIXEL, POSITION, BAR = 0.3, 0.02, 0.002
UTM = np.array([468_000.0, 5_427_000.0, 310.0])


def projected(scene: Scene) -> np.ndarray:
    """Pixels of the point observations without noise."""
    table = scene.point_observations
    poses = scene.cam_from_world[table.image_idx]
    return project_pinhole(scene.cameras.params[0], poses, scene.points.xyz[table.point_idx])[0]


def with_positions(scene: Scene, rng: np.random.Generator, sigma: float = POSITION) -> Scene:
    """Return the scene with measured positions of all cameras."""
    xyz = scene.cam_centers_in_world + rng.normal(size=(scene.num_images, 3)) * sigma
    every = np.arange(scene.num_images)
    return scene.replace(camera_positions=CameraPositions(every, xyz, diagonal_covariance(np.full(xyz.shape, sigma))))


def with_control(truth: Scene, rng: np.random.Generator, chosen: np.ndarray, roles: list[int], sigma: float) -> Scene:
    """Return the scene with some of its points as control points: measured in the world and marked in the images."""
    table, xyz = truth.point_observations, truth.points.xyz[chosen]
    measured = xyz + rng.normal(size=xyz.shape) * sigma
    position = np.full(truth.num_points, -1)
    position[chosen] = np.arange(len(chosen))
    rows = np.flatnonzero(position[table.point_idx] >= 0)
    pixel = projected(truth)[rows] + rng.normal(size=(len(rows), 2)) * PIXEL
    covariance = diagonal_covariance(np.full(xyz.shape, sigma))
    names = tuple(f"target {k}" for k in range(len(chosen)))
    return truth.replace(
        control_points=ControlPoints(names, measured, measured, covariance, np.array(roles)),
        marks=Marks(table.image_idx[rows], position[table.point_idx[rows]], pixel, np.full(len(rows), PIXEL)),
    ).keep(points=position < 0)


def spread(scene: Scene, count: int) -> np.ndarray:
    """Points seen by many images, far from each other."""
    seen = np.bincount(scene.point_observations.point_idx, minlength=scene.num_points)
    good = np.flatnonzero(seen >= np.percentile(seen, 95))
    found = [int(good[0])]
    while len(found) < count:
        far = np.min(np.linalg.norm(scene.points.xyz[good][:, None] - scene.points.xyz[found], axis=2), axis=1)
        found.append(int(good[np.argmax(far)]))
    return np.array(found)


def nees(scene: Scene, truth: Scene, covariance: np.ndarray) -> float:
    """Mean squared error of the camera centres in units of their covariance."""
    off = scene.cam_centers_in_world - truth.cam_centers_in_world
    return float(np.einsum("ni,nij,nj->n", off, np.linalg.inv(covariance), off).mean())


def castle(arguments: argparse.Namespace) -> None:
    """Predicted against actual errors on the geometry of castle-P30."""
    truth = read_scene(arguments.data / "strecha_castle_p30" / "sparse_gt")
    thinned = np.random.default_rng(0).permutation(truth.num_points) < arguments.points
    truth = truth.keep(points=thinned).replace(keypoints=type(truth.keypoints)())
    exact, rows = projected(truth), {"positions": [], "control": []}
    checks, bars, options = [], [], groma.AdjustOptions(loss="none", point_sigma_px=PIXEL, check_lens=False)
    chosen = spread(truth, 6)
    for draw in range(arguments.draws):
        rng = np.random.default_rng(draw)
        table = truth.point_observations
        drawn = truth.replace(point_observations=table.replace(pixel=exact + rng.normal(size=exact.shape) * PIXEL))
        scenes = {
            "positions": with_positions(drawn, rng),
            "control": with_control(drawn, rng, chosen, [CONTROL] * 4 + [CHECK] * 2, POSITION),
            "scale bar": with_bar(drawn, rng, chosen),
        }
        for name, scene in scenes.items():
            result = groma.adjust(scene, options)
            off = result.scene.cam_centers_in_world - truth.cam_centers_in_world
            if name == "scale bar":
                bars.append(normalized_distance(result, truth))
                continue
            found = result.uncertainty()
            sigma = np.sqrt(np.trace(found.centers, axis1=1, axis2=2).mean())
            rows[name].append(
                (nees(result.scene, truth, found.centers), float(np.sqrt((off**2).sum(axis=1).mean())), float(sigma))
            )
            if name == "control":
                checks += [one.normalized_square for one in reliability(result.scene, result.problem).check_points]
    for name in ("positions", "control"):
        ratio, rms, sigma = np.mean(rows[name], axis=0)
        print(f"{name}: NEES {ratio:.2f} (3), rms error {1e3 * rms:.2f} mm, predicted {1e3 * sigma:.2f} mm")
    print(f"check points: mean square {np.mean(checks):.2f} (3) of {len(checks)}")
    print(f"scale bar: mean square {np.mean(bars):.2f} (1) of {len(bars)} distances")


def with_bar(scene: Scene, rng: np.random.Generator, chosen: np.ndarray) -> Scene:
    """Return the scene with one measured distance between two marked points."""
    marked = with_control(scene, rng, chosen[:2], [UNKNOWN] * 2, POSITION)
    length = np.linalg.norm(np.subtract(*scene.points.xyz[chosen[:2]])) + rng.normal() * BAR
    return marked.replace(distances=Distances.between(Kind.CONTROL_POINT, [0], [1], [length], [BAR]))


def normalized_distance(result: groma.AdjustResult, truth: Scene) -> float:
    """Squared error of a distance between two cameras in units of its variance."""
    centers = truth.cam_centers_in_world
    far = int(np.argmax(np.linalg.norm(centers - centers[0], axis=1)))
    found = distance_between_cameras(Covariances(result.problem, gauge="inner"), ("frames", 0), ("frames", far))
    return float((found.value - np.linalg.norm(centers[far] - centers[0])) / found.sigma) ** 2


def photographs(arguments: argparse.Namespace) -> dict:
    """The photographs of castle-P30, with positions of the survey, one of them wrong."""
    folder = arguments.data / "strecha_castle_p30"
    scene, survey = read_scene(folder / "sparse_inc"), read_scene(folder / "sparse_gt")
    row = {name: k for k, name in enumerate(survey.images.names)}
    true = survey.cam_centers_in_world[[row[name] for name in scene.images.names]]
    before, after, found, told = [], [], 0, None
    for draw in range(arguments.draws):
        rng = np.random.default_rng(draw)
        xyz = true + rng.normal(size=true.shape) * POSITION
        wrong = int(rng.integers(len(xyz)))
        direction = rng.normal(size=3)
        xyz[wrong] += 0.3 * direction / np.linalg.norm(direction)
        given = Places(scene.images.names, xyz, np.full(xyz.shape, POSITION), CoordinateSystem(), "positions")
        told = adjust_surveyed(scene, Survey(positions=given))
        first = told.surveyed.scene.cam_centers_in_world - true
        last = told.result.scene.cam_centers_in_world - true
        before.append(np.sqrt((first**2).sum(axis=1).mean()))
        after.append(np.sqrt((last**2).sum(axis=1).mean()))
        found += told.reliability.suspects[:1] != () and told.reliability.suspects[0].name == scene.images.names[wrong]
    own = groma.adjust(survey, groma.AdjustOptions(point_sigma_px=PIXEL)).scene
    bent = aligned_with_scale(own.cam_centers_in_world, survey.cam_centers_in_world)
    print(
        f"centres off by {1e3 * np.mean(before):.1f} mm after alignment, {1e3 * np.mean(after):.1f} mm after adjustment"
    )
    print(
        f"the survey and the photographs alone differ by {1e3 * bent:.1f} mm; wrong position named first: {found} of "
        f"{arguments.draws}"
    )
    return {"told": told, "true": true}


def one_map(arguments: argparse.Namespace) -> None:
    """Predicted against actual errors of positions on photographs, from one map."""
    folder = arguments.data / "strecha_castle_p30"
    found = read_scene(folder / "sparse_inc")
    found = found.keep(points=np.random.default_rng(0).permutation(found.num_points) < arguments.points)
    alone = groma.adjust(found).scene
    alone = groma.adjust(alone, weighted(alone, groma.AdjustOptions())).scene  # the weights that the draws will have
    truth = groma.align(alone, read_scene(folder / "sparse_gt")).scene
    true, rows, named, blamed = truth.cam_centers_in_world, {False: [], True: []}, 0, 0
    for draw in range(arguments.draws):
        rng = np.random.default_rng(draw)
        for wrong in (False, True)[: 1 + (draw % 5 == 0)]:
            xyz = true + rng.normal(size=true.shape) * POSITION
            row, direction = int(rng.integers(len(xyz))), rng.normal(size=3)
            xyz[row] += 0.3 * wrong * direction / np.linalg.norm(direction)
            given = Places(truth.images.names, xyz, np.full(xyz.shape, POSITION), CoordinateSystem(), "positions")
            told = adjust_surveyed(truth, Survey(positions=given))
            covariance, off = told.result.uncertainty().centers, told.result.scene.cam_centers_in_world - true
            sizes = (off**2).sum(axis=1).mean(), np.trace(covariance, axis1=1, axis2=2).mean()
            rows[wrong].append((nees(told.result.scene, truth, covariance), *sizes))
            rejected = {one.name for one in told.reliability.measurements if one.is_rejected}
            named += wrong and truth.images.names[row] in rejected
            blamed += len(rejected - ({truth.images.names[row]} if wrong else set()))
    for wrong, values in rows.items():
        ratio, off, sigma = np.mean(values, axis=0)
        words = "one position 0.3 m off" if wrong else "good positions"
        print(f"{words}: NEES {ratio:.2f} (3), rms error {1e3 * off**0.5:.2f} mm, predicted {1e3 * sigma**0.5:.2f} mm")
    print(f"taken out: {named} of {len(rows[True])} wrong ones, {blamed} good ones")


def aligned_with_scale(source: np.ndarray, target: np.ndarray) -> float:
    from groma.evaluation.alignment import align_points

    return float(np.sqrt(((align_points(source, target).points(source) - target) ** 2).sum(axis=1).mean()))


def detection(arguments: argparse.Namespace) -> None:
    """The share of gross errors found, by size, against theory."""
    sizes = np.array([0.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0])
    found, theory = np.zeros(len(sizes)), np.zeros(len(sizes))
    options = groma.AdjustOptions(loss="none", point_sigma_px=PIXEL, check_lens=False)
    limit = norm.isf(GATES.level / 2)
    for block in range(arguments.blocks):
        rng = np.random.default_rng(block)
        truth = holistic(8, noise_px=PIXEL, seed=block % 5).truth.points_only()
        pixel = projected(truth) + rng.normal(size=truth.point_observations.pixel.shape) * PIXEL
        measured = with_positions(truth.replace(point_observations=truth.point_observations.replace(pixel=pixel)), rng)
        camera, axis = int(rng.integers(8)), int(rng.integers(3))
        for k, size in enumerate(sizes):
            xyz = measured.camera_positions.xyz.copy()
            xyz[camera, axis] += size * POSITION
            result = groma.adjust(
                measured.replace(camera_positions=measured.camera_positions.replace(xyz=xyz)), options
            )
            one = reliability(result.scene, result.problem).measurements[3 * camera + axis]
            mean = size * np.sqrt(one.redundancy)
            found[k] += one.is_suspect
            theory[k] += norm.sf(limit - mean) + norm.cdf(-limit - mean)
    print("size/sigma  found  theory")
    for row in zip(sizes, found / arguments.blocks, theory / arguments.blocks, strict=True):
        print("{:10.1f}  {:5.2f}  {:6.3f}".format(*row))


def flight(images: int, seed: int = 0) -> Scene:
    """A block of vertical photographs over a town: 80 m high, 80 by 60 % overlap, houses of up to 20 m."""
    rng = np.random.default_rng(seed)
    columns = int(np.ceil(np.sqrt(images * 1.5)))
    k = np.arange(images)
    x, y = 16.0 * (k % columns), 24.0 * (k // columns)
    centers = np.column_stack([x, y, np.full(images, 80.0)]) + rng.normal(size=(images, 3)) * 0.5
    turn = quaternion.multiply(quaternion.exp(rng.normal(size=(images, 3)) * 0.03), np.array([[1.0, 0.0, 0.0, 0.0]]))
    poses = np.hstack([turn, -quaternion.rotate(turn, centers)])
    camera = Cameras(
        ids=[1], models=("PINHOLE",), width=[4000], height=[3000], params=np.array([[3200.0, 3200.0, 2000, 1500]])
    )
    ground = np.column_stack(
        [
            rng.uniform(-40, x.max() + 40, 25 * images),
            rng.uniform(-30, y.max() + 30, 25 * images),
            rng.uniform(0, 20, 25 * images),
        ]
    )
    image, point, pixel = [], [], []
    for row in range(images):
        near = np.flatnonzero(np.abs(ground[:, :2] - centers[row, :2]).max(axis=1) < 60)
        uv, depth = project_pinhole(camera.params[0], poses[row], ground[near])
        seen = (depth > 0) & (uv > 0).all(axis=1) & (uv < [4000, 3000]).all(axis=1)
        image.append(np.full(seen.sum(), row)), point.append(near[seen]), pixel.append(uv[seen])
    image, point, pixel = map(np.concatenate, (image, point, pixel))
    table = PointObservations.numbered(image, point, pixel + rng.normal(size=pixel.shape) * PIXEL)
    names = [f"{row:05d}.jpg" for row in range(images)]
    scene = Scene.from_images(
        camera, names, np.zeros(images, int), poses, points=Points.at(ground), point_observations=table
    )
    return scene.keep(points=np.bincount(point, minlength=len(ground)) >= 3)


def utm(arguments: argparse.Namespace) -> None:
    """A block with positions and control points at the origin and in UTM, and without them: cost, steps, CPU time."""
    rng = np.random.default_rng(1)
    truth = flight(arguments.images)
    measured = with_control(with_positions(truth, rng), rng, spread(truth, 20), [CONTROL] * 15 + [CHECK] * 5, POSITION)
    bent = measured.points.xyz + rng.normal(size=measured.points.xyz.shape) * 0.05
    poses = measured.cam_from_world.copy()
    poses[:, 4:] += rng.normal(size=(len(poses), 3)) * 0.05
    start = measured.with_points(bent).with_poses(poses)
    alone = start.replace(camera_positions=CameraPositions(), control_points=ControlPoints(), marks=Marks())
    scenes = {
        "without measurements": alone,
        "at the origin": start,
        "in UTM": start.transformed(Similarity(translation=UTM)),
    }
    options = groma.AdjustOptions(point_sigma_px=PIXEL, check_lens=False)
    seconds = {name: [] for name in scenes}
    print(start)
    for turn in range(arguments.rounds + 1):
        for name, scene in scenes.items():
            begin = time.process_time()
            result = groma.adjust(scene, options)
            if turn:  # the first compiles
                seconds[name].append(time.process_time() - begin)
                continue
            shift = UTM if name == "in UTM" else 0.0
            off = np.sqrt(
                ((result.scene.cam_centers_in_world - shift - truth.cam_centers_in_world) ** 2).sum(axis=1).mean()
            )
            error = "" if name == "without measurements" else f", centres off by {1e3 * off:.3f} mm"
            print(f"{name}: cost {result.report.solve.final_cost:.6f}, {result.report.solve.iterations} steps{error}")
    base = np.median(seconds["without measurements"])
    for name, times in seconds.items():
        print(f"{name}: {np.median(times):.2f} s of CPU, {np.median(times) / base:.2f} of that without measurements")


def picture(arguments: argparse.Namespace) -> None:
    """Draw the cameras of the castle from above with their residuals, and the tests of their positions."""
    found = photographs(argparse.Namespace(data=arguments.data, draws=1))["told"]
    scene, tests = found.result.scene, found.reliability
    xy = scene.cam_centers_in_world[:, :2]
    low, size = xy.min(axis=0) - 6.0, np.ptp(xy, axis=0).max() + 12.0
    scale = 420.0 / size
    at = [(20 + scale * (x - low[0]), 440 - scale * (y - low[1])) for x, y in xy]
    rows = [tests.measurements[k : k + 3] for k in range(0, len(tests.measurements), 3)]
    parts = ['<rect width="880" height="460" fill="#ffffff"/>']
    for (x, y), row in zip(at, rows, strict=True):
        bad = any(one.is_suspect for one in row)
        colour = "#c8372d" if bad else "#2a6fb0"
        dx, dy = 200 * scale * row[0].residual / 10, -200 * scale * row[1].residual / 10
        parts.append(
            f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{x + dx:.1f}" y2="{y + dy:.1f}" stroke="{colour}" stroke-width="2"/>'
        )
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{colour}"/>')
        if bad:
            parts.append(f'<text x="{x + 8:.1f}" y="{y - 8:.1f}" font-size="13" fill="{colour}">{row[0].name}</text>')
    step, limit = 400 / len(rows), tests.limit
    top = max(6.0, max(abs(one.normalized) for row in rows for one in row))

    def height(value):
        return 400 * min(abs(value), top) / top

    for k, row in enumerate(rows):
        worst = max(abs(one.normalized) for one in row)
        colour = "#c8372d" if worst > limit else "#2a6fb0"
        tall = height(worst)
        place = f'x="{465 + k * step:.1f}" y="{430 - tall:.1f}" width="{0.7 * step:.1f}" height="{tall:.1f}"'
        parts.append(f'<rect {place} fill="{colour}"/>')
    y = 430 - height(limit)
    parts.append(f'<line x1="460" y1="{y:.1f}" x2="870" y2="{y:.1f}" stroke="#555" stroke-dasharray="5 4"/>')
    parts.append(f'<text x="466" y="{y - 6:.1f}" font-size="13" fill="#555">limit {limit:.2f}</text>')
    parts.append('<text x="466" y="450" font-size="13" fill="#555">cameras: largest normalised residual</text>')
    parts.append('<text x="20" y="450" font-size="13" fill="#555">from above; residuals 20 times enlarged</text>')
    head = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 880 460" font-family="sans-serif">'
    arguments.picture.write_text(f"{head}{''.join(parts)}</svg>\n", encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("castle", "photographs", "one-map", "detection", "utm", "picture"))
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--points", type=int, default=3000, help="points of the castle that take part")
    parser.add_argument("--blocks", type=int, default=60)
    parser.add_argument("--images", type=int, default=1000)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--picture", type=Path, default=Path("docs/images/measurements.svg"))
    arguments = parser.parse_args()
    globals()[arguments.what.replace("-", "_")](arguments)


if __name__ == "__main__":
    main()
