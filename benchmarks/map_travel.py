# SPDX-License-Identifier: BSD-3-Clause
"""How much travels between processes that map together, by kind of work: megabytes there and back.

    python benchmarks/map_travel.py IMAGES --model MODEL --workers 8 [--cluster-size 15]

One process maps as ``mpiexec -n WORKERS groma map`` would divide the work; every piece is turned into bytes and back.
"""

import argparse
import pickle
import tempfile
from collections import defaultdict
from concurrent.futures import Executor, Future
from contextvars import Context
from pathlib import Path

from groma.execution import work_with
from groma.io import read_scene
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions


class Counting(Executor):
    """Does what it is given at once, and counts bytes."""

    def __init__(self, workers: int) -> None:
        self._max_workers = workers
        #: By kind of work: pieces, bytes there, bytes back.
        self.counts: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])

    def submit(self, function, /, *args, **kwargs):
        """See :class:`concurrent.futures.Executor`."""
        there = pickle.dumps((function, args, kwargs), protocol=5)
        sent, given, named = pickle.loads(there)
        found = Context().run(sent, *given, **named)  # as in another process, which has no workers of its own
        work = getattr(args[0], "func", args[0])
        for k, more in enumerate((1, len(there), len(pickle.dumps(found, protocol=5)))):
            self.counts[work.__name__.lstrip("_")][k] += more
        future: Future = Future()
        future.set_result(found)
        return future


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images")
    parser.add_argument("--model", required=True)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cluster-size", type=int, default=MapLinesOptions.cluster_size, help="images of a cluster")
    arguments = parser.parse_args()
    options = MapOptions(threads=1, lines=MapLinesOptions(cluster_size=arguments.cluster_size))
    with tempfile.TemporaryDirectory() as folder, Counting(arguments.workers) as executor, work_with(executor):
        map_images(arguments.images, Path(folder) / "work", read_scene(arguments.model), options)
    print(f"{'work':20s} {'pieces':>7s} {'MB there':>9s} {'MB back':>9s}")
    rows = list(executor.counts.items())
    for name, (pieces, there, back) in [*rows, ("all", [sum(row[k] for _, row in rows) for k in range(3)])]:
        print(f"{name:20s} {pieces:7d} {there / 1e6:9.1f} {back / 1e6:9.1f}")


if __name__ == "__main__":
    main()
