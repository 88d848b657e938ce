# SPDX-License-Identifier: BSD-3-Clause
"""Joint adjustment of points, lines, planes and a wireframe by groma and by LIMAP 2, on the same files.

    python benchmarks/holistic.py --python-limap PYTHON [--images 100 200 500] [--views random near] [--seeds 3]
        [--kinds points lines]
    python benchmarks/holistic.py --python-limap PYTHON --accuracy     # ten scenes of 100 images, as published
    python benchmarks/holistic.py --weights                            # metric relations over four decades of weights

The scene is the published synthetic one: N cameras on a sphere, 10 N points, N lines, N / 5 planes, 3 N points on
lines, 1 px of noise. Both programs read the same COLMAP model with LIMAP's ``structures/`` beside it; gauge, losses and
weights are their own defaults. Reported are medians over the seeds: steps, CPU seconds on one thread, and median errors
against the truth after a similarity alignment of the camera centres (units of a cube 6 wide, times 1e-3; degrees).

Every run is kept in ``results/holistic.json``, and the tables are made of all that is there. LIMAP takes minutes for a
large scene, so its runs of earlier times are taken from there with ``--keep-limap``. What the project promises is
checked at the end; the exit status is 1 if a promise is broken.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import _workshop
import numpy as np
from _workshop import CACHE, CONTESTANTS, RESULTS, machine, run_program

import groma
from groma.scene import synthetic

KINDS = ("points", "lines", "planes", "wireframe")
ERRORS = ("centre", "point", "line_deg", "line", "plane_deg", "plane")
#: Which errors mean something for what was adjusted; the rest stays where it started.
NUM_ERRORS = {"points": 2, "lines": 4, "planes": 6, "wireframe": 6}
#: LIMAP's figures in arXiv 2609.04026 for 100 images: means over ten scenes.
PUBLISHED = {
    "points": (4.40, 5.39),
    "lines": (4.37, 5.39, 0.309, 6.05),
    "planes": (4.31, 5.30, 0.265, 5.34, 0.060, 1.17),
    "wireframe": (4.27, 5.18),
}
#: What is promised: most steps, the least factor by which LIMAP takes longer, and how the time of a step may grow.
MAX_STEPS = {"points": 8, "lines": 8, "planes": 10, "wireframe": 10}
MAX_GROWTH = 1.2
#: Errors are compared from this many scenes on; the errors of one scene are as much luck as merit.
ENOUGH_SCENES = 10


def least_ratio(images: int) -> float:
    """Return how many times longer LIMAP must take at least."""
    return 10.0 if images >= 500 else 3.0


def unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of length one."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def sines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the sines of the angles between unit vectors."""
    return np.minimum(np.linalg.norm(np.cross(a, b), axis=-1), 1.0)


def errors(result: dict[str, np.ndarray], truth: groma.Scene) -> dict[str, float]:
    """Return median errors after a similarity alignment of the camera centres."""
    order = {name: row for row, name in enumerate(truth.images.names)}
    rows = np.array([order[name] for name in result["images"]])
    poses = result["poses"]
    centers = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])
    true_centers = truth.cam_centers_in_world[rows]
    a, b = centers - centers.mean(0), true_centers - true_centers.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / (a**2).sum()
    shift = true_centers.mean(0) - scale * rotation @ centers.mean(0)

    def moved(places):
        return scale * places @ rotation.T + shift

    out = {
        "centre": np.median(np.linalg.norm(moved(centers) - true_centers, axis=1)),
        "point": np.median(np.linalg.norm(moved(result["points"]) - truth.points.xyz, axis=1)),
    }
    ends, true_ends = moved(result["lines"]), truth.lines.segments
    along = unit(ends[:, 1] - ends[:, 0])
    out["line_deg"] = np.degrees(np.median(np.arcsin(sines(along, unit(true_ends[:, 1] - true_ends[:, 0])))))
    out["line"] = np.median(np.linalg.norm(np.cross(true_ends - ends[:, :1], along[:, None]), axis=-1))
    normal, true_normal = unit(result["planes"][:, :3]) @ rotation.T, truth.planes.hesse[:, :3]
    out["plane_deg"] = np.degrees(np.median(np.arcsin(sines(normal, true_normal))))
    offset = scale * result["planes"][:, 3] / np.linalg.norm(result["planes"][:, :3], axis=1) - normal @ shift
    point, plane = truth.relations.point_on_plane.T
    places = truth.points.xyz[point]
    out["plane"] = np.median(np.abs(np.einsum("ni,ni->n", places, normal[plane]) + offset[plane]))
    return {name: float(value) * (1.0 if name.endswith("deg") else 1e3) for name, value in out.items()}


