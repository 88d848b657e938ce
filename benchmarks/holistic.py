# SPDX-License-Identifier: BSD-3-Clause
"""Joint adjustment of points, lines, planes and a wireframe by groma and by LIMAP 2, on the same files.

    python benchmarks/holistic.py --python-limap PYTHON [--images 100 200 500] [--views random near] [--seeds 3]

The scene is the published synthetic one: N cameras on a sphere, 10 N points, N lines, N / 5 planes, 3 N points on
lines, 1 px of noise. Both programs read the same COLMAP model with LIMAP's ``structures/`` beside it; gauge, losses and
weights are their own defaults. Reported are medians over the seeds: steps, CPU seconds on one thread, and median errors
against the truth after a similarity alignment of the camera centres (units of a cube 6 wide, times 1e-3; degrees).
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import sys
from pathlib import Path

import numpy as np
from _workshop import CACHE, CONTESTANTS, RESULTS, machine, run_program

import groma
from groma.scene import synthetic

KINDS = ("points", "lines", "planes", "wireframe")
ERRORS = ("centre", "point", "line_deg", "line", "plane_deg", "plane")


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
    away = np.cross(true_ends - ends[:, :1], along[:, None])
    out["line"] = np.median(np.linalg.norm(away, axis=-1))
    normal, true_normal = unit(result["planes"][:, :3]) @ rotation.T, truth.planes.hesse[:, :3]
    out["plane_deg"] = np.degrees(np.median(np.arcsin(sines(normal, true_normal))))
    offset = scale * result["planes"][:, 3] / np.linalg.norm(result["planes"][:, :3], axis=1) - normal @ shift
    point, plane = truth.relations.point_on_plane.T
    places = truth.points.xyz[point]
    out["plane"] = np.median(np.abs(np.einsum("ni,ni->n", places, normal[plane]) + offset[plane]))
    return {name: float(value) * (1.0 if name.endswith("deg") else 1e3) for name, value in out.items()}


def one_scene(images: int, views: str, seed: int, pythons: dict[str, str]) -> list[dict]:
    """Run all contestants on one scene, in turn."""
    folder = CACHE / f"holistic_{images}_{views}_{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    scene = synthetic.holistic(images, noise_px=1.0, seed=seed, views=views)
    groma.write_scene(scene.start, folder, format="colmap")
    runs = []
    for kind in KINDS:
        for contestant, python in pythons.items():
            result = folder / f"{contestant}_{kind}.npz"
            command = [python, CONTESTANTS / f"{contestant}_holistic.py", folder, kind, result]
            run = run_program([*command, "--warm"] if contestant == "groma" else command)
            if run is not None:
                with np.load(result) as arrays:
                    found = errors(dict(arrays), scene.truth)
                runs.append({**run, "kind": kind, "errors": found})
    shutil.rmtree(folder)
    return runs


def summary(runs: list[dict]) -> list[dict]:
    """Return medians over the seeds by kind and contestant."""
    rows = []
    for kind in KINDS:
        for contestant in ("groma", "limap"):
            mine = [run for run in runs if run["kind"] == kind and run["contestant"] == contestant]
            if mine:
                row = {"kind": kind, "contestant": contestant, "version": mine[0]["version"]}
                for field in ("iterations", "cpu_s", "wall_s", "peak_memory_mib"):
                    row[field] = statistics.median(run[field] for run in mine)
                row["errors"] = {name: statistics.mean(run["errors"][name] for run in mine) for name in ERRORS}
                rows.append(row)
    return rows


def table(results: list[dict]) -> str:
    """Return the results as a Markdown table."""
    lines = [
        "| images | views | adjusted | program | steps | CPU s | times groma | centre | point | line | plane |",
        "|--:|---|---|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for result in results:
        best = {row["kind"]: row["cpu_s"] for row in result["rows"] if row["contestant"] == "groma"}
        for row in result["rows"]:
            e, ratio = row["errors"], row["cpu_s"] / best.get(row["kind"], np.nan)
            lines.append(
                f"| {result['images']} | {result['views']} | {row['kind']} | {row['contestant']} "
                f"| {row['iterations']:.0f} | {row['cpu_s']:.3f} | {ratio:.1f} | {e['centre']:.2f} "
                f"| {e['point']:.2f} | {e['line_deg']:.3f}° {e['line']:.2f} | {e['plane_deg']:.3f}° {e['plane']:.2f} |"
            )
    return "\n".join(lines) + "\n"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python-limap", help="Python that has pylimap; without it groma runs alone")
    parser.add_argument("--images", type=int, nargs="+", default=[100, 200])
    parser.add_argument("--views", nargs="+", choices=("random", "near"), default=["random"])
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    pythons = {"groma": sys.executable}
    if arguments.python_limap:
        pythons["limap"] = str(Path(arguments.python_limap))
    RESULTS.mkdir(exist_ok=True)
    results = []
    for images in arguments.images:
        for views in arguments.views:
            runs = [run for seed in range(arguments.seeds) for run in one_scene(images, views, seed, pythons)]
            results.append({"images": images, "views": views, "seeds": arguments.seeds, "rows": summary(runs)})
            print(table(results[-1:]), flush=True)
    (RESULTS / "holistic.json").write_text(json.dumps({"machine": machine(), "results": results}, indent=1) + "\n")
    print(table(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
