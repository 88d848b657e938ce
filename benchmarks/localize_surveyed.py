# SPDX-License-Identifier: BSD-3-Clause
"""Photographs left out of maps of surveyed scenes: how far from the survey they are localised, and how far is stated.

    python benchmarks/localize_surveyed.py SCENE ... --work FOLDER [--every 5]

SCENE is a folder with ``images/`` and the survey ``sparse_gt/``. Every fifth photograph is left out; the others are
mapped with the poses of the survey held (``groma map --poses sparse_gt --fix-poses``). *Held noise* is what the map's
points say of the held poses: a coordinate of the centre (thousandths of a unit), an axis of the rotation. *Ratio* is
the distance from the survey over the stated deviation, median; *squared* the mean squared error over six degrees of
freedom in units of the stated covariance, 1 is right. Both by points, then with lines.
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from localize import held_out

from groma.io import read_scene
from groma.localization.errors.held_poses import held_poses


def row(folder: Path, work: Path, every: int) -> str:
    """Map, localise, and return a row of the table."""
    images, out = work / "images", work / "map"
    shutil.rmtree(work, ignore_errors=True)
    images.mkdir(parents=True)
    names = sorted(read_scene(folder / "sparse_gt").images.names)
    for name in set(names) - set(names[::every]):
        shutil.copy(folder / "images" / name, images / name)
    command = [sys.executable, "-m", "groma", "map", images, "--poses", folder / "sparse_gt", "--fix-poses", "-o", out]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    told = held_out(out, folder / "images", folder / "sparse_gt", align=False)
    noise = held_poses(read_scene(out / "scene.npz")).sigma
    both = [told["points"], told["points and lines"]]
    cells = [
        f"{folder.name}, {len(names[::every])} of {len(names)} left out",
        " / ".join(f"{one['localized']} of {one['queries']}" for one in both),
        f"{1e3 * noise[0]:.1f}, {np.degrees(noise[1]):.3f}°",
        *(
            " / ".join(f"{factor * one[key]:{form}}" for one in both)
            for key, factor, form in (
                ("median m", 1e3, ".1f"),
                ("median error over stated", 1, ".2f"),
                ("mean squared error over stated, of six degrees", 1, ".2f"),
            )
        ),
    ]
    return "| " + " | ".join(cells) + " |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--work", type=Path, required=True, help="keep the maps here")
    parser.add_argument("--every", type=int, default=5)
    given = parser.parse_args()
    print("| map | localised | held noise | error, median | ratio | squared |\n|---|---|---|---|---|---|")
    for folder in given.scenes:
        print(row(folder, given.work / folder.name, given.every), flush=True)


if __name__ == "__main__":
    main()
