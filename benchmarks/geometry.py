# SPDX-License-Identifier: BSD-3-Clause
"""Throughput of line geometry: Plücker lines made, transformed and projected per CPU second on one thread.

    python benchmarks/geometry.py [--number N] [--rounds N]

groma's public functions on arrays, plain NumPy, and spatialmath, which has an object per line (its environment comes
from ``peers.py spatialmath``). All get the same lines, and the image lines are compared with the pixels of the points
they were made of. Writes ``benchmarks/results/geometry.json`` and ``geometry.md``.
"""

from __future__ import annotations

import argparse
import statistics
import sys

import peers
from _workshop import CONTESTANTS, keep_results, machine, run_program

OPERATIONS = ("made", "transformed", "transformed_and_projected")
#: Image lines pass through the pixels of their points to this fraction of the pixels.
AGREEMENT = 1e-6
#: The peer with an object per line gets this many at most.
MAX_OBJECTS = 2000


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--number", type=int, default=100_000, help="lines at a time")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    programs = {"groma": (sys.executable, arguments.number), "numpy": (sys.executable, arguments.number)}
    python = peers.python_of("spatialmath")
    if python is None:
        print("spatialmath is left out: run python benchmarks/peers.py spatialmath")
    else:
        programs["spatialmath"] = (python, min(arguments.number, MAX_OBJECTS))
    runs: dict[str, list[dict]] = {name: [] for name in programs}
    for _ in range(arguments.rounds):
        for name, (interpreter, number) in programs.items():
            run = run_program([interpreter, CONTESTANTS / "line_geometry.py", name, number])
            if run is None:
                return 1
            runs[name].append(run)
    if runs["groma"][0]["median_error"] > AGREEMENT:
        print(f"groma's image lines miss their points: {runs['groma'][0]['median_error']:.2e}")
        return 1
    rates = {
        name: {kind: statistics.median(row["per_second"][kind] for row in rows) for kind in OPERATIONS}
        for name, rows in runs.items()
    }
    result = {"problem": "geometry", "machine": machine(), "per_second": rates, "metrics": {}}
    result["median_error"] = {name: rows[0]["median_error"] for name, rows in runs.items()}
    result["refused"] = {name: rows[0]["refused"] for name, rows in runs.items()}
    peer = rates.get("spatialmath")
    if peer is not None:
        result["metrics"] = {f"{kind}_ratio_spatialmath": rates["groma"][kind] / peer[kind] for kind in OPERATIONS}
    lines = ["| lines per second | " + " | ".join(rates) + " |", "|---|" + "--:|" * len(rates)]
    for kind in OPERATIONS:
        lines.append(f"| {kind.replace('_', ' ')} | " + " | ".join(f"{row[kind]:.3g}" for row in rates.values()) + " |")
    keep_results("geometry", result, "\n".join(lines))
    for name, error in result["median_error"].items():
        if error > AGREEMENT:
            print(f"{name}: transformed lines miss the transformed points by {error:.1g} of their pixels (median).")
        if result["refused"][name]:
            print(f"{name}: refused {result['refused'][name]} of {runs[name][0]['number']} products.")
    for name, value in result["metrics"].items():
        print(f"{name}: {value:.0f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
