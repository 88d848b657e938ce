# SPDX-License-Identifier: BSD-3-Clause
"""Calibrations that nobody gave: estimated with a principal point near the middle, and with it held in the middle.

    python benchmarks/unknown_calibration.py SCENE ... [--crop 0 40]
    python benchmarks/unknown_calibration.py [--draws 12]

SCENE is a folder with a model ``sparse_inc/`` (or ``sparse_gt/`` alone) and exact or surveyed cameras ``sparse_gt/``.
Its calibration is taken away: one SIMPLE_RADIAL camera, focal length 5 % off, principal point in the middle, no
distortion. ``--crop`` first cuts so many columns and rows off the left and the top of all images. Points alone are
adjusted with the true calibration (*given*), with the principal point held in the middle (*held*), and with its prior
(*estimated*). Centres are in thousandths of a unit after alignment, rotations in degrees, principal points in pixels.

Without scenes: cameras of random lenses (principal point off by 1 % of the width, focal length begun 2 % off, noise of
half a pixel, least squares) in several arrangements. Errors are root mean squares over the draws; squares are squared
errors of the cameras over their stated variances, 1 is right.
"""

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

import groma
from groma.adjustment.terms.principal_points import near_the_middle
from groma.cameras import model
from groma.evaluation import evaluate_poses
from groma.geometry import quaternion, se3
from groma.io import read_scene
from groma.scene import Cameras, PointObservations, Points, Scene
from groma.solver.covariance.marginals import Covariances

LENS, WIDTH, HEIGHT, NOISE = "SIMPLE_RADIAL", 1024, 768, 0.5
ALONE = {"lines": False, "planes": False, "check_lens": False}
WAYS = {"held": {"refine_intrinsics": True, "refine_principal_point": False}, "estimated": {"refine_intrinsics": True}}


# ------------------------------------------------------------------------------------------------- surveyed scenes
def cropped(scene: Scene, columns: float, rows: float) -> Scene:
    """Return a scene of pinhole cameras without the first columns and rows of its images."""
    cameras, table = scene.cameras, scene.point_observations
    params = cameras.params.copy()
    params[:, 2:4] -= columns, rows
    table = table.replace(pixel=table.pixel - (columns, rows))
    smaller = cameras.replace(params=params, width=cameras.width - int(columns), height=cameras.height - int(rows))
    return scene.replace(cameras=smaller, point_observations=table.take((table.pixel > 0.0).all(axis=1)))


def without_calibration(scene: Scene) -> Scene:
    """Return the scene with cameras of which only a rough focal length is known."""
    cameras = scene.cameras
    middle = 0.5 * np.stack([cameras.width, cameras.height], axis=1)
    params = np.column_stack([1.05 * cameras.params[:, 0], middle, np.zeros(len(cameras))])
    return near_the_middle(scene.replace(cameras=cameras.replace(models=(LENS,) * len(cameras), params=params)))


def tell_scene(folder: Path, crop: tuple[float, float]) -> None:
    """Print a row for each way."""
    survey = read_scene(folder / "sparse_gt")
    start = folder / "sparse_inc"
    scene = cropped(read_scene(start if start.is_dir() else folder / "sparse_gt").points_only(), *crop)
    true, bare = scene.cameras.params, without_calibration(scene)
    for way, options in {"given": {}, **WAYS}.items():
        found = groma.adjust(scene if way == "given" else bare, groma.AdjustOptions(**ALONE, **options))
        told, params = evaluate_poses(found.scene, survey), found.scene.cameras.params
        focal = 100.0 * np.mean(params[:, 0] / true[:, :2].mean(axis=1) - 1.0)
        off = np.mean(params[:, 1:3] - true[:, 2:4], axis=0)
        cells = ["", ""] if way == "given" else [f"{focal:+.3f}", f"{off[0]:+.1f}, {off[1]:+.1f}"]
        name = folder.name + (f", without {crop[0]:g} columns, {crop[1]:g} rows" if any(crop) else "")
        errors = f"{1e3 * told.center_rmse:.2f} | {told.rotation_deg_mean:.3f}"
        print(f"| {name} | {way} | {errors} | {' | '.join(cells)} |", flush=True)


# --------------------------------------------------------------------------------------------------- random lenses
def looking(centers: np.ndarray, at: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Return poses (N, 7) of cameras that look at places, turned about their axes."""
    z = (at - centers) / np.linalg.norm(at - centers, axis=1, keepdims=True)
    x = np.cross(z, np.where(np.abs(z[:, 1:2]) > 0.9, (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    q = quaternion.from_matrix(np.stack([c * x + s * y, c * y - s * x, z], axis=1))
    return np.hstack([q, -quaternion.rotate(q, centers)])


def around(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return poses all around the middle."""
    centers = rng.normal(size=(count, 3))
    centers *= rng.uniform(4.0, 6.0, (count, 1)) / np.linalg.norm(centers, axis=1, keepdims=True)
    return looking(centers, rng.normal(0.0, 0.3, (count, 3)), rng.uniform(0.0, 2.0 * np.pi, count))


def before(count: int, rng: np.random.Generator, spread: float = 2.5, turns: int = 0) -> np.ndarray:
    """Return poses in front, that converge; so many of four are turned by a quarter."""
    centers = np.column_stack([rng.uniform(-spread, spread, (count, 2)), rng.uniform(-6.0, -4.0, count)])
    return looking(centers, rng.normal(0.0, 0.3, (count, 3)), 0.5 * np.pi * (np.arange(count) % (turns + 1)))


def parallel(count: int, rng: np.random.Generator) -> np.ndarray:
    """Return poses that look in one direction."""
    centers = np.column_stack([rng.uniform(-2.0, 2.0, (count, 2)), rng.uniform(-6.2, -5.8, count)])
    return np.hstack([np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)), -centers])