@dataclass(frozen=True)
class Runs:
    """All runs so far: dicts with images, views, seed, kind, contestant and what was measured."""

    rows: list[dict]

    def of(self, **wanted) -> list[dict]:
        """Return the runs that have these values."""
        return [row for row in self.rows if all(row[name] == value for name, value in wanted.items())]

    def add(self, row: dict) -> None:
        """Take a run in, in the place of an earlier one of the same."""
        same = {name: row[name] for name in ("images", "views", "seed", "kind", "contestant")}
        for old in self.of(**same):
            self.rows.remove(old)
        self.rows.append(row)

    def values(self, name: str) -> list:
        """Return the distinct values of one name, sorted."""
        return sorted({row[name] for row in self.rows})


def one_scene(images: int, views: str, seed: int, kinds: list[str], pythons: dict[str, str], kept: Runs) -> list[dict]:
    """Run all contestants on one scene, in turn; leave out what is in ``kept``."""
    where = {"images": images, "views": views, "seed": seed}
    due = [
        {**where, "kind": kind, "contestant": contestant}
        for kind in kinds
        for contestant in pythons
        if not kept.of(**where, kind=kind, contestant=contestant)
    ]
    if not due:
        return []
    folder = CACHE / f"holistic_{images}_{views}_{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    scene = synthetic.holistic(images, noise_px=1.0, seed=seed, views=views)  # type: ignore[arg-type]
    groma.write_scene(scene.start, folder, format="colmap")
    runs = []
    for what in due:
        contestant, kind = what["contestant"], what["kind"]
        result = folder / f"{contestant}_{kind}.npz"
        command = [pythons[contestant], CONTESTANTS / f"{contestant}_holistic.py", folder, kind, result]
        run = run_program([*command, "--warm"] if contestant == "groma" else command)
        if run is not None:
            with np.load(result) as arrays:
                found = errors(dict(arrays), scene.truth)
            runs.append({**what, **run, "errors": found})
    shutil.rmtree(folder)
    return runs


def summary(runs: Runs, images: int, views: str) -> list[dict]:
    """Return medians of times and steps, and means of errors, over the seeds by kind and contestant."""
    rows = []
    for kind in KINDS:
        for contestant in ("groma", "limap"):
            mine = runs.of(images=images, views=views, kind=kind, contestant=contestant)
            if mine:
                row = {"kind": kind, "contestant": contestant, "seeds": len(mine)}
                for field in ("iterations", "cpu_s"):
                    row[field] = statistics.median(run[field] for run in mine)
                row["most_iterations"] = max(run["iterations"] for run in mine)
                row["errors"] = {name: statistics.mean(run["errors"][name] for run in mine) for name in ERRORS}
                rows.append(row)
    return rows


def cells(values: list[float | None]) -> str:
    """Return the columns of errors; None is a dash."""
    texts = ["–" if v is None else f"{v:.3f}°" if n in (2, 4) else f"{v:.2f}" for n, v in enumerate(values)]
    return f"{texts[0]} | {texts[1]} | {texts[2]} {texts[3]} | {texts[4]} {texts[5]}".replace("– –", "–")


def error_cells(row: dict) -> str:
    """Return the errors of a summary row that mean something."""
    count = NUM_ERRORS[row["kind"]]
    return cells([row["errors"][name] if n < count else None for n, name in enumerate(ERRORS)])


