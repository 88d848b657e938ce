# SPDX-License-Identifier: BSD-3-Clause
"""A file format: 3D line segments as text, six numbers a line, the two end points."""

import numpy as np

from groma.errors import FileFormatError, InputError
from groma.io import SceneFormat, atomic_output, register_format
from groma.io.reading import reading
from groma.scene import Lines, Scene

FIRST_LINE = "# segments: x1 y1 z1 x2 y2 z2\n"


def read_segments(path):
    with reading(path, "file of segments"):
        ends = np.loadtxt(path, comments="#", ndmin=2).reshape(-1, 6)
        if not np.isfinite(ends).all():
            raise FileFormatError(f"{path} holds numbers that are not finite.")
        return Scene(lines=Lines.through(ends.reshape(-1, 2, 3)))


def write_segments(scene, path, force=False):
    with atomic_output(path, force) as draft:
        rows = scene.lines.segments.reshape(-1, 6).tolist()
        draft.write_text(FIRST_LINE + "".join(" ".join(map(repr, row)) + "\n" for row in rows), encoding="utf-8")


def check_segments(scene):
    if scene.num_lines == 0:
        raise InputError("A file of segments holds lines, and the scene has none. Write an archive (.npz) instead.")


register_format(
    SceneFormat(
        "segments",
        source="a file of segments",
        target=".segments for segments as text",
        endings=(".segments",),
        recognise=lambda path, head: head.startswith(FIRST_LINE.encode()),
        read=read_segments,
        write=write_segments,
        check=check_segments,
    )
)
