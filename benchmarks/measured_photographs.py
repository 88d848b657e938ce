# SPDX-License-Identifier: BSD-3-Clause
"""Measurements of every kind beside photographs, with one gross error of each: the files, the command, the outcome.

    python benchmarks/measured_photographs.py SCENE [--work FOLDER] [--cases positions "poses and control" ...]
    python benchmarks/measured_photographs.py SCENE --work FOLDER --picture docs/images/measured_fountain.jpg

SCENE is a folder with ``images/``, a model ``sparse_inc/`` in a frame of its own and the survey ``sparse_gt/``. From
the survey come the files that a user would have: positions (2 cm), poses (5 cm, 0.5 degrees), control points (5 mm,
marks of half a pixel), gravity in the cameras (0.3 degrees), distances between control points (2 mm), heights of points
on a plane (5 mm). Of the survey's axes that nearest to the tops of the images becomes z. Every case is one
``groma map``, once with good files and once with gross errors. A row says how far the centres are from the survey, as
they are and after alignment (thousandths of a unit), by how much the scale is off, how far the vertical is tilted
(degrees) and how much too high the cameras are, check points, which gross errors were named, and what else was.
``--picture`` draws what was measured, and what the test names, into a photograph of the case with everything.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma.adjustment.survey.similarity import turn_between
from groma.evaluation import evaluate_poses
from groma.geometry import quaternion
from groma.geometry.algebra import unit
from groma.io import read_scene, write_scene
from groma.scene import Scene, Similarity

#: Standard deviations: of positions, of poses (degrees too), of control points, of marks (pixels), of gravity
#: (degrees), of distances and of heights.
POSITION, POSE, CONTROL, MARK, GRAVITY, DISTANCE, HEIGHT = 0.02, (0.05, 0.5), 0.005, 0.5, 0.3, 0.002, 0.005
#: Gross errors: of a position, of a pose (degrees), of a mark (pixels), of gravity (degrees), of a distance, of a
#: height.
GROSS = {"position": 0.3, "pose": 20.0, "mark": 30.0, "direction": 5.0, "distance": 0.1, "plane": 0.2}
#: What is passed in each case; each file is an option.
CASES = {
    "positions": ("model", "positions"),
    "control": ("model", "control"),
    "poses and control": ("poses", "control"),
    "stated poses and control": ("stated-poses", "control"),
    "gravity and distances": ("model", "marks", "directions", "distances"),
    "gravity, distances, heights": ("model", "marks", "directions", "distances", "known-planes"),
    "positions, control, gravity, distances": ("model", "positions", "control", "directions", "distances"),
    "hold": ("placed", "hold", "marks", "distances"),
}
MODEL = ["--model", "{scene}/sparse_inc"]
OPTIONS = {
    "model": MODEL,
    "placed": ["--model", "{folder}/placed.npz"],
    "poses": ["--poses", "{folder}/transforms.json"],
    "stated-poses": ["--poses", "{folder}/poses.txt", "--camera-model", "PINHOLE", "--camera-params", "{camera}"],
    "positions": ["--positions", "{folder}/positions.txt"],
    "control": ["--control", "{folder}/gcp_list.txt", "--control-sigma", str(CONTROL), "--check", "p6,p7"],
    "marks": ["--control", "{folder}/marks.txt", "--control-sigma", str(CONTROL)],
    "directions": ["--directions", "{folder}/gravity.txt"],
    "distances": ["--distances", "{folder}/distances.txt"],
    "known-planes": ["--known-planes", "{folder}/heights.txt"],
    "hold": ["--hold", "0000.jpg,0010.jpg"],
}


@dataclass(frozen=True, eq=False)
class Truth:
    """The survey, upright, and its control points."""

    scene: Scene
    #: (P, 3) places of the points, and rows of image and pixels of the marks of each.
    xyz: np.ndarray
    marks: list[tuple[np.ndarray, np.ndarray]]


def upright(survey: Scene) -> Scene:
    """Return the survey with the axis as z that is nearest to where the images have their tops: it was levelled."""
    up = -quaternion.to_matrix(survey.cam_from_world[:, :4])[:, 1].mean(axis=0)
    axis = np.sign(up) * (np.abs(up) == np.abs(up).max())
    return survey.transformed(Similarity(1.0, turn_between(axis, np.array([0.0, 0.0, 1.0])), np.zeros(3)))


def truth_of(survey: Scene, count: int = 8) -> Truth:
    """Choose points that many images see, far from each other; the last ones all as high as the first of them."""
    scene, table = upright(survey), survey.point_observations
    seen = np.bincount(table.point_idx, minlength=survey.num_points)
    good = np.flatnonzero(seen >= 5)
    chosen = [int(good[0])]
    while len(chosen) < count:
        apart = np.linalg.norm(scene.points.xyz[good][:, None] - scene.points.xyz[chosen], axis=2).min(axis=1)
        chosen.append(int(good[apart.argmax()]))
    marks = []
    for point in chosen:
        rows = np.flatnonzero(table.point_idx == point)
        marks.append((table.image_idx[rows], table.pixel[rows]))
    return Truth(scene, scene.points.xyz[chosen], marks)


def write_files(truth: Truth, folder: Path, rng: np.random.Generator, wrong: bool) -> dict[str, str]:
    """Write the files; return for each kind of measurement the name of the gross error."""
    scene, xyz = truth.scene, truth.xyz
    names, centers, turns = scene.images.names, scene.cam_centers_in_world, scene.cam_from_world[:, :4]
    count, size = scene.num_images, {kind: length * wrong for kind, length in GROSS.items()}
    gross = {}

    def unlucky(kind: str, number: int) -> int:
        row = int(rng.integers(number))
        gross[kind] = row
        return row

    places = centers + POSITION * rng.normal(size=centers.shape)
    places[unlucky("position", count)] += size["position"] * unit(rng.normal(size=3))
    rows = [f"{n} {x:.4f} {y:.4f} {z:.4f} {POSITION}" for n, (x, y, z) in zip(names, places, strict=True)]
    (folder / "positions.txt").write_text("\n".join(rows))

    given = centers + POSE[0] * rng.normal(size=centers.shape)
    errors = np.radians(POSE[1]) * rng.normal(size=(count, 3))
    errors[unlucky("pose", count)] += np.radians(size["pose"]) * unit(rng.normal(size=3))
    turned = quaternion.multiply(quaternion.exp(errors), turns)
    noisy = scene.keep(points=[]).with_poses(np.hstack([turned, -quaternion.rotate(turned, given)]))
    write_scene(noisy, folder / "transforms.json", force=True)
    world = quaternion.conjugate(turned)
    rows = [
        " ".join([n, *(f"{v:.9f}" for v in (*c, *q)), str(POSE[0]), str(POSE[1])])
        for n, c, q in zip(names, given, world, strict=True)
    ]
    (folder / "poses.txt").write_text("\n".join(rows))
    write_scene(scene.points_only(), folder / "placed.npz", force=True)

    surveyed = xyz + CONTROL * rng.normal(size=xyz.shape)
    bad = unlucky("mark", 5), 1
    with_places, alone = ["local"], ["local"]
    for point, (images, pixels) in enumerate(truth.marks):
        for row, (image, pixel) in enumerate(zip(images, pixels, strict=True)):
            u, v = pixel - 0.5 + MARK * rng.normal(size=2)
            if (point, row) == bad:
                u += size["mark"]
            x, y, z = surveyed[point]
            with_places.append(f"{x:.4f} {y:.4f} {z:.4f} {u:.2f} {v:.2f} {names[image]} p{point}")
            alone.append(f"- - - {u:.2f} {v:.2f} {names[image]} p{point}")
    bad_image = names[truth.marks[bad[0]][0][bad[1]]]
    (folder / "gcp_list.txt").write_text("\n".join(with_places))
    (folder / "marks.txt").write_text("\n".join(alone))

    down = quaternion.rotate(turns, np.tile([0.0, 0.0, -1.0], (count, 1)))
    errors = np.radians(GRAVITY) * rng.normal(size=(count, 3))
    row = unlucky("direction", count)
    errors[row] += np.radians(size["direction"]) * unit(np.cross(down[row], rng.normal(size=3)))
    seen = quaternion.rotate(quaternion.exp(errors), down)
    rows = [f"{n} {x:.5f} {y:.5f} {z:.5f} {GRAVITY}" for n, (x, y, z) in zip(names, seen, strict=True)]
    (folder / "gravity.txt").write_text("\n".join(rows))

    pairs = [(k, (k + 1) % len(xyz)) for k in range(len(xyz))]
    lengths = np.array([np.linalg.norm(xyz[a] - xyz[b]) for a, b in pairs]) + DISTANCE * rng.normal(size=len(pairs))
    lengths[unlucky("distance", len(pairs))] += size["distance"]
    rows = [f"p{a} p{b} {d:.4f} {DISTANCE}" for (a, b), d in zip(pairs, lengths, strict=True)]
    (folder / "distances.txt").write_text("\n".join(rows))

    heights = xyz[:, 2] + HEIGHT * rng.normal(size=len(xyz))
    heights[unlucky("plane", len(xyz))] += size["plane"]
    (folder / "heights.txt").write_text("\n".join(f"p{k} z {z:.4f} {HEIGHT}" for k, z in enumerate(heights)))

    bar = pairs[gross["distance"]]
    return {
        "positions": f"camera position {names[gross['position']]}",
        "poses": f"{names[gross['pose']]}",
        "stated-poses": f"camera pose {names[gross['pose']]}",
        "control": f"mark p{bad[0]} in {bad_image}",
        "marks": f"mark p{bad[0]} in {bad_image}",
        "directions": f"known direction {names[gross['direction']]}",
        "distances": f"distance p{bar[0]} to p{bar[1]}",
        "known-planes": f"known plane p{gross['plane']}",
    }


def run(scene: Path, files: Path, case: str, work: Path, wrong: bool, parts: dict[str, str], truth: Truth) -> str:
    """Map, and return what came out as a row of a table."""
    camera = ",".join(str(value) for value in truth.scene.cameras.params_of(0))
    out = work / f"{case.replace(' ', '-').replace(',', '')}{'-wrong' if wrong else ''}"
    words = [word.format(scene=scene, folder=files, camera=camera) for part in CASES[case] for word in OPTIONS[part]]
    command = [sys.executable, "-m", "groma", "map", f"{scene}/images", *words, "-o", str(out), "--force"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    (work / f"{out.name}.log").write_text(f"{' '.join(command)}\n{done.stdout}{done.stderr}")
    if done.returncode:
        return f"| {case} | {'with gross errors' if wrong else 'good'} | {done.stderr.strip().splitlines()[-1]} |"
    return row(out, case, wrong, parts, truth)


def row(out: Path, case: str, wrong: bool, parts: dict[str, str], truth: Truth) -> str:
    """Return what came out as a row of a table."""
    told = json.loads((out / "summary.json").read_text())
    found, survey = read_scene(out / "scene.npz"), told["survey"]
    row_of = {name: row for row, name in enumerate(truth.scene.images.names)}
    true = truth.scene.cam_centers_in_world[[row_of[name] for name in found.images.names]]
    off = 1e3 * np.linalg.norm(found.cam_centers_in_world - true, axis=1)
    aligned = evaluate_poses(found, truth.scene)
    similarity = aligned.alignment
    tilt = np.degrees(np.arccos(min(1.0, similarity.rotation[2, 2])))
    high = 1e3 * float(np.mean((found.cam_centers_in_world - true)[:, 2]))
    placed = {"positions", "control", "poses", "stated-poses", "placed"} & set(CASES[case])
    named = {f"{one['kind']} {one['name']}" for one in survey["measurements"] if one["is_suspect"]}
    errors = {part: parts[part] for part in CASES[case] if part in parts} if wrong else {}
    hits = [part for part, name in errors.items() if name in named or any(name in one for one in told["warnings"])]
    others = named - set(errors.values())
    components = ", ".join(f"{k} {v:.2f}" for k, v in survey["variance_components"].items() if v is not None)
    checks = "; ".join(f"{1e3 * np.linalg.norm(one['difference']):.1f}" for one in survey["check_points"]) or "–"
    cells = [
        case, "gross errors" if wrong else "good",
        f"{np.sqrt((off**2).mean()):.1f} / {off.max():.1f}" if placed else "–",
        f"{100 * (1.0 / similarity.scale - 1.0):+.3f} %, {tilt:.3f}, {high:+.1f}", f"{aligned.center_rmse * 1e3:.2f}",
        checks, components, f"{len(hits)} of {len(errors)}", ", ".join(sorted(others)) or "–",
    ]  # fmt: skip
    return "| " + " | ".join(cells) + " |"


def draw(scene: Path, out: Path, name: str, target: Path) -> None:
    """Draw marks, distances and gravity of a map into a photograph, red where the test calls them wrong."""
    from PIL import Image, ImageDraw, ImageFont

    found = read_scene(out / "scene.npz")
    survey = json.loads((out / "summary.json").read_text())["survey"]
    wrong = {f"{one['kind']} {one['name']}" for one in survey["measurements"] if one["is_suspect"]}
    image = found.images.names.index(name)
    pose, (fx, fy, cx, cy) = found.cam_from_world[image], found.cameras.params_of(found.images.camera_idx[image])
    inside = quaternion.rotate(pose[None, :4], found.control_points.xyz) + pose[4:]
    at = inside[:, :2] / inside[:, 2:] * [fx, fy] + [cx, cy] - 0.5
    picture = Image.open(scene / "images" / name).convert("RGB")
    picture = Image.blend(picture, Image.new("RGB", picture.size, "white"), 0.25)
    pen, font = ImageDraw.Draw(picture), ImageFont.load_default(30)
    good, bad = "#0b5cad", "#d0281c"

    def say(place: np.ndarray, text: str, colour: str) -> None:
        pen.text(tuple(place), text, fill=colour, font=font, stroke_width=4, stroke_fill="white")

    bars, points = found.distances, found.control_points.names
    for first, second, length in zip(bars.first_idx, bars.second_idx, bars.distance, strict=True):
        is_bad = f"distance {points[first]} to {points[second]}" in wrong
        pen.line([tuple(at[first]), tuple(at[second])], fill=bad if is_bad else good, width=4)
        say((at[first] + at[second]) / 2 + [8, -16], f"{length:.3f}", bad if is_bad else good)
    marks = found.marks
    for row in np.flatnonzero(marks.image_idx == image):
        point, pixel = marks.point_idx[row], marks.pixel[row] - 0.5
        colour = bad if f"mark {points[point]} in {name}" in wrong else good
        u, v = pixel
        pen.line([(u - 16, v), (u + 16, v)], fill=colour, width=4)
        pen.line([(u, v - 16), (u, v + 16)], fill=colour, width=4)
        pen.ellipse([*(at[point] - 9), *(at[point] + 9)], outline=colour, width=4)
        say(pixel + np.array([16.0, 8.0]), points[point], colour)
    down = found.known_directions.in_camera[found.known_directions.idx == image][0]
    start, is_bad = np.array([80.0, 80.0]), f"known direction {name}" in wrong
    end = start + 180.0 * down[:2] / np.linalg.norm(down[:2])
    pen.line([tuple(start), tuple(end)], fill=bad if is_bad else "#2b7a2b", width=6)
    say(end + np.array([12.0, -30.0]), "gravity", bad if is_bad else "#2b7a2b")
    picture.resize((1152, 768), Image.Resampling.LANCZOS).save(target, quality=82)


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--work", type=Path, help="Keep files and maps here.")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, help="Draw the case with everything, from --work, into a photograph.")
    told = parser.parse_args()
    if told.picture:
        draw(told.scene, told.work / "positions-control-gravity-distances-wrong", "0001.jpg", told.picture)
        return
    truth = truth_of(read_scene(told.scene / "sparse_gt"))
    head = (
        "case | files | in place: rms / max | scale, tilt (degrees), height | aligned | check points | shown / stated"
    )
    print(f"| {head} | named | blamed |\n|" + "---|" * 9, flush=True)
    with tempfile.TemporaryDirectory() as own:
        work = told.work or Path(own)
        folders = {False: work / "files", True: work / "files-wrong"}
        parts = {}
        for wrong, files in folders.items():
            files.mkdir(parents=True, exist_ok=True)
            parts = write_files(truth, files, np.random.default_rng(told.seed), wrong)
        for case in told.cases:
            for wrong, files in folders.items():
                print(run(told.scene, files, case, work, wrong, parts, truth), flush=True)


if __name__ == "__main__":
    main()
