# SPDX-License-Identifier: BSD-3-Clause
"""Photographs localised in rendered rooms without any print: by points alone, and with lines; the truth is exact.

    python benchmarks/localize_rooms.py OUT [--seeds 0 1] [--every 2]

A depth camera swings around a room whose walls, boards and boxes have one shade each (:mod:`_turning_worlds`). Every
fourth frame goes into a map of ``groma track``; the other frames are queries, without depth. The world of the map is
aligned to the truth by the poses of its own images. OUT keeps sequences and maps.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from _turning import Renderer, Turning, room_sequence
from localize import held_out

from groma.io import write_scene
from groma.scene import Cameras, Scene

#: Frames of a sequence, and how many of them one map frame stands for.
FRAMES, EACH = 60, 4
#: Patterns of :func:`_turning_worlds.make_room` that are printed, and those of one shade.
PRINTED, SHADES = range(6, 10), 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1])
    parser.add_argument("--every", type=int, default=1, help="take every N-th query")
    given = parser.parse_args()
    for seed in given.seeds:
        told = localized(given.out / f"room_{seed}", seed, given.every)
        for row in told.values():
            row.pop("each")
        print(json.dumps({"seed": seed, **told}, indent=1), flush=True)


def localized(folder: Path, seed: int, every: int) -> dict:
    """Map a room, localise the frames that are not in the map, and compare with the truth."""
    sequence = without_prints(room_sequence(2.0, seed, plain=True, count=FRAMES))
    truth = write(sequence, folder)
    camera = sequence.renderer.camera.params - [0.0, 0.0, 0.5, 0.5]
    command = ["track", str(folder / "mapped"), "-o", str(folder / "map"), "--camera", " ".join(map(str, camera)), "-f"]
    subprocess.run([sys.executable, "-m", "groma", *command], check=True, stdout=subprocess.DEVNULL)
    return held_out(folder / "map", folder / "mapped" / "rgb", truth, True, every)


def without_prints(sequence: Turning) -> Turning:
    """The same with plain shades in place of prints: there is hardly anything but edges."""
    world = sequence.renderer.world
    world.pattern = [SHADES + number % 5 if number in PRINTED else number for number in world.pattern]
    return replace(sequence, renderer=Renderer(world, sequence.renderer.camera))


def write(sequence: Turning, folder: Path) -> Path:
    """Write all images, a TUM sequence of those of the map, and the scene of the true poses, whose path is returned."""
    names = []
    lists: dict[str, list[str]] = {"rgb": [], "depth": []}
    for k, frame in enumerate(sequence):
        for kind, image in (("rgb", frame.gray), ("depth", np.round(frame.depth * 5000.0).astype(np.uint16))):
            (folder / "mapped" / kind).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / "mapped" / kind / f"{k:04d}.png"), image)
            if k % EACH == 0:
                lists[kind].append(f"{frame.timestamp:.6f} {kind}/{k:04d}.png\n")
        names.append(f"{k:04d}.png")
    for kind, rows in lists.items():
        (folder / "mapped" / f"{kind}.txt").write_text("".join(rows))
    model = sequence.renderer.camera
    cameras = Cameras(
        np.array([1]), ("PINHOLE",), model.params[None], np.array([model.width]), np.array([model.height])
    )
    scene = Scene.from_images(cameras, names, np.zeros(len(names), int), sequence.poses)
    write_scene(scene, folder / "truth.npz", force=True)
    return folder / "truth.npz"


if __name__ == "__main__":
    main()
