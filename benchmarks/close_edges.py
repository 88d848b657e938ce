# SPDX-License-Identifier: BSD-3-Clause
"""Places of edges that have another edge beside them: as fitted in the smoothed image, and placed again.

    python benchmarks/close_edges.py [--draws 24]
    python benchmarks/close_edges.py IMAGES ... [--photographs 2]

Without folders: pictures of two steps that are known exactly (50 px long, contrast 80, noise 2, random angle and
place). A row says how far from the edge its segment is fitted (positive: towards the neighbour), mean and standard
deviation over the draws, the stated deviation, and the root mean square of the errors over the stated deviations. Draws
whose segment is fitted to the neighbour are left out, and counted.

With folders of photographs: segments found in the halved photograph, against the same segments fitted in the photograph
as it is, where neighbours are twice as far apart. Median and root mean square of the distance across, halved pixels.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np
from scipy.special import ndtr

from groma.features import LsdDetector
from groma.features.close_edges import placed
from groma.features.edge_fit import EDGES, measure_edges
from groma.features.images import to_gray

#: Side of a picture, length of a segment, pixels; contrast and noise, grey levels; samples of a pixel each way.
SIZE, LENGTH, CONTRAST, NOISE, SAMPLES = 96, 50.0, 80.0, 2.0, 8
#: Height of the second step over that of the first; blur, distances, pixels.
CASES = [
    ("opposite, equal", -1.0, 0.5, (1.0, 1.5, 2.0, 3.0, 4.0)),
    ("opposite, equal", -1.0, 0.8, (1.0, 1.5, 2.0, 3.0, 4.0)),
    ("opposite, half", -0.5, 0.5, (1.0, 1.5, 2.0, 3.0)),
    ("same sign, half", 0.5, 0.5, (1.0, 2.0, 3.0)),
    ("none", 0.0, 0.5, (40.0,)),
    ("none", 0.0, 2.5, (40.0,)),
]


def picture(angle: float, offsets: tuple[float, float], heights: tuple[float, float], blur: float) -> np.ndarray:
    """Return blurred steps across parallel lines, integrated over pixels."""
    at = (np.arange(SIZE * SAMPLES) + 0.5) / SAMPLES - SIZE / 2
    across = at[:, None] * np.cos(angle) - at[None] * np.sin(angle)
    fine = sum(height * ndtr((across - offset) / blur) for offset, height in zip(offsets, heights, strict=True))
    return 90.0 - min(0.0, heights[1]) / 2 + np.reshape(fine, (SIZE, SAMPLES, SIZE, SAMPLES)).mean(axis=(1, 3))


def errors(ratio: float, blur: float, distance: float, draws: int) -> np.ndarray:
    """Return offsets towards the neighbour and stated deviations (draws, 2, 2), smoothed and placed again."""
    rng, rows = np.random.default_rng(0), []
    for _ in range(draws):
        angle, at, side = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(-1.0, 1.0), rng.choice([-1.0, 1.0])
        exact = picture(angle, (at, at + side * distance), (CONTRAST, CONTRAST * ratio), blur)
        image = np.clip(np.round(exact + rng.normal(0.0, NOISE, exact.shape)), 0, 255).astype(np.uint8)
        along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
        middle = SIZE / 2 + (at + rng.normal(0.0, 0.2)) * across
        start = np.concatenate([middle - 0.5 * LENGTH * along, middle + 0.5 * LENGTH * along])[None]
        fitted = measure_edges(image, start)[:2]
        both = (fitted, placed(image, *fitted))
        if (fitted[0][0, 2:] - fitted[0][0, :2]) @ along < 0.0:
            continue  # an edge of the other direction: the neighbour
        rows.append(
            [(side * (((ends.reshape(2, 2) - SIZE / 2) @ across).mean() - at), sigma[0]) for ends, sigma in both]
        )
    return np.array(rows)


def halved(path: Path) -> np.ndarray:
    """Return distances (N, 2) of a photograph's segments, smoothed and placed again, from those at its full size."""
    gray = to_gray(cv2.imread(str(path)))
    whole = gray[: gray.shape[0] // 2 * 2, : gray.shape[1] // 2 * 2]
    half = cv2.resize(whole, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    found = LsdDetector(min_length=12.0).detect(half)
    smooth = found.ends.reshape(-1, 4), found.sigma
    true, sigma, _ = measure_edges(whole, 2.0 * smooth[0])
    good = (sigma < EDGES.unfitted_sigma) & (smooth[1] < EDGES.unfitted_sigma)
    middle = 0.25 * (true[:, :2] + true[:, 2:])
    across = (true[:, 2:] - true[:, :2])[:, ::-1] * (-1.0, 1.0)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    away = [
        ((0.5 * (ends[:, :2] + ends[:, 2:]) - middle) * across).sum(axis=1)
        for ends, _ in (smooth, placed(half, *smooth))
    ]
    return np.stack(away, axis=1)[good]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", type=Path, nargs="*", help="folders of photographs")
    parser.add_argument("--draws", type=int, default=24)
    parser.add_argument("--photographs", type=int, default=2, help="of each folder, the first ones")
    given = parser.parse_args()
    if given.images:
        print("| photographs | segments | smoothed: median, rms, px | placed again |\n|---|--:|--:|--:|")
    else:
        print("| neighbour, blur | distance | smoothed: offset | stated | rms / stated ", end="")
        print("| placed again: offset | stated | rms / stated | left out |")
        print("|---|--:|--:|--:|--:|--:|--:|--:|--:|")
    for folder in given.images:
        paths = sorted(path for path in folder.iterdir() if path.suffix.lower() in (".jpg", ".png"))
        away = np.vstack([halved(path) for path in paths[: given.photographs]])
        cells = [f"{np.median(np.abs(one)):.3f}, {np.sqrt(np.mean(one**2)):.3f}" for one in away.T]
        print(f"| {folder} | {len(away)} | " + " | ".join(cells) + " |", flush=True)
    for name, ratio, blur, distances in CASES if not given.images else ():
        for distance in distances:
            found, cells = errors(ratio, blur, distance, given.draws), []
            for off, sigma in np.moveaxis(found, 0, 2):
                ratios = np.sqrt(np.mean((off / sigma) ** 2))
                cells.append(f"{off.mean():+.2f} ± {off.std():.2f} | {np.median(sigma):.2f} | {ratios:.1f}")
            cells.append(str(given.draws - len(found)))
            print(f"| {name}; blur {blur} | {distance:g} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
