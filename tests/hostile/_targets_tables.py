# SPDX-License-Identifier: BSD-3-Clause
"""Targets: tables of numbers. Trajectories, pose graphs, references, matches of lines, summaries."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from _mutations import gzip_stored
from _targets import Made, npy, npz, one

from groma.features.external import read_matches
from groma.io import read_g2o, read_trajectory
from groma.io.reference import holds_scene, read_line3dpp, read_reference
from groma.scene import synthetic
from groma.viz.report.page import PageContents, write_report
from groma.viz.report.saved import saved_report


def made(home: Path) -> Iterator[Made]:
    """Yield all targets of this module."""
    yield from _texts()
    yield from _arrays()


TUM = b"# time x y z q\n" + b"".join(b"%d.5 1 2 3 0 0.6 0 0.8\n" % row for row in range(6))
KITTI = b"".join(b"1 0 0 %d 0 1 0 0.5 0 0 1 2.5\n" % row for row in range(6))
EUROC = b"#time\n" + b"".join(b"140363657976%d000000,1,2,3,0.8,0,0.6,0,1,1,1\n" % row for row in range(6))
G2O_3D = b"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\nVERTEX_SE3:QUAT 1 1 0 0 0 0 0 1\nFIX 0\nPARAMS_SE3OFFSET 0 0\n" + (
    b"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 " + b"4 0 0 0 0 0 4 0 0 0 0 4 0 0 0 9 0 0 9 0 9\n"
)
G2O_2D = b"VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0.1\nEDGE_SE2 0 1 1 0 0.1 4 0 0 4 0 9\n" + (
    b"EDGE_SE2 1 0 1 0 0.1 4 0 0 4 0 9\n"
)
LINE3D = b"0 0 0 1 0 0 2 a.png 1 2 3 4 b.png 5 6 7 8\n1 0 0 1 0 1 0\n"
OBJ = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\nf -1 -2 -3\nl 1 2 3\n"
PLY = b"""ply
format ascii 1.0
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
element edge 1
property int vertex1
property int vertex2
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
0 1
"""


def _texts() -> Iterator[Made]:
    for name, content in (("tum", TUM), ("kitti", KITTI), ("euroc", EUROC)):
        yield f"trajectory_{name}", {"a.txt": content}, one(read_trajectory, "a.txt")
        yield f"trajectory_{name}_gz", {"a.gz": gzip_stored(content)}, one(read_trajectory, "a.gz")
    for name, content in (("g2o_3d", G2O_3D), ("g2o_2d", G2O_2D), ("g2o_gz", gzip_stored(G2O_3D))):
        yield name, {"a.g2o": content}, one(read_g2o, "a.g2o")
    body = (
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
        + b"\3"
        + np.array([0, 1, 2, 0, 1], "<i4").tobytes()
    )
    head = PLY[: PLY.index(b"end_header") + 11].replace(b"ascii", b"binary_little_endian")
    for name, content in (("ply", PLY), ("ply_binary", head + body), ("obj", OBJ), ("line3dpp", LINE3D)):
        file = {"ply_binary": "a.ply", "line3dpp": "a.txt"}.get(name, f"a.{name}")
        yield name, {file: content}, one(read_reference, file)
    yield "line3dpp_lines", {"a.txt": LINE3D}, one(read_line3dpp, "a.txt")
    yield "segments_txt", {"a.txt": b"0 0 0 1 0 0\n1 2 3 4 5 6\n"}, one(read_reference, "a.txt")
    yield "summary", {"summary.json": _summary()}, _page


def _summary() -> bytes:
    from groma.adjustment.adjust import AdjustOptions, adjust

    scene = synthetic.holistic(4, seed=1).start
    return json.dumps(adjust(scene, AdjustOptions(max_iterations=2)).summary()).encode()


PAGE_SCENE = synthetic.holistic(4, seed=1).start.points_only()


def _page(folder: Path) -> object:
    report = saved_report(folder)
    if report is not None:
        contents = PageContents(report.outcomes, report.explanation)
        write_report(folder / "page.html", None, PAGE_SCENE, report, contents=contents)
    return report


def _reference(folder: Path) -> object:
    return holds_scene(folder / "a.npz"), read_reference(folder / "a.npz")


def _arrays() -> Iterator[Made]:
    rng = np.random.default_rng(1)
    corners, segments = rng.normal(size=(5, 3)), rng.normal(size=(4, 6))
    graphs = {
        "graph": npz(points=corners, edges=[[0, 1], [2, 3]]),
        "mesh": npz(vertices=corners, faces=[[0, 1, 2, 3]]),
        "lines": npz(lines=segments),
        "cloud": npz(points=corners),
    }
    for name, content in graphs.items():
        yield f"reference_{name}", {"a.npz": content}, _reference
    yield "reference_npy", {"a.npy": npy(segments)}, one(read_reference, "a.npy")
    matches = npz(
        segments__a=rng.uniform(0, 9, (4, 4)), segments__b=rng.uniform(0, 9, (3, 4)),
        matches__a__b=[[0, 1], [3, 2]], scores__a__b=[0.5, 1.0],
    )  # fmt: skip
    yield "line_matches", {"m.npz": matches}, one(read_matches, "m.npz")
