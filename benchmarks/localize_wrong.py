# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that must not be localised, and how often they are: trial by trial, so that a run can be cut into pieces.

    python benchmarks/localize_wrong.py pictures MAP IMAGES TRIALS [OTHER ...]   made of those of the map, and others
    python benchmarks/localize_wrong.py walls MAP IMAGES TRUTH TRIALS            a map of one side, photographs of all
    python benchmarks/localize_wrong.py facade FOLDER TRIALS [--seeds 0 1]       rendered rows of equal windows
    python benchmarks/localize_wrong.py rate TRIALS ...                          the rate, with its interval

TRIALS is a file of JSON lines; what is in it is not tried again, and ``--minutes`` ends a run early. A trial is *wrong*
if it is ``localized`` where the picture was not taken: *pictures* are mirrored, upside down and mirrored, cut into
twelve blocks in another order (four orders each), noise, blank, or of other places. One put together of blocks may have
one where it was; with the pose of the photograph that it was made of it is ``localized``, and not ``wrong``. *Walls*
and *facade* compare with the true pose.

OTHER are folders of other places. Whatever of them is ``localized`` counts as wrong, so do not pass a folder that shows
a piece of the mapped place, too: castle-P30, entry-P10 and fountain-P11 are one courtyard.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from _windows import write
from localize import _errors
from scipy.stats import beta

from groma.io import read_scene
from groma.localization.localizer import Localizer
from groma.localization.pose.absolute_pose import AbsolutePose
from groma.localization.pose.gates import VERDICT
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.verdict import moved
from groma.mapping.photographs import image_files, read_gray

#: Orders of its blocks that each image is cut into.
SHUFFLES = 4
#: Pictures farther from the true pose than this (scene units, degrees) are wrong.
FAR = (0.5, 5.0)


@dataclass(frozen=True)
class Trial:
    """A picture, and how to tell whether a localised pose is wrong."""

    kind: str
    name: str
    picture: Callable[[], np.ndarray]
    wrong: Callable[[AbsolutePose], bool] = lambda found: True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    made = {name: commands.add_parser(name) for name in ("pictures", "walls", "facade", "rate")}
    for name in ("pictures", "walls"):
        made[name].add_argument("map", type=Path)
        made[name].add_argument("images", type=Path)
    made["walls"].add_argument("truth", type=Path)
    made["walls"].add_argument("--width", type=int, default=8, help="photographs of a side, one after the other")
    made["facade"].add_argument("folder", type=Path)
    made["facade"].add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    for name in ("pictures", "walls", "facade"):
        made[name].add_argument("trials", type=Path)
        made[name].add_argument("--minutes", type=float, default=1e9, help="begin no trial after so many minutes")
    made["pictures"].add_argument("others", type=Path, nargs="*")
    made["pictures"].add_argument("--limit", type=int, default=1000, help="photographs of another folder at most")
    made["pictures"].add_argument("--own-limit", type=int, default=1000, help="photographs of the map at most")
    made["rate"].add_argument("trials", type=Path, nargs="+")
    given = parser.parse_args()
    if given.command == "rate":
        print(rate(given.trials))
        return
    if given.command == "pictures":
        works = pictures(given.map, given.images, given.others, (given.own_limit, given.limit))
    elif given.command == "walls":
        works = walls(given.map, given.images, given.truth, given.width)
    else:
        works = facades(given.folder, given.seeds)
    tried(works, given.trials, given.minutes)


Work = tuple[str, Callable[[], Localizer], Callable[[Localizer], Iterator[Trial]]]


