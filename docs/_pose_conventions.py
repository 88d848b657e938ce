# SPDX-License-Identifier: BSD-3-Clause
"""The directive ``pose-conventions``: how files hold poses, a row for each, from the table that the readers go by."""

from __future__ import annotations

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from groma.io.pose_conventions import POSE_CONVENTIONS, PoseConvention

HEAD = ("file", "rotation and shift take", "rotation", "place", "camera axes")
_DIRECTIONS = {"cam_from_world": "world to camera", "world_from_cam": "camera to world"}
_AXES = {
    "ours": "x right, y down, z forward",
    "OpenGL": "x right, y up, looking along -z",
    "LLFF": "x down, y right, looking along -z",
}


def cells(convention: PoseConvention) -> tuple[str, ...]:
    """Return a row."""
    return (
        convention.name, _DIRECTIONS[convention.direction], convention.rotation, convention.place,
        _AXES[convention.axes],
    )  # fmt: skip


class PoseConventions(SphinxDirective):
    """All kinds of files, in the order of the table."""

    def run(self) -> list[nodes.Node]:
        """Build the table."""
        table, group = nodes.table(), nodes.tgroup(cols=len(HEAD))
        table += group
        for width in (34, 18, 16, 16, 26):
            group += nodes.colspec(colwidth=width)
        head, body = nodes.thead(), nodes.tbody()
        head += _row(HEAD)
        body += [_row(cells(convention)) for convention in POSE_CONVENTIONS]
        group += [head, body]
        return [table]


def _row(texts: tuple[str, ...]) -> nodes.row:
    row = nodes.row()
    for text in texts:
        entry = nodes.entry()
        entry += nodes.paragraph(text=text)
        row += entry
    return row


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directive."""
    app.add_directive("pose-conventions", PoseConventions)
    return {"parallel_read_safe": True}
