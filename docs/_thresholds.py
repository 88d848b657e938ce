# SPDX-License-Identifier: BSD-3-Clause
"""The directive ``thresholds``: one table per class of gates, taken from the code of the package."""

from __future__ import annotations

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from groma.gates import gate_classes, table

HEAD = ("name", "value", "unit", "what it decides", "origin")


class Thresholds(SphinxDirective):
    """All classes of gates by room, each with its tuned numbers."""

    def run(self) -> list[nodes.Node]:
        """Build a section per room and a table per class."""
        out: list[nodes.Node] = []
        section = nodes.section()
        room = ""
        for kind in gate_classes():
            if kind.__module__.split(".")[1] != room:
                room = kind.__module__.split(".")[1]
                section = nodes.section(ids=[f"thresholds-{room}"], names=[room])
                section += nodes.title(text=room.capitalize())
                out.append(section)
            section += nodes.rubric(text=kind.__name__)
            head = (kind.__doc__ or "").strip().split("\n")[0]
            section += nodes.paragraph(
                "", "", nodes.Text(f"{head} In "), nodes.literal(text=kind.__module__), nodes.Text(".")
            )
            section += _table([(name, _text(value), *words) for name, value, *words in table(kind)])
        return out


def _text(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(_text(one) for one in value)
    return f"{value:.4g}" if isinstance(value, float) else f"{value:,}"


def _table(rows: list[tuple[str, ...]]) -> nodes.table:
    result = nodes.table()
    group = nodes.tgroup(cols=len(HEAD))
    result += group
    for width in (20, 12, 14, 34, 34):
        group += nodes.colspec(colwidth=width)
    head, body = nodes.thead(), nodes.tbody()
    head += _row(HEAD)
    body += [_row(row) for row in rows]
    group += [head, body]
    return result


def _row(cells: tuple[str, ...]) -> nodes.row:
    row = nodes.row()
    for position, text in enumerate(cells):
        entry, paragraph = nodes.entry(), nodes.paragraph()
        paragraph += nodes.literal(text=text) if position == 0 and cells is not HEAD else nodes.Text(text)
        entry += paragraph
        row += entry
    return row


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directive."""
    app.add_directive("thresholds", Thresholds)
    return {"parallel_read_safe": True}