def tried(works: Iterator[Work], file: Path, minutes: float) -> None:
    """Try what a file does not have yet, and append it."""
    rows = [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []
    done, until = {(row["map"], row["kind"], row["name"]) for row in rows}, time.monotonic() + 60.0 * minutes
    with file.open("a") as out:
        for place, make, trials in works:
            localizer = make()
            for trial in trials(localizer):
                if (place, trial.kind, trial.name) in done:
                    continue
                if time.monotonic() > until:
                    return
                start = time.process_time()
                found = localizer.localize(trial.picture()).pose
                row = {
                    "map": place, "kind": trial.kind, "name": trial.name, "status": found.status,
                    "wrong": found.status == "localized" and trial.wrong(found), "sentence": found.sentence,
                    "seconds": round(time.process_time() - start, 2),
                }  # fmt: skip
                out.write(json.dumps(row) + "\n")
                out.flush()


def rate(files: list[Path]) -> str:
    """Return a table: trials, localised, wrong, uncertain; and the rate of wrong ones with its 95 % interval."""
    rows = [json.loads(line) for file in files for line in file.read_text().splitlines()]
    kinds = list(dict.fromkeys((row["map"], row["kind"]) for row in rows))
    lines = ["| map | photographs | trials | localised | of these wrong | uncertain |", "|---|---|---|---|---|---|"]
    for place, kind in kinds:
        some = [row for row in rows if (row["map"], row["kind"]) == (place, kind)]
        counts = [sum(row["status"] == "localized" for row in some), sum(row["wrong"] for row in some)]
        counts.append(sum(row["status"] == "uncertain" for row in some))
        lines.append(f"| {' | '.join([place, kind, str(len(some)), *map(str, counts)])} |")
    n, k = len(rows), sum(row["wrong"] for row in rows)
    low, high = interval(k, n)
    return "\n".join(
        [*lines, "", f"{k} of {n} wrong: {100 * k / n:.2f} % (95 %: {100 * low:.2f} to {100 * high:.2f} %)"]
    )


def interval(k: int, n: int, share: float = 0.95) -> tuple[float, float]:
    """The interval of Clopper and Pearson for a rate of which k of n trials are known."""
    rest = 0.5 * (1.0 - share)
    low = 0.0 if k == 0 else float(beta.ppf(rest, k, n - k + 1))
    return low, 1.0 if k == n else float(beta.ppf(1.0 - rest, k + 1, n - k))


# --------------------------------------------------------------------------------------------------------- pictures
def pictures(map_: Path, images: Path, others: list[Path], limits: tuple[int, int]) -> Iterator[Work]:
    """Pictures made of the photographs of a map, and photographs of other places."""

    def trials(localizer: Localizer) -> Iterator[Trial]:
        true: dict[Path, np.ndarray | None] = {}

        def other_place(file: Path) -> Callable[[AbsolutePose], bool]:
            def told(found: AbsolutePose) -> bool:
                if file not in true:
                    true[file] = localizer.localize(file).pose.cam_from_world
                return _is_other(found, true[file])

            return told

        own = _chosen(images, limits[0])
        shape = read_gray(own[0]).shape
        for number, file in enumerate(own):
            yield Trial("mirrored", file.name, lambda file=file: np.ascontiguousarray(read_gray(file)[:, ::-1]))
            yield Trial("upside down and mirrored", file.name, lambda file=file: read_gray(file)[::-1].copy())
            for order in range(SHUFFLES):
                rng = np.random.default_rng([number, order])
                made = lambda file=file, rng=rng: _sized(_shuffled(read_gray(file), rng), shape)  # noqa: E731
                yield Trial("blocks in another order", f"{file.name} {order}", made, other_place(file))
        for number in range(3):
            rng = np.random.default_rng(number)
            yield Trial("noise", str(number), lambda rng=rng: rng.integers(0, 256, shape, dtype=np.uint8))
            yield Trial("blank", str(number), lambda n=number: np.full(shape, (0, 128, 255)[n], np.uint8))
        for folder in others:
            for file in _chosen(folder, limits[1]):
                yield Trial(folder.parts[-2], file.name, lambda file=file: _sized(read_gray(file), shape))

    yield map_.name, lambda: Localizer(map_, images), trials


def _chosen(folder: Path, limit: int) -> list[Path]:
    """An even choice of the images in a folder."""
    files = image_files(folder)
    rows = np.unique(np.linspace(0, len(files) - 1, min(limit, len(files))).astype(int))
    return [files[row] for row in rows]


def _is_other(found: AbsolutePose, true: np.ndarray | None) -> bool:
    """Whether a pose is another one than that of the whole photograph, as localisation tells two places apart."""
    if true is None:
        return True
    places = found.matches.points3d[found.point_inliers]
    return moved(found.camera, found.cam_from_world, true, places) > VERDICT.distinct * max_errors(found.matches)[0]


def _sized(picture: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """A picture in the size of the map's images, so that the calibration of the map is taken for it."""
    return cv2.resize(picture, shape[::-1], interpolation=cv2.INTER_AREA) if picture.shape != shape else picture


def _shuffled(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The same image with its twelfths in another order."""
    height, width = image.shape[0] // 3, image.shape[1] // 4
    blocks = image[: 3 * height, : 4 * width].reshape(3, height, 4, width).swapaxes(1, 2).reshape(12, height, width)
    return rng.permutation(blocks).reshape(3, 4, height, width).swapaxes(1, 2).reshape(3 * height, 4 * width).copy()


# ------------------------------------------------------------------------------------------------------------ walls
def walls(map_: Path, images: Path, truth: Path, width: int) -> Iterator[Work]:
    """Maps of some photographs in a row, all others as queries: walls that look like those of the map are not those."""
    scene, true = read_scene(map_), read_scene(truth)
    poses = dict(zip(true.images.names, true.cam_from_world, strict=True))
    order = sorted(range(scene.num_images), key=lambda row: scene.images.names[row])
    for begin in range(0, len(order) - width + 1, width):
        part = scene.subset(order[begin : begin + width])

        def trials(localizer: Localizer) -> Iterator[Trial]:
            for name in sorted(set(poses) - set(localizer.scene.images.names)):
                yield Trial("sides", name, lambda name=name: read_gray(images / name), _farther(poses[name]))

        yield f"{images.parts[-2]} {begin}", lambda part=part: Localizer(part, images), trials


def _farther(true: np.ndarray) -> Callable[[AbsolutePose], bool]:
    def told(found: AbsolutePose) -> bool:
        distance, angle = _errors(found.cam_from_world, true)
        return distance > FAR[0] or angle > FAR[1]

    return told


# ----------------------------------------------------------------------------------------------------------- facade
def facades(folder: Path, seeds: list[int]) -> Iterator[Work]:
    """Maps of a part of a rendered row of windows, and photographs of it, of the rest, and of another facade."""
    for seed in seeds:
        place = folder / f"facade_{seed}"
        if not (place / "map").exists():
            rendered = write(place, seed)
            command = ["map", str(place / "mapped"), "-o", str(place / "map"), "--poses", str(rendered), "--fix-poses"]
            subprocess.run([sys.executable, "-m", "groma", *command], check=True, stdout=subprocess.DEVNULL)

        def trials(localizer: Localizer, place: Path = place) -> Iterator[Trial]:
            true = read_scene(place / "queries.npz")
            for name, pose in zip(true.images.names, true.cam_from_world, strict=True):
                kind = name.split("_")[0]
                wrong = (lambda found: True) if kind == "another" else _farther(pose)
                yield Trial(f"{kind} windows", name, lambda name=name: read_gray(place / "queries" / name), wrong)

        yield place.name, lambda place=place: Localizer(place / "map", place / "mapped"), trials


if __name__ == "__main__":
    main()
