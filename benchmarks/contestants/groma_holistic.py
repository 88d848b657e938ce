# SPDX-License-Identifier: BSD-3-Clause
"""groma on a holistic scene: ``groma_holistic.py FOLDER KIND RESULT.npz [--threads N]``; KIND as in ``holistic.py``.

``--warm`` adjusts once before the timed run, so that kernels are in memory; a peer has been compiled before, too.
"""

from __future__ import annotations

import argparse

import numpy as np
from _common import Clock, report

import groma
from groma.geometry import se3
from groma.scene import Relations


def reduced(scene: groma.Scene, kind: str) -> tuple[groma.Scene, groma.AdjustOptions]:
    """Return the scene with the relations of one kind, and the options."""
    relations = scene.relations
    kept = {
        "points": Relations(),
        "lines": Relations(),
        "planes": Relations(point_on_plane=relations.point_on_plane, line_on_plane=relations.line_on_plane),
        "wireframe": relations,
    }[kind]
    options = groma.AdjustOptions(
        loss="none", lines=kind != "points", planes=kind in ("planes", "wireframe"), max_iterations=100
    )
    return scene.replace(relations=kept), options


def arrays_of(scene: groma.Scene) -> dict[str, np.ndarray]:
    """Return what is compared with the truth, landmarks in the order of their identifiers."""
    return {
        "images": np.array(scene.images.names),
        "poses": se3.to_matrix(scene.cam_from_world)[:, :3],
        "points": scene.points.xyz[np.argsort(scene.points.ids)],
        "lines": scene.lines.segments[np.argsort(scene.lines.ids)],
        "planes": scene.planes.hesse[np.argsort(scene.planes.ids)],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder")
    parser.add_argument("kind", choices=("points", "lines", "planes", "wireframe"))
    parser.add_argument("result")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--warm", action="store_true")
    arguments = parser.parse_args()

    scene, options = reduced(groma.read_scene(arguments.folder), arguments.kind)
    options = groma.AdjustOptions(**{**vars(options), "threads": arguments.threads})
    if arguments.warm:
        groma.adjust(scene, options)
    clock = Clock()
    result = groma.adjust(scene, options)
    times = clock.read()
    np.savez(arguments.result, **arrays_of(result.scene))
    solved = result.report.solve
    report(
        contestant="groma",
        version=groma.__version__,
        **times,
        iterations=solved.iterations,
        initial_cost=solved.initial_cost,
        final_cost=solved.final_cost,
    )


if __name__ == "__main__":
    main()