def table(runs: Runs) -> str:
    """Return the results as a Markdown table."""
    lines = [
        "| images | views | adjusted | program | scenes | steps | CPU s | groma = 1 | centre | point | line | plane |",
        "|--:|---|---|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for images in runs.values("images"):
        for views in reversed(runs.values("views")):
            rows = summary(runs, images, views)
            base = {row["kind"]: row["cpu_s"] for row in rows if row["contestant"] == "groma"}
            lines += [
                f"| {images} | {views} | {row['kind']} | {row['contestant']} | {row['seeds']} "
                f"| {row['iterations']:.0f} | {row['cpu_s']:.3f} | {row['cpu_s'] / base.get(row['kind'], np.nan):.1f} "
                f"| {error_cells(row)} |"
                for row in rows
            ]
    return "\n".join(lines) + "\n"


def accuracy_table(runs: Runs, images: int = 100, views: str = "random") -> str:
    """Return means over the scenes of one size of the median errors, beside the published ones."""
    lines = ["| adjusted | program | scenes | centre | point | line | plane |", "|---|---|--:|--:|--:|--:|--:|"]
    rows = summary(runs, images, views)
    for kind in KINDS:
        lines += [
            f"| {kind} | {row['contestant']} | {row['seeds']} | {error_cells(row)} |"
            for row in rows
            if row["kind"] == kind
        ]
        published = [*PUBLISHED[kind], *[None] * (len(ERRORS) - len(PUBLISHED[kind]))]
        lines.append(f"| {kind} | limap, as published | 10 | {cells(published)} |")
    return "\n".join(lines) + "\n"


def growth(runs: Runs, contestant: str = "groma") -> dict[tuple[str, str], tuple[float, list[tuple[int, float]]]]:
    """Return by (views, kind) the exponent of the CPU time of a step in the number of images, and the times."""
    found = {}
    for views in runs.values("views"):
        for kind in KINDS:
            times = []
            for images in runs.values("images"):
                mine = runs.of(images=images, views=views, kind=kind, contestant=contestant)
                if mine:
                    times.append((images, statistics.median(run["cpu_s"] / run["iterations"] for run in mine)))
            if len(times) >= 3:
                x, y = np.log(np.array(times)).T
                found[views, kind] = float(np.polyfit(x, y, 1)[0]), times
    return found


def growth_table(runs: Runs) -> str:
    """Return CPU milliseconds a step by number of images, and the fitted exponent, as a Markdown table."""
    sizes = runs.values("images")
    lines = [
        f"| views | adjusted | program | {' | '.join(map(str, sizes))} | exponent |",
        f"|---|---|---|{'--:|' * len(sizes)}--:|",
    ]
    for contestant in ("groma", "limap"):
        for (views, kind), (exponent, times) in growth(runs, contestant).items():
            ms = dict(times)
            texts = [f"{1e3 * ms[n]:.{1 if ms[n] < 0.01 else 0}f}" if n in ms else "–" for n in sizes]
            lines.append(f"| {views} | {kind} | {contestant} | {' | '.join(texts)} | {exponent:.2f} |")
    return "\n".join(lines) + "\n"


def broken_promises(runs: Runs) -> list[str]:
    """Return a sentence for every promise that the runs do not keep."""
    broken = []
    for images in runs.values("images"):
        for views in runs.values("views"):
            rows = {(row["kind"], row["contestant"]): row for row in summary(runs, images, views)}
            for kind in KINDS:
                mine, peer = rows.get((kind, "groma")), rows.get((kind, "limap"))
                name = f"{images} images, {views} views, {kind}"
                if mine and mine["most_iterations"] > MAX_STEPS[kind]:
                    broken.append(f"{name}: {mine['most_iterations']} steps, {MAX_STEPS[kind]} are promised.")
                if mine and peer and peer["cpu_s"] < (least := least_ratio(images)) * mine["cpu_s"]:
                    ratio = peer["cpu_s"] / mine["cpu_s"]
                    broken.append(f"{name}: LIMAP takes {ratio:.1f} times longer, {least:g} are promised.")
                if mine and peer and min(mine["seeds"], peer["seeds"]) >= ENOUGH_SCENES:
                    for field in ERRORS[: NUM_ERRORS[kind]]:
                        if mine["errors"][field] > 1.001 * peer["errors"][field]:
                            broken.append(f"{name}: {field} is {mine['errors'][field]:.3f}, LIMAP's is lower.")
    for (views, kind), (exponent, _) in growth(runs).items():
        if exponent > MAX_GROWTH:
            broken.append(f"{views} views, {kind}: the time of a step grows with exponent {exponent:.2f}.")
    return broken


def weights_table(images: int = 100, seeds: int = 3) -> str:
    """Return errors and steps of both forms of relations, the metric one over decades of weights, as Markdown."""
    sys.path.append(str(CONTESTANTS))
    from groma_holistic import arrays_of, reduced  # type: ignore[import-not-found]

    lines = ["| relations | centre | point | line | plane | steps |", "|---|--:|--:|--:|--:|--:|"]
    scenes = [synthetic.holistic(images, noise_px=1.0, seed=seed) for seed in range(seeds)]

    def add(title: str, kind: str, **options) -> None:
        found, steps = [], []
        for scene in scenes:
            start, chosen = reduced(scene.start, kind)
            result = groma.adjust(start, replace(chosen, **options))
            found.append(errors(arrays_of(result.scene), scene.truth))
            steps.append(result.report.solve.iterations)
        row = {"kind": kind, "errors": {name: statistics.mean(f[name] for f in found) for name in ERRORS}}
        lines.append(f"| {title} | {error_cells(row)} | {max(steps)} |")

    add("none: points and lines", "lines")
    for kind, title in (("planes", "planes"), ("wireframe", "planes and wireframe")):
        for sigma in (0.001, 0.01, 0.1, 0.2, 1.0, 10.0):
            add(f"{title}, metric, {sigma:g} px", kind, structure_sigma_px=sigma)
        add(f"{title}, pixels", kind, structure_form="pixels")
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python-limap", help="Python that has pylimap; without it groma runs alone")
    parser.add_argument("--keep-limap", action="store_true", help="take LIMAP's runs from the results, where there are")
    parser.add_argument("--images", type=int, nargs="+", default=[100, 200])
    parser.add_argument("--views", nargs="+", choices=("random", "near"), default=["random"])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS), help="what is adjusted")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--timeout", type=int, default=_workshop.TIMEOUT, help="longest a run may take, seconds")
    parser.add_argument("--programs", nargs="+", choices=("groma", "limap"), default=["groma", "limap"])
    parser.add_argument("--accuracy", action="store_true", help="ten scenes of 100 images; the table as published")
    parser.add_argument("--weights", action="store_true", help="only the table of weights of metric relations")
    arguments = parser.parse_args()
    for folder in (RESULTS, CACHE):
        folder.mkdir(parents=True, exist_ok=True)
    if arguments.weights:
        text = weights_table()
        (RESULTS / "holistic_weights.md").write_text(text)
        print(text)
        return 0
    _workshop.TIMEOUT = arguments.timeout
    pythons = {"groma": sys.executable}
    if arguments.python_limap:
        pythons["limap"] = str(Path(arguments.python_limap))
    pythons = {name: python for name, python in pythons.items() if name in arguments.programs}
    if arguments.accuracy:
        arguments.images, arguments.views, arguments.seeds = [100], ["random"], 10
    path = RESULTS / "holistic.json"
    runs = Runs(json.loads(path.read_text())["runs"] if path.is_file() else [])
    for images in arguments.images:
        for views in arguments.views:
            for seed in range(arguments.seeds):
                kept = Runs(runs.of(contestant="limap") if arguments.keep_limap else [])
                for run in one_scene(images, views, seed, arguments.kinds, pythons, kept):
                    runs.add(run)
                path.write_text(json.dumps({"machine": machine(), "runs": runs.rows}, indent=1) + "\n")
            print(table(Runs(runs.of(images=images, views=views))), flush=True)
    texts = {"holistic": table(runs), "holistic_accuracy": accuracy_table(runs), "holistic_growth": growth_table(runs)}
    for name, text in texts.items():
        (RESULTS / f"{name}.md").write_text(text)
    print(texts["holistic_accuracy"] if arguments.accuracy else texts["holistic"], texts["holistic_growth"], sep="\n")
    broken = broken_promises(runs)
    print("\n".join(broken) or "All promises are kept.")
    return 1 if broken else 0


if __name__ == "__main__":
    sys.exit(main())
