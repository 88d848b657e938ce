# SPDX-License-Identifier: BSD-3-Clause
"""How long photographs take to be localised beside finding their features: one after another, and two at once.

    python benchmarks/localize_times.py MAP IMAGES QUERIES [--rounds 3]

``MAP`` was made of ``IMAGES``, ``QUERIES`` is a folder of photographs. Their features are found once, before the clock
starts. Printed are milliseconds a query, of every round: by the wall one after another, the median of these and their
CPU time; then by the wall with two threads, and CPU time. Set ``OPENBLAS_NUM_THREADS=1``.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from groma.localization import localizer as module
from groma.mapping.photographs import image_files, read_gray


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("map", "images", "queries"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    localizer, find = module.Localizer(given.map, given.images), module.find_features
    grays = [read_gray(path) for path in image_files(given.queries)]
    kept: dict[int, object] = {}

    def kept_features(gray: np.ndarray, *others: object) -> object:
        if id(gray) not in kept:
            kept[id(gray)] = find(gray, *others)
        return kept[id(gray)]

    module.find_features = kept_features

    def one(gray: np.ndarray) -> float:
        begin = time.perf_counter()
        localizer.localize(gray)
        return 1e3 * (time.perf_counter() - begin)

    found = [localizer.localize(gray).pose.status for gray in grays]
    print(f"{len(found)} photographs, {found.count('localized')} localized")
    for _ in range(given.rounds):
        alone, wall, cpu = _timed(map, one, grays)
        print(f"one after another {wall:.1f}, median {np.median(alone):.1f}, CPU {cpu:.1f};", end=" ")
        with ThreadPoolExecutor(2) as executor:
            _, wall, cpu = _timed(executor.map, one, grays)
        print(f"two at once {wall:.1f}, CPU {cpu:.1f}")


def _timed(work: Callable[..., Iterable[float]], one: Callable, grays: list) -> tuple[list[float], float, float]:
    """What each photograph took, and milliseconds of wall and CPU time for one of them."""
    wall, cpu = time.perf_counter(), time.process_time()
    each = list(work(one, grays))
    spent = time.perf_counter() - wall, time.process_time() - cpu
    return each, *(1e3 * seconds / len(grays) for seconds in spent)


if __name__ == "__main__":
    main()
