# SPDX-License-Identifier: BSD-3-Clause
"""Maps of photographs whose poses come from elsewhere: how near a survey, how noisy, which are wrong.

    python benchmarks/poses_from_elsewhere.py SCENE ...
    python benchmarks/poses_from_elsewhere.py SCENE ... --draws 10 --cases phone "drone, 10 % wrong" --no-lines

SCENE is a folder with ``images/`` and the survey ``sparse_gt/``, a COLMAP model. The surveyed poses are disturbed,
written to a ``transforms.json`` and read back, and the photographs are mapped at them; no points are given. Cases:
*phone*, 5 cm and 0.5 degrees in each coordinate; *drone*, 0.5 m and 3 degrees; and both with a tenth of the poses
grossly wrong: turned by about a radian about each axis, at random places as spread as the cameras.

A row says, over the draws: root mean square and largest distance of the centres from the survey after alignment
(thousandths of a unit), of the points' adjustment and of the whole map; the noise that was found; how many of the wrong
poses were named, how many right ones were, and how many images were left out. Features and matches are the same for all
draws and made once.
"""

import argparse
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma.evaluation import evaluate_poses
from groma.geometry import quaternion
from groma.io import read_scene, write_scene
from groma.io.colmap.sfm import PointModelOptions
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions
from groma.mapping.posed.given import scene_at_poses
from groma.mapping.posed.register import register_photographs
from groma.scene import Scene

#: Standard deviations of places (metres) and orientations (degrees), and the share of wrong poses.
CASES = {
    "phone": (0.05, 0.5, 0.0),
    "phone, 10 % wrong": (0.05, 0.5, 0.1),
    "drone": (0.5, 3.0, 0.0),
    "drone, 10 % wrong": (0.5, 3.0, 0.1),
}


@dataclass(frozen=True)
class Draw:
    """What came out of one draw."""

    #: Distances of the centres after the adjustment of points, and of the whole map.
    points: tuple[float, float]
    lines: tuple[float, float] | None
    #: Noise that was found.
    noise: tuple[float, float]
    #: Wrong poses, those of them named, right ones named, images left out.
    wrong: int
    named: int
    accused: int
    left_out: int


def disturbed(survey: Scene, case: tuple[float, float, float], seed: int) -> tuple[Scene, set[str]]:
    """Return the survey with noise on its poses, and the names of those that are wrong."""
    rng, count = np.random.default_rng(seed), survey.num_images
    place, degrees, share = case
    centers, turns = survey.cam_centers_in_world, survey.cam_from_world[:, :4]
    given = centers + place * rng.normal(size=(count, 3))
    turned = quaternion.multiply(quaternion.exp(np.radians(degrees) * rng.normal(size=(count, 3))), turns)
    wrong = rng.permutation(count)[: round(share * count)]
    given[wrong] = centers.mean(0) + centers.std(0) * rng.normal(size=(len(wrong), 3))
    turned[wrong] = quaternion.multiply(quaternion.exp(rng.normal(size=(len(wrong), 3))), turned[wrong])
    poses = np.hstack([turned, -quaternion.rotate(turned, given)])
    return survey.with_poses(poses), {survey.images.names[row] for row in wrong}


def distances(scene: Scene, survey: Scene) -> tuple[float, float]:
    """Return the root mean square and the largest distance of the centres after alignment, thousandths of a unit."""
    found = evaluate_poses(scene, survey)
    return 1e3 * found.center_rmse, 1e3 * found.center_max


def draw(folder: Path, work: Path, case: tuple[float, float, float], seed: int, with_lines: bool) -> Draw:
    """Disturb, map, compare."""
    survey = read_scene(folder / "sparse_gt").keep(points=[])
    given, wrong = disturbed(survey, case, seed)
    with tempfile.TemporaryDirectory() as place:
        write_scene(given, Path(place) / "transforms.json")
        start = scene_at_poses(folder / "images", Path(place) / "transforms.json", PointModelOptions())
        scene = register_photographs(folder / "images", work, start.scene, PointModelOptions()).scene
        mapped = None
        if with_lines:
            mapped = distances(map_images(folder / "images", Path(place) / "map", scene, MapOptions()).scene, survey)
    trusted = {
        scene.images.names[row] for row in np.flatnonzero(np.isin(scene.images.frame_idx, scene.pose_priors.frame_idx))
    }
    named = set(scene.images.names) - trusted
    sigma = scene.pose_priors.sigma[0]
    return Draw(
        distances(scene, survey),
        mapped,
        (float(sigma[0]), float(np.degrees(sigma[3]))),
        len(wrong),
        len(named & wrong),
        len(named - wrong),
        survey.num_images - scene.num_images,
    )


def tell(name: str, case: str, draws: list[Draw]) -> None:
    """Print a row."""

    def over(values: list[tuple[float, float]]) -> str:
        return f"{np.mean([value[0] for value in values]):.2f} / {max(value[1] for value in values):.1f}"

    lines = [one.lines for one in draws if one.lines is not None]
    cells = [
        over([one.points for one in draws]),
        over(lines) if lines else "–",
        f"{np.mean([one.noise[0] for one in draws]):.3f} / {np.mean([one.noise[1] for one in draws]):.2f}",
        f"{sum(one.named for one in draws)} of {sum(one.wrong for one in draws)}",
        str(sum(one.accused for one in draws)),
        str(sum(one.left_out for one in draws)),
    ]
    print(f"| {name} | {case} | {len(draws)} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--first", type=int, default=0, help="Seed of the first draw, to add draws to others.")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--no-lines", action="store_true", help="End with the adjustment of points.")
    parser.add_argument("--work", type=Path, help="Keep features and matches here, a folder for each scene.")
    told = parser.parse_args()
    head = "scene | case | draws | points: rms mean / max | map | noise, units / degrees | named | accused | left out"
    print(f"| {head} |\n|" + "---|" * 9, flush=True)
    with tempfile.TemporaryDirectory() as own:
        for folder in told.scenes:
            work = (told.work or Path(own)) / folder.name
            seeds = range(told.first, told.first + told.draws)
            for case in told.cases:
                found = [draw(folder, work, CASES[case], seed, not told.no_lines) for seed in seeds]
                tell(folder.name, case, found)


if __name__ == "__main__":
    main()
