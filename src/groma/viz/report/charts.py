# SPDX-License-Identifier: BSD-3-Clause
"""Small charts as inline SVG: histogram, convergence curve, bars, spreads. Colours come from the page's style sheet."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from groma._counted import whole_percent
from groma._typing import FloatArray, IntArray
from groma.viz.report import digits as _digits

WIDTH, HEIGHT = 560, 250
#: Images shown in the bar chart.
MAX_BARS = 24
#: Losses named after people.
_LOSSES = {name.lower().replace("-", "_"): name for name in ("Cauchy", "Geman-McClure", "Huber", "Tukey", "Barron")}
_LEFT, _RIGHT, _TOP, _BOTTOM = 58, 12, 10, 40


def svg(label: str, body: list[str], height: int = HEIGHT) -> str:
    """Return a drawing; ``label`` describes it for screen readers."""
    return f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{html.escape(label)}">{"".join(body)}</svg>'


def text(x: float, y: float, words: str, anchor: str = "middle") -> str:
    """Return a text at a place."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{html.escape(words)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, name: str) -> str:
    """Return a straight line; ``name`` is a class of the style sheet."""
    return f'<line class="{name}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>'


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
    limits = [_digits.tick(edge) for edge in edges]
    series = [("before", before)] if before is not None else []
    series.append(("after", after))
    shares = [(name, _shares(values, edges)) for name, values in series if values is not None]
    top = max(float(share.max()) for _, share in shares) or 1.0
    body = []
    for exponent in range(-2, 3):
        x = _LEFT + (exponent + 2) * 12 * width
        beyond = {-2: "≤ ", 2: "≥ "}.get(exponent, "")  # the first and the last bar hold what lies outside
        place, anchor = (x + 6, "end") if exponent == 2 else (x, "middle")
        body.append(line(x, _TOP, x, bottom, "grid"))
        body.append(text(place, bottom + 16, f"{beyond}{10.0**exponent:g}", anchor))
    for name, share in shares:
        bars = [
            f'<rect x="{_LEFT + i * width:.1f}" y="{bottom - s / top * (bottom - _TOP):.1f}" width="{width - 0.6:.1f}" '
            f'height="{s / top * (bottom - _TOP):.1f}"><title>{limits[i]} to {limits[i + 1]} px: '
            f"{_digits.percent(s)} {name}</title></rect>"
            for i, s in enumerate(share)
            if s > 0
        ]
        body.append(f'<g class="{name}" opacity="0.62">{"".join(bars)}</g>')
    body.append(line(_LEFT, bottom, WIDTH - _RIGHT, bottom, "axis"))
    body.append(text((_LEFT + WIDTH) / 2, HEIGHT - 5, "length of a residual, pixels"))
    body.append(text(_LEFT - 8, _TOP + 10, _digits.percent(top), "end") + text(_LEFT - 8, bottom, "0", "end"))
    return svg("Histogram of residuals", body)


def _shares(values: FloatArray, edges: FloatArray) -> FloatArray:
    counts = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0]
    return counts / max(len(values), 1)


def entry(step: Any) -> Mapping[str, Any]:
    """Return a step of a history, a mapping or an object, as a mapping."""
    return step if isinstance(step, Mapping) else vars(step)


