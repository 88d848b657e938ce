# SPDX-License-Identifier: BSD-3-Clause
"""Files of measurements with the mistakes that people make, each passed to ``groma adjust`` once: what it says.

    python benchmarks/files_that_do_not_fit.py

A made scene of eight photographs, its positions, control points, gravity, poses, heights and a distance; all files are
right but for what the first column says. A row has the options and, refused or not, the words of the command.
"""

import argparse
import contextlib
import io
import json
import os
import shlex
import sys
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "scene"))
from _survey import ELSEWHERE, control, made, positions

from groma.cli.main import run
from groma.geometry import quaternion
from groma.io import write_scene

#: What is wrong, and the options with it.
CASES = {
    "names of other photographs": "--positions names.txt",
    "names with another ending": "--positions ending.txt",
    "left-handed axes": "--positions left.txt",
    "x and y exchanged": "--positions exchanged.txt",
    "heights in feet": "--positions heights.txt",
    "no accuracy": "--positions bare.txt",
    "decimal commas": "--positions commas.txt",
    "longitude and latitude exchanged, in a header": "--positions exchanged.csv",
    "longitude and latitude exchanged, EPSG:4326": "--positions exchanged-4326.txt",
    "degrees where metres are expected": "--positions degrees.txt",
    "degrees under a projected system": "--positions degrees-utm.txt",
    "metres under EPSG:4326": "--positions metres-4326.txt",
    "a system that does not exist": "--positions unknown-system.txt",
    "a local and a projected system": "--positions good.txt --control utm.txt --control-sigma 0.02",
    "a file that is not there": "--positions nothing.txt",
    "control points for positions": "--positions control.txt",
    "control points in feet": "--positions good.txt --control feet.txt --control-sigma 0.02",
    "control points in millimetres": "--positions good.txt --control mm.txt --control-sigma 0.02",
    "marks of larger photographs": "--control marks.txt --control-sigma 0.02",
    "no coordinate system": "--control no-system.txt --control-sigma 0.02",
    "control points without accuracy": "--control control.txt",
    "marks in other photographs": "--control other.txt --control-sigma 0.02",
    "a distance in millimetres": "--control control.txt --control-sigma 0.02 --distances mm.csv",
    "a distance of an unknown mark": "--control control.txt --control-sigma 0.02 --distances unknown.csv",
    "a distance of a line that is not there": "--control control.txt --control-sigma 0.02 --distances line.csv",
    "gravity upwards": "--directions up.txt",
    "gravity upwards, beside positions": "--positions good.txt --directions up.txt",
    "gravity in the axes of OpenGL, beside positions": "--positions good.txt --directions opengl.txt",
    "gravity of photographs stored turned, beside positions": "--positions good.txt --directions turned.txt",
    "poses of the world in the camera": "--poses inverse.txt --pose-sigma 0.02,0.3",
    "poses with the axes of OpenGL": "--poses opengl-poses.txt --pose-sigma 0.02,0.3",
    "poses with qw first": "--poses wxyz.txt --pose-sigma 0.02,0.3",
    "poses with left-handed places": "--poses left-poses.txt --pose-sigma 0.02,0.3",
    "a plane without a normal": "--known-planes planes.txt",
}
UTM = np.array([4e5, 5.4e6, 200.0])


def write(folder: Path, name: str, rows: Iterable[Sequence[object]], first: str = "", mark: str = " ") -> None:
    """Write rows of words, after a first line."""
    lines = [mark.join(f"{word:.9g}" if isinstance(word, float) else str(word) for word in row) for row in rows]
    (folder / name).write_text("\n".join([first, *lines] if first else lines))


