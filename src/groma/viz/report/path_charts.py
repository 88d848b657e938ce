# SPDX-License-Identifier: BSD-3-Clause
"""Charts of a moving camera as inline SVG: its path in a plane, and values over time."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray
from groma.viz.report import charts as _charts
from groma.viz.report import digits as _digits

#: Maximum number of drawn places; longer curves are reduced to the maxima of this many pieces.
MAX_PLACES = 1200
#: Height of the view of a path, pixels.
PATH_HEIGHT = (150, 420)
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 14, 12, 40


@dataclass(frozen=True)
class Curve:
    """Numbers (N,) over time, or places (N, 2), with a name and a colour of CSS."""

    name: str
    colour: str
    values: FloatArray
    dashed: bool = False


def legend(curves: Sequence[Curve]) -> str:
    """Return the names beside their colours."""
    return "".join(f'<span class="key" style="--c:{curve.colour}">{html.escape(curve.name)}</span>' for curve in curves)


def path(curves: Sequence[Curve], marks: FloatArray, across: str, upwards: str) -> str:
    """Return paths in a plane, at one scale in both directions.

    Parameters
    ----------
    curves : sequence of Curve
        Places (N, 2), across and upwards; rows that are NaN interrupt the path.
    marks : (M, 2) float64
        Places drawn as dots in the colour of the first curve.
    across, upwards : str
        Names of the axes.
    """
    places = np.concatenate([curve.values for curve in curves])
    places = places[np.isfinite(places).all(axis=1)]
    if not len(places):
        return _charts.svg("Path", [_charts.text(_charts.WIDTH / 2, _charts.HEIGHT / 2, "no poses")])
    low, high = places.min(axis=0), places.max(axis=0)
    middle, extent = 0.5 * (low + high), np.maximum(high - low, 1e-3 * (high - low).max() + 1e-12) * 1.06
    wide = _charts.WIDTH - _LEFT - _RIGHT
    tall = float(np.clip(wide * extent[1] / extent[0], *PATH_HEIGHT))
    scale = min(wide / extent[0], tall / extent[1])
    height = round(_TOP + tall + _BOTTOM)
    origin = np.array([_LEFT + wide / 2, _TOP + tall / 2])

    def place(xy: FloatArray) -> FloatArray:
        return origin + (xy - middle) * scale * np.array([1.0, -1.0])

    first, last = middle - 0.5 * np.array([wide, tall]) / scale, middle + 0.5 * np.array([wide, tall]) / scale
    body = []
    # as many grid lines as there is room for in the shorter direction, at the same steps in both
    step = _digits.round_step(float((last - first).max()), 8)
    for tick in _digits.ticks(first[0], last[0], step):
        x = float(place(np.array([tick, middle[1]]))[0])
        body.append(_charts.line(x, _TOP, x, _TOP + tall, "grid"))
        body.append(_charts.text(x, _TOP + tall + 16, _digits.tick_of_step(tick, step)))
    for tick in _digits.ticks(first[1], last[1], step):
        y = float(place(np.array([middle[0], tick]))[1])
        body.append(_charts.line(_LEFT, y, _charts.WIDTH - _RIGHT, y, "grid"))
        body.append(_charts.text(_LEFT - 6, y + 4, _digits.tick_of_step(tick, step), "end"))
    body += [_drawn(place(curve.values), curve) for curve in reversed(curves)]
    for x, y in place(marks) if len(marks) else []:
        body.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2" style="fill:{curves[0].colour}"/>')
    begin = curves[0].values[np.isfinite(curves[0].values).all(axis=1)]
    if len(begin):
        for spot, name in ((begin[0], "start"), (begin[-1], "end")):
            x, y = place(spot)
            fill = curves[0].colour if name == "start" else "var(--card)"
            body.append(
                f'<circle cx="{x:.1f}" cy="{y:.1f}" r="5" style="fill:{fill};stroke:{curves[0].colour};'
                f'stroke-width:2"><title>{name}</title></circle>'
            )
    body.append(_charts.text((_LEFT + _charts.WIDTH) / 2, height - 5, across))
    body.append(_charts.text(_LEFT + 4, _TOP + 8, upwards, "start"))
    return _charts.svg("Path of the camera", body, height)


def over_time(times: FloatArray, curves: Sequence[Curve], bands: Sequence[tuple[FloatArray, str]] = ()) -> str:
    """Return numbers over time.

    Parameters
    ----------
    times : (N,) float64
        Seconds, increasing.
    curves : sequence of Curve
        Numbers (N,); NaN interrupts the curve.
    bands : sequence of (times, colour)
        Moments marked at the foot of the chart.
    """
    values = [curve.values[np.isfinite(curve.values)] for curve in curves]
    top = max((float(part.max()) for part in values if len(part)), default=0.0)
    if top <= 0 or not len(times):
        return _charts.svg("Over time", [_charts.text(_charts.WIDTH / 2, _charts.HEIGHT / 2, "nothing to show")])
    first, final = float(times[0]), float(times[-1]) if times[-1] > times[0] else float(times[0]) + 1.0
    wide, bottom = _charts.WIDTH - _LEFT - _RIGHT, _charts.HEIGHT - _BOTTOM
    top *= 1.05

    def across(when: FloatArray) -> FloatArray:
        return _LEFT + wide * (when - first) / (final - first)

    body = []
    step = _digits.round_step(top, 5)
    for tick in _digits.ticks(0.0, top, step):
        y = bottom - (bottom - _TOP) * tick / top
        body.append(_charts.line(_LEFT, y, _charts.WIDTH - _RIGHT, y, "grid"))
        body.append(_charts.text(_LEFT - 6, y + 4, _digits.tick_of_step(tick, step), "end"))
    step = _digits.round_step(final - first, 8)
    for tick in _digits.ticks(0.0, final - first, step):
        body.append(_charts.text(_LEFT + wide * tick / (final - first), bottom + 16, _digits.tick_of_step(tick, step)))
    for moments, colour in bands:
        width = max(wide / max(len(times), 1), 1.5)
        body.append(
            f'<g style="fill:{colour}">'
            + "".join(f'<rect x="{x:.1f}" y="{bottom - 7}" width="{width:.1f}" height="7"/>' for x in across(moments))
            + "</g>"
        )
    for curve in curves:
        when, numbers = _thinned(times, curve.values)
        body.append(_drawn(np.stack([across(when), bottom - (bottom - _TOP) * numbers / top], axis=1), curve))
    body.append(_charts.line(_LEFT, bottom, _charts.WIDTH - _RIGHT, bottom, "axis"))
    body.append(_charts.text((_LEFT + _charts.WIDTH) / 2, _charts.HEIGHT - 5, "time, seconds"))
    return _charts.svg(f"{', '.join(curve.name for curve in curves)} over time", body)


def _drawn(places: FloatArray, curve: Curve) -> str:
    """Return one path, interrupted where places are not known."""
    words, pen = [], "M"
    for x, y in places:
        if math.isfinite(x) and math.isfinite(y):
            words.append(f"{pen}{x:.1f} {y:.1f}")
            pen = "L"
        else:
            pen = "M"
    dash = ";stroke-dasharray:5 3" if curve.dashed else ""
    style = f"fill:none;stroke:{curve.colour};stroke-width:1.6;stroke-linejoin:round{dash}"
    return f'<path style="{style}" d="{" ".join(words)}"/>' if words else ""


def _thinned(times: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return at most MAX_PLACES places of a curve, with its peaks; pieces without numbers stay gaps."""
    if len(values) <= MAX_PLACES:
        return times, values
    bounds = np.linspace(0, len(values), MAX_PLACES + 1).astype(int)[:-1]
    peaks = np.maximum.reduceat(np.where(np.isfinite(values), values, -np.inf), bounds)
    return times[bounds], np.where(np.isfinite(peaks), peaks, np.nan)
