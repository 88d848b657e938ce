# SPDX-License-Identifier: BSD-3-Clause
"""The directive ``factor-table``: one row per registered factor, taken from the registry."""

import numpy as np
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

import groma.factors


class FactorTable(SphinxDirective):
    """Name, first sentence, slots and size of the residual of every registered factor."""

    def run(self) -> list[nodes.Node]:
        """Build the table."""
        table = nodes.table()
        group = nodes.tgroup(cols=4)
        table += group
        for width in (22, 30, 8, 40):
            group += nodes.colspec(colwidth=width)
        head = nodes.thead()
        group += head
        head += self._row(["name", "variables", "rows", "what it says"])
        body = nodes.tbody()
        group += body
        for name, kind in groma.factors.registered().items():
            example = kind.example(np.random.default_rng(0))
            slots = ", ".join(f"{slot.name}{' (optional)' if slot.optional else ''}" for slot in kind.slots)
            sentence = (kind.__doc__ or "").strip().split("\n\n")[0].replace("\n", " ").replace("``", "").strip()
            body += self._row([name, slots, str(example.factor.residual_size), sentence])
        return [table]

    def _row(self, cells: list[str]) -> nodes.row:
        row = nodes.row()
        for position, text in enumerate(cells):
            entry = nodes.entry()
            paragraph = nodes.paragraph()
            paragraph += nodes.literal(text=text) if position == 0 and text != "name" else nodes.Text(text)
            entry += paragraph
            row += entry
        return row


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directive."""
    app.add_directive("factor-table", FactorTable)
    return {"parallel_read_safe": True}
