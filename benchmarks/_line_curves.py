# SPDX-License-Identifier: BSD-3-Clause
"""Curves of what is right over what is found, a chart for each scene, as an SVG file that needs nothing else."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

_SIZE, _GAP, _HEAD, _COLUMNS = 220.0, 56.0, 46.0, 3
_COLOURS = {"groma": "#0b6e8f", "LIMAP": "#c2571a"}
#: How lines are counted, and the dashes of its curve.
_KINDS = {"precision_count": "", "precision_length": "5 4"}
_STYLE = (
    "svg{font:12px system-ui,sans-serif;background:#fff}text{fill:#333}.grid{stroke:#e4e4e4}path{fill:none}"
    ".title{font-weight:600}"
)


def drawing(results: Sequence[Mapping], threshold: int = 1) -> str:
    """Return charts of the curves in results of ``benchmarks/lines.py``, at one of their thresholds.

    Solid: share of lines of which any part is right. Dashed: share of their length. The dot is what groma keeps by
    default.
    """
    columns, rows = min(_COLUMNS, len(results)), -(-len(results) // _COLUMNS)
    width, height = max(columns * (_SIZE + _GAP) + 20, 560.0), rows * (_SIZE + _GAP + _HEAD) + 34
    body = [_legend(height - 14)]
    for number, result in enumerate(results):
        left = 48 + (number % _COLUMNS) * (_SIZE + _GAP)
        top = _HEAD + (number // _COLUMNS) * (_SIZE + _GAP + _HEAD)
        body.append(_chart(result, threshold, left, top))
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'height="{height:.0f}"><style>{_STYLE}</style>{"".join(body)}</svg>\n'
    )


def _chart(result: Mapping, threshold: int, left: float, top: float) -> str:
    def place(found: float, right: float) -> tuple[float, float]:
        return left + _SIZE * found, top + _SIZE * (1.0 - right)

    body = [f'<text class="title" x="{left:.0f}" y="{top - 10:.0f}">{html.escape(result["scene"])}</text>']
    for tick in (0.0, 0.5, 1.0):
        (x, bottom), y = place(tick, 0.0), place(0.0, tick)[1]
        body.append(f'<path class="grid" d="M{x:.0f} {bottom:.0f} v{-_SIZE:.0f} M{left:.0f} {y:.0f} h{_SIZE:.0f}"/>')
        body.append(f'<text x="{x:.0f}" y="{bottom + 15:.0f}" text-anchor="middle">{100 * tick:g}</text>')
        body.append(f'<text x="{left - 5:.0f}" y="{y + 4:.0f}" text-anchor="end">{100 * tick:g}</text>')
    body.append(f'<text x="{left + _SIZE / 2:.0f}" y="{top + _SIZE + 31:.0f}" text-anchor="middle">found, %</text>')
    for row in result["rows"]:
        name = "groma" if row["contestant"] == "groma, all" else "LIMAP"
        if "curve" not in row or (name == "LIMAP" and not row["contestant"].startswith("LIMAP")):
            continue
        for kind, dashes in _KINDS.items():
            places = [place(point["recall_length"][threshold], point[kind][threshold]) for point in row["curve"]]
            path = " L".join(f"{x:.1f} {y:.1f}" for x, y in places)
            style = f'stroke="{_COLOURS[name]}" stroke-width="2" stroke-dasharray="{dashes}"'
            body.append(f'<path d="M{path}" {style}/>')
            for point, (x, y) in zip(row["curve"], places, strict=True):
                if name == "groma" and point["at_least"] == 0.5:
                    body.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{_COLOURS[name]}"/>')
    return "".join(body)


def _legend(y: float) -> str:
    words = [(name, colour, "") for name, colour in _COLOURS.items()]
    words += [("lines right", "#555", ""), ("length right", "#555", _KINDS["precision_length"])]
    body = []
    for number, (name, colour, dashes) in enumerate(words):
        x = 48 + 130 * number
        body.append(f'<path d="M{x} {y - 4} h24" stroke="{colour}" stroke-width="2" stroke-dasharray="{dashes}"/>')
        body.append(f'<text x="{x + 30}" y="{y}">{name}</text>')
    return "".join(body)