#: Poses; half of the depth of the scene, which is 4 units wide; how far off the focal length is at the start.
ARRANGEMENTS: dict[str, tuple[Callable[[np.random.Generator], np.ndarray], float, float]] = {
    "20 all around": (lambda rng: around(20, rng), 2.0, 1.02),
    "12 in front, turned by quarters": (lambda rng: before(12, rng, turns=3), 2.0, 1.02),
    "8 in front, upright": (lambda rng: before(8, rng), 2.0, 1.02),
    "12 before a flat wall, turned by quarters": (lambda rng: before(12, rng, turns=3), 0.0, 1.02),
    "three views": (lambda rng: before(3, rng), 2.0, 1.02),
    "10 in one direction": (lambda rng: parallel(10, rng), 1.5, 1.02),
}


def seen(poses: np.ndarray, depth: float, off: float, rng: np.random.Generator) -> tuple[Scene, Scene, np.ndarray]:
    """Return what a camera of a random lens sees: the truth, the start, and the lens."""
    xyz = rng.uniform((-2.0, -2.0, -depth), (2.0, 2.0, depth), (200, 3))
    away = rng.normal(0.0, 0.01 * WIDTH, 2)
    lens = np.array([rng.uniform(700.0, 1000.0), WIDTH / 2 + away[0], HEIGHT / 2 + away[1], rng.normal(0.0, 0.05)])
    in_cam = np.stack([se3.transform_points(np.repeat(pose[None], len(xyz), axis=0), xyz) for pose in poses])
    pixel = model(LENS).project(lens, in_cam.reshape(-1, 3)).reshape(*in_cam.shape[:2], 2)
    inside = ((pixel > 1.0) & (pixel < (WIDTH - 1, HEIGHT - 1))).all(axis=2) & (in_cam[..., 2] > 0.3)
    image, point = np.nonzero(inside & (rng.random(inside.shape) < 0.7))
    table = PointObservations.numbered(image, point, pixel[image, point] + rng.normal(0.0, NOISE, (len(image), 2)))
    truth = Scene.from_images(
        Cameras([1], (LENS,), lens[None], [WIDTH], [HEIGHT]), [f"{row}.png" for row in range(len(poses))],
        np.zeros(len(poses), int), poses, points=Points.at(xyz), point_observations=table,
    ).keep(points=np.bincount(point, minlength=len(xyz)) > 1)  # fmt: skip
    start = truth.with_params([[off * lens[0], WIDTH / 2, HEIGHT / 2, 0.0]])
    return truth, near_the_middle(start), lens


def measured(truth: Scene, found: groma.AdjustResult, lens: np.ndarray) -> list[float]:
    """Return squared errors: focal length, principal point, centres, rotations; those of the cameras in variances."""
    told, params = evaluate_poses(found.scene, truth), found.scene.cameras.params[0]
    covariances = Covariances(found.problem, gauge="inner")
    errors = {name: np.zeros((len(one), one.manifold.dof)) for name, one in found.problem.variables.items()}
    frames = found.problem.variables["frames"]
    errors["frames"] = frames.manifold.local(frames.state, truth.frames.rig_from_world)
    e, sigma = covariances.in_datum(errors)["frames"], covariances.of("frames")
    squares = [
        np.mean(
            [one[part] @ np.linalg.solve(cov[part, part], one[part]) / 3.0 for one, cov in zip(e, sigma, strict=True)]
        )
        for part in (slice(3), slice(3, 6))
    ]
    focal, off = 100.0 * (params[0] / lens[0] - 1.0), params[1:3] - lens[1:3]
    return [focal**2, np.mean(off**2), told.center_rmse**2, told.rotation_deg_mean**2, *squares]


def tell_arrangement(name: str, draws: int) -> None:
    """Print a row for each way."""
    make, depth, off = ARRANGEMENTS[name]
    rows = {way: [] for way in WAYS}
    for draw in range(draws):
        rng = np.random.default_rng(draw)
        truth, start, lens = seen(make(rng), depth, off, rng)
        for way, options in WAYS.items():
            how = groma.AdjustOptions(loss="none", point_sigma_px=NOISE, function_tolerance=1e-10, **ALONE, **options)
            rows[way].append(measured(truth, groma.adjust(start, how), lens))
    for way, found in rows.items():
        mean = np.mean(found, axis=0)
        focal, point, center, turn = np.sqrt(mean[:4])
        cells = f"{focal:.3f} | {point:.2f} | {center:.4f} | {turn:.3f} | {mean[4]:.2f} | {mean[5]:.2f}"
        print(f"| {name} | {way} | {cells} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*")
    parser.add_argument("--crop", type=float, nargs=2, default=(0.0, 0.0), metavar=("COLUMNS", "ROWS"))
    parser.add_argument("--draws", type=int, default=12)
    given = parser.parse_args()
    if given.scenes:
        print("| scene | | centres | rotations | focal length, % | principal point |")
        print("|---|---|--:|--:|--:|---|")
        for folder in given.scenes:
            tell_scene(folder, given.crop)
    else:
        print("| scene | | focal length, % | principal point, px | centres | rotations, degrees ", end="")
        print("| squares, centres | squares, rotations |\n|---|---|--:|--:|--:|--:|--:|--:|")
        for name in ARRANGEMENTS:
            tell_arrangement(name, given.draws)


if __name__ == "__main__":
    main()
