# SPDX-License-Identifier: BSD-3-Clause
"""Line charts as SVG files that need nothing else: logarithmic axes, a name at the end of each line."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

WIDTH, HEIGHT = 760, 420
LEFT, RIGHT, TOP, BOTTOM = 76, 170, 40, 52
COLOURS = ("#0b6e8f", "#c2571a", "#5b7f2b", "#7a4fa3", "#b03060", "#3d3d3d", "#a08000")
STYLE = (
    "svg{font:13px system-ui,sans-serif;background:#fff}text{fill:#333}.grid{stroke:#ddd}.axis{stroke:#666}"
    "path{fill:none;stroke-width:2}.title{font-weight:600}"
)


@dataclass(frozen=True)
class Line:
    """A named line; ``steps`` draws it as a staircase (the value holds until the next point)."""

    name: str
    x: Sequence[float]
    y: Sequence[float]
    steps: bool = False


def _ticks(low: float, high: float) -> list[float]:
    every = max(1, math.ceil((high - low) / 7))
    return [10.0**e for e in range(math.ceil(low), math.floor(high) + 1, every)]


def _number(value: float) -> str:
    return f"{value:g}" if 1e-4 <= value < 1e5 else f"10^{round(math.log10(value))}"


def _text(x: float, y: float, words: str, more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" {more}>{html.escape(words)}</text>'


def write(path: Path, title: str, x_name: str, y_name: str, lines: Sequence[Line]) -> None:
    """Write a chart; points that are not positive are left out."""
    kept = []
    for line in lines:
        points = [(math.log10(x), math.log10(y)) for x, y in zip(line.x, line.y, strict=True) if x > 0 and y > 0]
        if points:
            kept.append((line, points))
    if not kept:
        return
    every = [point for _, points in kept for point in points]
    (x0, x1), (y0, y1) = ((min(axis) - 0.05, max(axis) + 0.05) for axis in zip(*every, strict=True))
    bottom, right = HEIGHT - BOTTOM, WIDTH - RIGHT

    def place(x: float, y: float) -> tuple[float, float]:
        return LEFT + (right - LEFT) * (x - x0) / (x1 - x0), bottom - (bottom - TOP) * (y - y0) / (y1 - y0)

    body = [_text(LEFT, 22, title, 'class="title"')]
    for tick in _ticks(x0, x1):
        x = place(math.log10(tick), y0)[0]
        body.append(f'<line class="grid" x1="{x:.1f}" y1="{TOP}" x2="{x:.1f}" y2="{bottom}"/>')
        body.append(_text(x, bottom + 18, _number(tick), 'text-anchor="middle"'))
    for tick in _ticks(y0, y1):
        y = place(x0, math.log10(tick))[1]
        body.append(f'<line class="grid" x1="{LEFT}" y1="{y:.1f}" x2="{right}" y2="{y:.1f}"/>')
        body.append(_text(LEFT - 6, y + 4, _number(tick), 'text-anchor="end"'))
    body.append(f'<path class="axis" style="stroke-width:1" d="M{LEFT} {TOP} V{bottom} H{right}"/>')
    body.append(_text((LEFT + right) / 2, HEIGHT - 12, x_name, 'text-anchor="middle"'))
    body.append(_text(16, (TOP + bottom) / 2, y_name, f'text-anchor="middle" transform="rotate(-90 16 {(TOP + bottom) / 2})"'))  # fmt: skip # noqa: E501
    for number, (line, points) in enumerate(kept):
        colour = COLOURS[number % len(COLOURS)]
        places = [place(*point) for point in points]
        drawn = f"M{places[0][0]:.1f} {places[0][1]:.1f}"
        for x, y in places[1:]:
            drawn += f" H{x:.1f} V{y:.1f}" if line.steps else f" L{x:.1f} {y:.1f}"
        body.append(f'<path d="{drawn}" style="stroke:{colour}"/>')
        y = TOP + 8 + 20 * number
        body.append(f'<path d="M{right + 14} {y} h18" style="stroke:{colour}"/>' + _text(right + 38, y + 4, line.name))
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}">'
        f"<style>{STYLE}</style>{''.join(body)}</svg>\n"
    )
