# SPDX-License-Identifier: BSD-3-Clause
"""Small charts as inline SVG: histogram, convergence curve, bars. Colours come from the page's style sheet."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from groma._typing import FloatArray

WIDTH, HEIGHT = 560, 250
#: Images shown in the bar chart.
MAX_BARS = 24
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 12, 10, 40


def _svg(body: list[str], height: int = HEIGHT) -> str:
    return f'<svg viewBox="0 0 {WIDTH} {height}" role="img">{"".join(body)}</svg>'


def _text(x: float, y: float, words: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(words)}</text>'


def _line(x1: float, y1: float, x2: float, y2: float, name: str) -> str:
    return f'<line class="{name}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


def _number(value: float) -> str:
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def histogram(before: FloatArray | None, after: FloatArray) -> str:
    """Return two overlaid histograms of residual lengths in pixels, on a logarithmic axis.

    Parameters
    ----------
    before, after : (N,) float64
        Lengths of the residuals, pixels; ``before`` may be None.
    """
    edges = np.logspace(-2, 2, 49)
    width = (WIDTH - _LEFT - _RIGHT) / 48
    bottom = HEIGHT - _BOTTOM
    series = [("before", before)] if before is not None else []
    series.append(("after", after))
    shares = [(name, _shares(values, edges)) for name, values in series if values is not None]
    top = max(float(share.max()) for _, share in shares) or 1.0
    body = []
    for exponent in range(-2, 3):
        x = _LEFT + (exponent + 2) * 12 * width
        body.append(_line(x, _TOP, x, bottom, "grid") + _text(x, bottom + 16, f"{10.0**exponent:g}"))
    for name, share in shares:
        bars = [
            f'<rect x="{_LEFT + i * width:.1f}" y="{bottom - s / top * (bottom - _TOP):.1f}" width="{width - 0.6:.1f}" '
            f'height="{s / top * (bottom - _TOP):.1f}"><title>{_number(edges[i])} to {_number(edges[i + 1])} px: '
            f"{100 * s:.2g} % {name}</title></rect>"
            for i, s in enumerate(share)
            if s > 0
        ]
        body.append(f'<g class="{name}" opacity="0.62">{"".join(bars)}</g>')
    body.append(_line(_LEFT, bottom, WIDTH - _RIGHT, bottom, "axis"))
    body.append(_text((_LEFT + WIDTH) / 2, HEIGHT - 5, "length of a residual, pixels"))
    body.append(_text(_LEFT - 8, _TOP + 10, f"{100 * top:.2g} %", "end") + _text(_LEFT - 8, bottom, "0", "end"))
    return _svg(body)


def _shares(values: FloatArray, edges: FloatArray) -> FloatArray:
    counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]
    return counts / max(len(values), 1)


def entry(step: Any) -> Mapping[str, Any]:
    """Return a step of a history as a mapping, whether it is one or an object."""
    return step if isinstance(step, Mapping) else vars(step)


def convergence(history: Sequence[Any]) -> str:
    """Return the cost after each accepted step, on a logarithmic axis; rejected steps are hollow.

    Parameters
    ----------
    history : sequence
        Mappings or objects with ``iteration``, ``cost``, ``accepted`` and perhaps ``stage``; costs of different
        stages belong to different losses and are not joined.
    """
    rows = [entry(row) for row in history]
    steps = [
        (int(row["iteration"]), float(row["cost"]), bool(row["accepted"]))
        for row in rows
        if math.isfinite(row["cost"]) and row["cost"] > 0
    ]
    if not steps:
        return _svg([_text(WIDTH / 2, HEIGHT / 2, "no steps were taken")])
    costs = [cost for _, cost, _ in steps]
    low, high = math.log10(min(costs)), math.log10(max(costs))
    if high - low < 0.05:
        low, high = low - 0.05, high + 0.05
    margin = 0.06 * (high - low)
    low, high = low - margin, high + margin
    first, final = steps[0][0], max(steps[-1][0], steps[0][0] + 1)
    bottom = HEIGHT - _BOTTOM

    def place(iteration: int, cost: float) -> tuple[float, float]:
        x = _LEFT + 12 + (WIDTH - _LEFT - _RIGHT - 24) * (iteration - first) / (final - first)
        return x, bottom - (bottom - _TOP) * (math.log10(cost) - low) / (high - low)

    body = []
    for tick in _log_ticks(low, high):
        y = place(first, tick)[1]
        body.append(_line(_LEFT, y, WIDTH - _RIGHT, y, "grid") + _text(_LEFT - 6, y + 4, _number(tick), "end"))
    stride = max(1, math.ceil((final - first) / 10))
    body += [_text(place(i, 10**low)[0], bottom + 16, str(i)) for i in range(first, final + 1, stride)]
    for stage in sorted({row.get("stage", 1) for row in rows}):
        mine = {int(row["iteration"]) for row in rows if row.get("stage", 1) == stage}
        taken = [place(i, cost) for i, cost, accepted in steps if accepted and i in mine]
        body.append(f'<path class="after" d="M{" L".join(f"{x:.1f} {y:.1f}" for x, y in taken)}"/>' if taken else "")
    for iteration, cost, accepted in steps:
        x, y = place(iteration, cost)
        name = "after" if accepted else "rejected"
        body.append(
            f'<circle class="{name}" cx="{x:.1f}" cy="{y:.1f}" r="4"><title>step {iteration}: cost {cost:.6g}'
            f"{'' if accepted else ', rejected'}</title></circle>"
        )
    body.append(_line(_LEFT, bottom, WIDTH - _RIGHT, bottom, "axis"))
    body.append(_text((_LEFT + WIDTH) / 2, HEIGHT - 5, "step"))
    return _svg(body)


def _log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten, or 1-2-5 steps, or plain numbers, whichever gives at least three in [10^low, 10^high]."""
    for factors in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0)):
        ticks = [f * 10.0**e for e in range(math.floor(low), math.ceil(high) + 1) for f in factors]
        ticks = [tick for tick in ticks if low <= math.log10(tick) <= high]
        if len(ticks) >= 3:
            return ticks[:: max(1, len(ticks) // 6)]
    return [10 ** (low + (high - low) * share) for share in (0.1, 0.5, 0.9)]


def bars(names: Sequence[str], before: FloatArray | None, after: FloatArray) -> str:
    """Return one pair of bars per image: root mean square residual in pixels, the worst after adjustment first."""
    order = np.argsort(-after, kind="stable")[:MAX_BARS]
    row = 22
    height = row * len(order) + 8
    labels = [name if len(name) <= 26 else "…" + name[-25:] for name in names]
    left, right = 14 + 7 * max((len(labels[index]) for index in order), default=0), 104
    values = after if before is None else np.concatenate([before, after])
    finite = values[np.isfinite(values)]
    # One image that is far off at the start must not flatten all the others.
    top = min(float(finite.max()), 4 * float(np.median(finite))) if len(finite) else 1.0
    scale = (WIDTH - left - right) / (top or 1.0)
    body = []
    for position, index in enumerate(order):
        y = row * position + 4
        words = f"{after[index]:.3g}" if before is None else f"{before[index]:.3g} → {after[index]:.3g}"
        body.append(_text(left - 8, y + 13, labels[index], "end"))
        longest = 0.0
        for kind, series, offset in (("before", before, 0), ("after", after, 9 if before is not None else 4)):
            if series is not None:
                length = min(float(series[index]) * scale, WIDTH - left - right)
                longest = max(longest, length)
                body.append(
                    f'<rect class="{kind}" x="{left}" y="{y + offset}" width="{length:.1f}" height="8" rx="2"/>'
                )
        body.append(_text(min(left + longest + 6, WIDTH - right + 2), y + 12, words, "start"))
    return _svg(body, height)
