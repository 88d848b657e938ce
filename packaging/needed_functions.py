# SPDX-License-Identifier: BSD-3-Clause
"""Record which compiled functions the commands call: src/groma/compilation/needed.json.

    python packaging/needed_functions.py

Each kind of work is done on a small instance, in a process of its own that compiles nothing (another has done so
before), and the cache is asked what was called. Run it after a function that Python calls was added or renamed, or
takes other arguments; tests/cli/test_first_run.py notices.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from groma._kernels import cache as kernel_cache
from groma.cli.main import run
from groma.compilation import loading
from groma.compilation.ahead import mapping
from groma.compilation.needed import PLACE, Entry, function, points_of, read_type
from groma.compilation.runs import ESTIMATED, HELD


def _adjust(folder: Path) -> None:
    from groma.io import write_scene
    from groma.scene import synthetic

    write_scene(synthetic.holistic(8, seed=1).start, folder / "start.npz")
    run(["adjust", str(folder / "start.npz"), "-o", str(folder / "out"), "--quiet"])


def _adjust_points(folder: Path, model: str, is_estimated: bool) -> None:
    from groma.compilation import runs
    from groma.io import write_scene
    from groma.scene import synthetic

    start = synthetic.holistic(40, seed=1).start.points_only()
    place = runs.with_own_cameras if model == "BAL" else runs.with_model
    write_scene(place(start, model), folder / "start.npz")
    calibration = "--refine-intrinsics" if is_estimated else "--fix-intrinsics"
    run(["adjust", str(folder / "start.npz"), "-o", str(folder / "out"), calibration, "--quiet"])


def _map(folder: Path) -> None:
    run(["demo", "-o", str(folder / "demo"), "--quiet"])


def _map_held(folder: Path) -> None:
    from groma.evaluation import cabinet
    from groma.io import read_scene, write_scene

    write_scene(read_scene(cabinet.folder() / "model").subset(range(12)), folder / "model.npz")
    held = ["--model", str(folder / "model.npz"), "--fix-poses", "-o", str(folder / "held"), "--quiet"]
    run(["map", str(cabinet.folder() / "images"), *held])


def _track(folder: Path) -> None:
    from groma.compilation.runs import RUNS

    for _, step in RUNS["track"]():
        step()


def _localize(folder: Path) -> None:
    from groma.evaluation import cabinet
    from groma.io import read_scene
    from groma.localization.localizer import Localizer

    call = [sys.executable, "-W", "ignore", "-m", "groma.cli.main", "demo", "-o", str(folder / "demo"), "--quiet"]
    subprocess.run(call, check=True)  # elsewhere: what it calls is not what localising calls
    scene, images = read_scene(folder / "demo" / "scene.npz"), cabinet.folder() / "images"
    Localizer(scene.subset(range(16)), images).localize(images / scene.images.names[20])


def _pose_graph(folder: Path) -> None:
    import numpy as np

    from groma.adjustment.graphs.pose_graph import PoseGraphOptions, adjust_pose_graph
    from groma.io.g2o import read_g2o

    rows, diagonal = [], " ".join("1" if i == j else "0" for i in range(6) for j in range(i, 6))
    for k in range(12):
        angle = 2 * np.pi * k / 12
        rows.append(f"VERTEX_SE3:QUAT {k} {np.cos(angle):.3f} {np.sin(angle) + 0.02 * k:.3f} 0 0 0 0 1")
    for k in range(12):
        rows.append(f"EDGE_SE3:QUAT {k} {(k + 1) % 12} 0.5 0.1 0 0 0 0 1 {diagonal}")
    (folder / "graph.g2o").write_text("\n".join(rows) + "\n", encoding="utf-8")
    for solver in ("auto", "sparse"):  # the latter is what large graphs get
        adjust_pose_graph(read_g2o(folder / "graph.g2o"), PoseGraphOptions(linear_solver=solver))


def _selfcheck(folder: Path) -> None:

    run(["selfcheck", "--quiet"])


#: Work that is known, and small instances of it.
WORK: dict[str, Callable[[Path], None]] = {
    "adjust": _adjust,
    mapping(True): _map,
    mapping(False): _map_held,
    "track": _track,
    "selfcheck": _selfcheck,
    "localize": _localize,
    "pose graph": _pose_graph,
}
WORK |= {
    points_of(model, is_estimated): partial(_adjust_points, model=model, is_estimated=is_estimated)
    for models, is_estimated in ((HELD, False), ((*ESTIMATED, "BAL"), True))
    for model in models
}


def _is_readable(kind: Any) -> bool:
    try:
        return bool(read_type(repr(kind)) == kind)
    except Exception:
        return False


def record(work: str) -> list[Entry]:
    """Do some work and return what it called; in a process that compiles nothing and has done nothing before."""
    loading.needed = lambda work: []  # what the last list names is loaded beside the work, called or not
    with tempfile.TemporaryDirectory() as folder:
        WORK[work](Path(folder))
    if kernel_cache.counts.compiled:
        raise RuntimeError(f"Functions had to be compiled, which others than Python call; record {work!r} once more.")
    used = kernel_cache.used_functions()
    own = [entry for entry in used if entry[0].startswith("groma.") and function(*entry[:2]) is not None]
    return [entry for entry in own if all(map(_is_readable, entry[2]))]


def _listed(entries: dict[str, list[Entry]]) -> dict[str, Any]:
    """Return what is written, with modules and types by number."""
    modules = sorted({module for found in entries.values() for module, _, _ in found})
    kinds = sorted({repr(kind) for found in entries.values() for _, _, chosen in found for kind in chosen})
    rows = {
        work: [[modules.index(module), name, [kinds.index(repr(kind)) for kind in chosen]]
               for module, name, chosen in found]
        for work, found in entries.items()
    }  # fmt: skip
    return {"modules": modules, "types": kinds, "work": rows}


def _record_elsewhere(work: str) -> list[Entry]:
    """Record some work in a process of its own, after another has compiled it."""
    call = [sys.executable, "-W", "ignore", __file__, work]
    subprocess.run(call, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    said = json.loads(subprocess.run(call, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
    return [(module, name, tuple(map(read_type, kinds))) for module, name, kinds in said]


def main() -> None:
    """Record everything, or only say what one kind of work calls."""
    if len(sys.argv) > 1:
        found = [(module, name, [repr(kind) for kind in kinds]) for module, name, kinds in record(sys.argv[1])]
        print(json.dumps(found))
        return
    listed = _listed({work: _record_elsewhere(work) for work in WORK})
    PLACE.write_text(json.dumps(listed, separators=(",", ":")).replace("]],", "]],\n") + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