def convergence(history: Sequence[Any], stages: Sequence[Mapping[str, Any]] = ()) -> str:
    """Return the cost after each accepted step, on a logarithmic axis; rejected steps are hollow.

    Parameters
    ----------
    history : sequence
        Mappings or objects with ``iteration``, ``cost``, ``accepted`` and perhaps ``stage``; costs of different
        stages belong to different losses and are not joined.
    stages : sequence of mappings, optional
        ``loss``, ``initial_cost`` and ``first_step`` of each stage.
    """
    rows = [entry(row) for row in history]
    rows += [
        {"iteration": stage["first_step"] - 1, "cost": stage["initial_cost"], "accepted": True, "stage": number}
        for number, stage in enumerate(stages, 1)
    ]
    rows.sort(key=lambda row: (row.get("stage", 1), row["iteration"]))
    rows = [row for row in rows if math.isfinite(row["cost"]) and row["cost"] > 0]
    if not rows:
        return svg("Convergence", [text(WIDTH / 2, HEIGHT / 2, "no steps were taken")])
    steps = [int(row["iteration"]) for row in rows]
    low, high = (math.log10(pick(float(row["cost"]) for row in rows)) for pick in (min, max))
    if high - low < 0.05:
        low, high = low - 0.05, high + 0.05
    margin = 0.06 * (high - low)
    low, high = low - margin, high + (2 if len(stages) > 1 else 1) * margin
    first, final = min(steps), max(*steps, min(steps) + 1)
    bottom = HEIGHT - _BOTTOM

    def place(iteration: int, cost: float) -> tuple[float, float]:
        x = _LEFT + 12 + (WIDTH - _LEFT - _RIGHT - 24) * (iteration - first) / (final - first)
        return x, bottom - (bottom - _TOP) * (math.log10(cost) - low) / (high - low)

    body = []
    for tick in _log_ticks(low, high):
        y = place(first, tick)[1]
        body.append(line(_LEFT, y, WIDTH - _RIGHT, y, "grid") + text(_LEFT - 6, y + 4, _digits.tick(tick), "end"))
    stride = max(1, math.ceil((final - first) / 10))
    body += [text(place(i, 10**low)[0], bottom + 16, str(i)) for i in range(first, final + 1, stride)]
    if len(stages) > 1:
        for stage in stages:
            x = place(max(first, stage["first_step"] - 1), 10**low)[0]
            body.append(line(x, _TOP, x, bottom, "grid"))
            body.append(text(x + 5, _TOP + 10, _LOSSES.get(stage["loss"], str(stage["loss"])), "start"))
    for stage in sorted({row.get("stage", 1) for row in rows}):
        mine = [row for row in rows if row.get("stage", 1) == stage]
        taken = [place(int(row["iteration"]), float(row["cost"])) for row in mine if row["accepted"]]
        body.append(f'<path class="after" d="M{" L".join(f"{x:.1f} {y:.1f}" for x, y in taken)}"/>' if taken else "")
    for row in rows:
        x, y = place(int(row["iteration"]), float(row["cost"]))
        name = "after" if row["accepted"] else "rejected"
        body.append(
            f'<circle class="{name}" cx="{x:.1f}" cy="{y:.1f}" r="4"><title>step {row["iteration"]}: cost '
            f"{row['cost']:.6g}{'' if row['accepted'] else ', refused'}</title></circle>"
        )
    body.append(line(_LEFT, bottom, WIDTH - _RIGHT, bottom, "axis"))
    body.append(text((_LEFT + WIDTH) / 2, HEIGHT - 5, "step"))
    return svg("Cost after each step", body)


