# SPDX-License-Identifier: BSD-3-Clause
"""Formulas as drawings in the page: seen without a script, a font or a network, in the colour of the text."""

import html
import re
from functools import cache

import ziamath
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util import logging
from sphinx.writers.html5 import HTML5Translator

_logger = logging.getLogger(__name__)
_SIZE = 17.0


def _has_rows(latex: str) -> bool:
    """Whether a formula has rows of its own, aligned at &, besides those of its matrices."""
    return bool(re.search(r"&|\\\\", re.sub(r"\\begin\{(\w+)\}.*?\\end\{\1\}", "", latex, flags=re.DOTALL)))


@cache
def _drawing(source: str, inline: bool) -> str:
    """Return a formula as an SVG element that stands on the line of the text."""
    # A bracket at the head of a cell would be read as an option of the environment, and \lVert would be stretched.
    latex = re.sub(r"(\\begin\{[bp]?matrix\}|\\\\|&)\s*\[([^\[\]]*)\]", r"\1 {[\2]}", source)
    latex = re.sub(r"\\[lr]Vert(?![A-Za-z])", lambda _: r"\|", latex)
    if _has_rows(latex):
        latex = rf"\begin{{array}}{{rl}} {latex} \end{{array}}"
    formula = ziamath.Latex(latex, size=_SIZE, inline=inline, color="currentColor")
    style = f'<svg role="img" aria-label="{html.escape(source)}" style="vertical-align: {formula.getyofst():.2f}px"'
    return formula.svg().replace("<svg", style, 1)


def _drawn(node: nodes.math | nodes.math_block, inline: bool) -> str:
    """Return the drawing of a node; a warning, and its source, where it cannot be read."""
    try:
        return _drawing(node.astext(), inline)
    except Exception as error:
        _logger.warning("a formula that cannot be drawn: %r: %s", error, node.astext(), location=node)
        return f"<code>{html.escape(node.astext())}</code>"


def _visit_inline(writer: HTML5Translator, node: nodes.math) -> None:
    writer.body.append(f'<span class="math">{_drawn(node, inline=True)}</span>')
    raise nodes.SkipNode


def _visit_block(writer: HTML5Translator, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="math" style="overflow-y: hidden">{_drawn(node, inline=False)}</div>')
    raise nodes.SkipNode


def setup(app: Sphinx) -> dict[str, object]:
    """Register the drawings as renderer of formulas."""
    app.add_html_math_renderer("drawn", (_visit_inline, None), (_visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