def write_files(folder: Path) -> None:
    """Write the scene and all files."""
    truth, rng = made()[0], np.random.default_rng(5)
    write_scene(truth.transformed(ELSEWHERE), folder / "scene.npz")
    names, xyz = truth.images.names, positions(truth, rng).xyz
    points, marks, _ = control(truth, rng)
    turn, centers = truth.cam_from_world[:, :4], truth.cam_centers_in_world
    _write_positions(folder, names, xyz)

    def with_marks(name: str, factor: float = 1.0, size: float = 1.0, first: str = "local", of=names) -> None:
        seen = zip(marks.image_idx, marks.point_idx, marks.pixel * size - 0.5, strict=True)
        rows = [
            [*map(float, points.measured[p] * factor), float(u), float(v), of[i], points.names[p]]
            for i, p, (u, v) in seen
        ]
        write(folder, name, rows, first)

    with_marks("control.txt")
    with_marks("utm.txt", first="EPSG:32633")
    with_marks("feet.txt", factor=1.0 / 0.3048)
    with_marks("mm.txt", factor=1000.0)
    with_marks("marks.txt", size=4.0)
    with_marks("no-system.txt", first="")
    with_marks("other.txt", of=[f"DSC_{k:04d}.JPG" for k in range(len(names))])
    bar = float(np.linalg.norm(points.measured[1] - points.measured[0]))
    for name, row in (
        ("mm", ["p0", "p1", 1e3 * bar, 2]),
        ("unknown", ["p0", "p99", bar, 0.01]),
        ("line", ["line:5", "p1", bar, 0.01]),
    ):
        write(folder, f"{name}.csv", [row], mark=",")

    down = quaternion.rotate(turn, np.tile([0.0, 0.0, -1.0], (len(names), 1)))
    for name, seen in (("up", -down), ("opengl", down * [1, -1, -1]), ("turned", down[:, [1, 0, 2]] * [-1, 1, 1])):
        write(folder, f"{name}.txt", [[n, *map(float, v), 0.5] for n, v in zip(names, seen, strict=True)])

    world = quaternion.conjugate(turn)
    poses = {
        "inverse": (truth.cam_from_world[:, 4:], turn), "wxyz": (centers, world[:, [3, 0, 1, 2]]),
        "opengl-poses": (centers, quaternion.multiply(world, np.tile([1.0, 0, 0, 0], (len(names), 1)))),
        "left-poses": (centers * [1, -1, 1], world),
    }  # fmt: skip
    for name, (places, turns) in poses.items():
        write(
            folder,
            f"{name}.txt",
            [[n, *map(float, c), *map(float, q)] for n, c, q in zip(names, places, turns, strict=True)],
        )
    write(folder, "planes.txt", [[n, "h", float(z), 0.01] for n, z in zip(names, centers[:, 2], strict=True)])


def _write_positions(folder: Path, names: Sequence[str], xyz: np.ndarray) -> None:
    def rows(places: np.ndarray, of: Sequence[str] = names) -> list[list[object]]:
        return [[n, *map(float, place), 0.02] for n, place in zip(of, places, strict=True)]

    east, north = 13.6 + xyz[:, :1] / (111320.0 * np.cos(np.radians(48.7))), 48.7 + xyz[:, 1:2] / 111207.0
    height = xyz[:, 2:] + UTM[2]
    degrees, exchanged = np.hstack([east, north, height]), np.hstack([north, east, height])
    head = "name,longitude,latitude,altitude,accuracy"
    write(folder, "good.txt", rows(xyz))
    write(folder, "names.txt", rows(xyz, [f"DSC_{k:04d}.JPG" for k in range(len(names))]))
    write(folder, "ending.txt", rows(xyz, [name.replace(".png", ".JPG") for name in names]))
    write(folder, "left.txt", rows(xyz * [1, -1, 1]))
    write(folder, "exchanged.txt", rows(xyz[:, [1, 0, 2]]))
    write(folder, "heights.txt", rows(xyz * [1, 1, 1 / 0.3048]))
    write(folder, "bare.txt", [row[:4] for row in rows(xyz)])
    write(folder, "commas.txt", [[str(word).replace(".", ",") for word in row] for row in rows(np.round(xyz, 3))])
    write(folder, "exchanged.csv", rows(exchanged), head, ",")
    write(folder, "exchanged-4326.txt", rows(exchanged), "EPSG:4326")
    write(folder, "degrees.txt", rows(degrees))
    write(folder, "degrees-utm.txt", rows(degrees), "EPSG:32633")
    write(folder, "metres-4326.txt", rows(xyz + UTM), "EPSG:4326")
    write(folder, "unknown-system.txt", rows(xyz + UTM), "EPSG:99999")


def said(options: str) -> tuple[str, str]:
    """Return ``refused`` or ``adjusted``, and what the command says of the files."""
    out, errors = io.StringIO(), io.StringIO()
    words = ["adjust", "scene.npz", "-o", "out.npz", "--json", "out.json", "--force", *shlex.split(options)]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        code = run(words)
    lines = errors.getvalue().strip().splitlines()
    if code:
        return "refused", " / ".join(lines)
    notes = json.loads(Path("out.json").read_text())["survey"]["notes"]
    return "adjusted", " / ".join([*notes, *lines])


def main() -> None:
    """Print a table."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    print("| what is wrong | passed | | what is said |\n|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as place:
        os.chdir(place)
        write_files(Path(place))
        for what, options in CASES.items():
            print(f"| {what} | `{options}` | {' | '.join(said(options))} |", flush=True)
        os.chdir("/")


if __name__ == "__main__":
    main()