def _log_ticks(low: float, high: float) -> list[float]:
    """Return powers of ten, or 1-2-5 steps, or plain numbers, whichever gives at least three in [10^low, 10^high]."""
    for factors in ((1.0,), (1.0, 3.0), (1.0, 2.0, 5.0)):
        ticks = [f * 10.0**e for e in range(math.floor(low), math.ceil(high) + 1) for f in factors]
        ticks = [tick for tick in ticks if low <= math.log10(tick) <= high]
        if len(ticks) >= 3:
            return ticks[:: max(1, len(ticks) // 6)]
    # A narrow range: round numbers at even steps.
    first, final = 10.0**low, 10.0**high
    return _digits.ticks(first, final, _digits.round_step(final - first, 6))


def bars(names: Sequence[str], before: FloatArray | None, after: FloatArray) -> str:
    """Return one pair of bars per image: median residual in pixels, the worst after adjustment first."""
    order = np.argsort(-after, kind="stable")[:MAX_BARS]
    row = 22
    height = row * len(order) + 8
    labels = [name if len(name) <= 26 else "…" + name[-25:] for name in names]
    left, right = 14 + 7 * max((len(labels[index]) for index in order), default=0), 104
    values = after if before is None else np.concatenate([before, after])
    series_shown = [series[order] for series in (before, after) if series is not None]
    told = np.array(_digits.even(np.concatenate(series_shown).tolist())).reshape(len(series_shown), -1)
    finite = values[np.isfinite(values)]
    # One image that is far off at the start must not flatten all the others.
    top = min(float(finite.max()), 4 * float(np.median(finite))) if len(finite) else 1.0
    scale = (WIDTH - left - right) / (top or 1.0)
    body = []
    for position, index in enumerate(order):
        y = row * position + 4
        words = " → ".join(column[position] for column in told)
        body.append(text(left - 8, y + 13, labels[index], "end"))
        longest = 0.0
        for kind, series, offset in (("before", before, 0), ("after", after, 9 if before is not None else 4)):
            if series is not None:
                length = min(float(series[index]) * scale, WIDTH - left - right)
                longest = max(longest, length)
                body.append(
                    f'<rect class="{kind}" x="{left}" y="{y + offset}" width="{length:.1f}" height="8" rx="2"/>'
                )
        body.append(text(min(left + longest, WIDTH - right) + 6, y + 12, words, "start"))
    return svg("Residuals by image", [f'<g class="names">{"".join(body)}</g>'], height)


def tracks(lengths: Mapping[str, IntArray]) -> str:
    """Return how many images observe each landmark, as shares by kind; long tracks stand together in the last bar.

    Parameters
    ----------
    lengths : mapping of str to (n,) int
        Number of images of each landmark, by a kind that is also a class of the style sheet.
    """
    every = np.concatenate(list(lengths.values()))
    last = int(min(max(np.percentile(every, 98), 6), MAX_BARS)) if len(every) else 6
    first = int(min(every.min(initial=2), 2))
    shares = {
        kind: np.bincount(np.minimum(values, last) - first, minlength=last - first + 1) / max(len(values), 1)
        for kind, values in lengths.items()
    }
    top = max(float(share.max()) for share in shares.values()) or 1.0
    bottom, step = HEIGHT - _BOTTOM, (WIDTH - _LEFT - _RIGHT) / (last - first + 1)
    width = (step - 3) / len(shares)
    body = []
    for number, (kind, share) in enumerate(shares.items()):
        bars = "".join(
            f'<rect x="{_LEFT + place * step + 1.5 + number * width:.1f}" y="{bottom - height:.1f}" '
            f'width="{width:.1f}" height="{height:.1f}"><title>{_digits.percent(value)} of the {kind} in '
            f"{first + place}{' or more' if first + place == last else ''} images</title></rect>"
            for place, value in enumerate(share)
            if (height := value / top * (bottom - _TOP)) > 0
        )
        body.append(f'<g class="{kind}">{bars}</g>')
    stride = max(1, math.ceil((last - first + 1) / 16))
    for place in range(0, last - first + 1, stride):
        if place > last - first - stride and place != last - first:
            continue
        more = "+" if place == last - first and bool((every > last).any()) else ""
        body.append(text(_LEFT + (place + 0.5) * step, bottom + 16, f"{first + place}{more}"))
    body.append(line(_LEFT, bottom, WIDTH - _RIGHT, bottom, "axis"))
    body.append(text((_LEFT + WIDTH) / 2, HEIGHT - 5, "images that observe it"))
    body.append(text(_LEFT - 8, _TOP + 10, _digits.percent(top), "end") + text(_LEFT - 8, bottom, "0", "end"))
    return svg("Landmarks by the number of images that observe them", body)


def spreads(rows: Sequence[tuple[str, Sequence[float], float | None]], axis: str) -> str:
    """Return distributions one below the other: from the 5th to the 95th percentile, the middle half, the median.

    Parameters
    ----------
    rows : sequence of (words, percentiles, mark)
        Five percentiles (5, 25, 50, 75, 95) in the unit of the axis, and a value to mark with a ring, or None.
    axis : str
        What the axis shows.
    """
    left, step, top = 172, 40, 8
    height = top + step * len(rows) + _BOTTOM
    bottom = top + step * len(rows)
    most = max([max(*values, mark or 0.0) for _, values, mark in rows], default=0.0) or 1.0
    step_of_axis = _digits.round_step(most, 5)
    ticks = [step_of_axis * k for k in range(math.ceil(most / step_of_axis - 1e-9) + 1)]

    def x(value: float) -> float:
        return left + value / ticks[-1] * (WIDTH - _RIGHT - 14 - left)

    body = []
    for value in ticks:
        body.append(line(x(value), top, x(value), bottom, "grid") + text(x(value), bottom + 16, _digits.tick(value)))
    for number, (words, values, mark) in enumerate(rows):
        y = top + step * (number + 0.5)
        low, first, middle, third, high = (x(value) for value in values)
        told = f"{words}: half of them below {_digits.tick(values[2])}, 95 % below {_digits.tick(values[4])}"
        told += "" if mark is None else f"; predicted {_digits.tick(mark)}"
        ring = "" if mark is None else f'<circle class="rejected" cx="{x(mark):.1f}" cy="{y:.1f}" r="5"/>'
        body.append(
            f"<g><title>{html.escape(told)}</title>{text(left - 12, y + 4, words, 'end')}"
            f"{line(low, y, high, y, 'axis')}"
            f'<rect class="after" x="{first:.1f}" y="{y - 9:.1f}" width="{max(third - first, 1.0):.1f}" height="18" '
            f'rx="3" opacity="0.62"/>'
            f'<rect class="after" x="{middle - 1.5:.1f}" y="{y - 12:.1f}" width="3" height="24"/>{ring}</g>'
        )
    body.append(line(left, bottom, WIDTH - _RIGHT, bottom, "axis"))
    body.append(text((left + WIDTH) / 2, height - 5, axis))
    return svg("Distributions", body, height)


def shares(parts: Sequence[tuple[str, int, str]]) -> str:
    """Return one bar cut into shares, with a legend under it that holds names, numbers and percentages.

    Parameters
    ----------
    parts : sequence of (words, count, colour)
        The pieces from left to right; colours of the style sheet or of CSS.
    """
    total = max(sum(count for _, count, _ in parts), 1)
    pieces = "".join(
        f'<i style="flex:{count};background:{colour}" title="{html.escape(words)}: {count:,}"></i>'
        for words, count, colour in parts
        if count
    )
    legend = "".join(
        f'<span class="key" style="--c:{colour}"><span>{html.escape(words)}</span><b>{count:,}</b>'
        f"<span>{whole_percent(count / total)}</span></span>"
        for words, count, colour in parts
        if count
    )
    return f'<div class="shares">{pieces}</div><div class="keys">{legend}</div>'
