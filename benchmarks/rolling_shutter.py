# SPDX-License-Identifier: BSD-3-Clause
"""Simulated images read row by row: poses and motions against the truth, with and without ``--rolling-shutter``.

    python benchmarks/rolling_shutter.py --draws 5
    python benchmarks/rolling_shutter.py --rendered

Pixels are exact, by the row where they appear (the row decides when, and the pose then decides the row), with noise of
0.3 pixels. *Photographs*: 12 around a box 7 units away, every third upright, motions of 0.03 units and 1 degree in each
coordinate. *Video*: 24 images of a smooth path, upright, read in 0.6 of the time to the next. Start: poses 0.03 units
and 0.3 degrees off. A row says, as means over the draws: rms of the centres (thousandths of a unit) and mean of the
rotations (degrees) without and with motions, rms of the turns that were estimated (degrees), and the share of the time
between images.

``--rendered`` renders eight photographs (480 x 360 pixels) of a corner of a house, row by row while the camera moves by
0.05 units and turns by 1.2 degrees in each coordinate, and maps them with known calibration from nothing else.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "scene"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "features"))

from _facade import FOCAL, HEIGHT, WIDTH, facade
from _rolling import disturbed, photographs, rolling_scene, video

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.rolling_shutter import adjust_rolling_shutter, with_rolling_shutter
from groma.evaluation import evaluate_poses
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions

CASES = {"photographs": lambda seed: photographs(seed=seed), "video": lambda seed: video()}


def rendered() -> None:
    """Map rendered photographs with and without motions, and print a table."""
    rng = np.random.default_rng(3)
    motions = np.hstack([rng.normal(0.0, 0.05, (8, 3)), rng.normal(0.0, np.radians(1.2), (8, 3))])
    known = {"camera_model": "SIMPLE_PINHOLE", "camera_params": (FOCAL, WIDTH / 2, HEIGHT / 2)}
    print("| photographs | centres | rotations | lines | points, px | lines, px |\n|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as place:
        truth = facade(Path(place) / "images", 8, motions=motions)
        for name, along in (("taken at once", None), ("--rolling-shutter rows", "rows")):
            told = MapOptions(**known, rolling_shutter=along, seed=0)
            found = map_images(Path(place) / "images", Path(place) / f"work {along}", None, told)
            errors, rms = evaluate_poses(found.scene, truth), found.report.inliers
            print(
                f"| {name} | {1e3 * errors.center_rmse:.1f} | {errors.rotation_deg_mean:.2f} | {found.scene.num_lines} "
                f"| {rms['points']['rmse_px']['after']:.2f} | {rms['lines']['rmse_px']['after']:.2f} |",
                flush=True,
            )


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--rendered", action="store_true")
    chosen = parser.parse_args()
    if chosen.rendered:
        rendered()
        return
    draws = chosen.draws
    told = AdjustOptions(point_sigma_px=0.3, line_sigma_px=0.3)
    print("| images | landmarks | centres: at once | rolling | rotations: at once | rolling | turns | share |")
    print("|---|---|---|---|---|---|---|---|")
    for name, make in CASES.items():
        for landmarks, lines in (("250 points", 0), ("250 points, 100 lines", 100)):
            rows = []
            for seed in range(draws):
                poses, motions = make(seed)
                truth = rolling_scene(poses, motions, seed=seed, lines=lines)
                start = disturbed(truth, seed=seed)
                found = adjust_rolling_shutter(with_rolling_shutter(start), told)
                plain = evaluate_poses(adjust(start, told).scene, truth)
                ours = evaluate_poses(found.result.scene, truth)
                off = found.result.scene.camera_motions.motion[:, 3:] - motions[:, 3:]
                turn = np.degrees(np.sqrt(np.mean(off**2)))
                rows.append(
                    [
                        1e3 * plain.center_rmse, 1e3 * ours.center_rmse, plain.rotation_deg_mean,
                        ours.rotation_deg_mean, turn, found.motions.share,
                    ]
                )  # fmt: skip
            a, b, c, d, e, f = np.mean(rows, axis=0)
            print(f"| {name} | {landmarks} | {a:.1f} | {b:.1f} | {c:.2f} | {d:.3f} | {e:.3f} | {f:.2f} |", flush=True)


if __name__ == "__main__":
    main()
