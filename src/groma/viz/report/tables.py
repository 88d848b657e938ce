# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of the page: tiles, charts and tables, as HTML."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from groma._counted import counted
from groma._typing import FloatArray, IntArray
from groma.scene import Scene
from groma.scene.counts import num_relations
from groma.scene.patches import PALETTE, patch_area, patch_groups
from groma.viz import colours as _colours
from groma.viz.drawable import Drawable
from groma.viz.report import charts as _charts
from groma.viz.report import digits as _digits
from groma.viz.statistics import images_of

#: Planes, and directions, in the tables.
MAX_LISTED_PLANES = 15
MAX_LISTED_DIRECTIONS = 8
#: Words for the stages of a solve.
_STAGES = {
    "setup": "setting up",
    "linearize": "residuals and derivatives",
    "schur": "eliminating landmarks",
    "solve": "steps of the cameras",
    "backsubstitute": "steps of the landmarks",
    "cost": "costs of trial steps",
    "total": "total",
}
#: Words and colours of the outcomes of segments.
_OUTCOMES = {
    "mapped": ("observes a line", "var(--line)"),
    "recovered": ("found by projecting a line", "#8fcf9f"),
    "too_short": ("too short", "#b9bdc4"),
    "no_neighbor": ("image without neighbours", "#7a8088"),
    "no_match": ("no candidate in a neighbour", "#c98a5b"),
    "degenerate": ("along the epipolar lines", "#8a63c9"),
    "no_support": ("neighbours disagree", "#d9b24a"),
    "ambiguous": ("two places equally good", "#cd5c9a"),
    "not_linked": ("alone at its place", "#5b9bc9"),
    "outlier": ("outlier of its line", "#d64b36"),
    "few_images": ("line in too few images", "#93a7bd"),
    "uncertain": ("line too uncertain", "#6d7f93"),
    "short_line": ("line of short segments only", "#a9895f"),
    "texture": ("texture", "#b5a7d6"),
    "repeated": ("repeats another line", "#7fb3a6"),
}
#: Statistics of residuals, by what the tables call them.
_STATISTICS: dict[str, Callable[[FloatArray], Any]] = {
    "rms": lambda values: np.sqrt(np.mean(values**2)),
    "median": np.median,
    "95th percentile": lambda values: np.percentile(values, 95),
    "largest": np.max,
}


def counts_of(scene: Scene, shown: Drawable) -> list[tuple[str, int]]:
    """Return the counts of a scene."""
    return [
        ("images", len(shown.cam_from_world)),
        ("points", len(shown.points)),
        ("lines", len(shown.segments)),
        ("planes", len(shown.patches)),
        ("directions", scene.num_directions),
        ("observations", shown.num_observations),
    ]


def words(counts: Sequence[tuple[str, int]]) -> str:
    """Return counts as an enumeration."""
    return ", ".join(counted(count, name) for name, count in counts if count)


def tiles(scene: Scene, before: Drawable | None, after: Drawable, numbers: Mapping[str, Any] | None) -> str:
    """Return the most important numbers in large letters."""
    states = [state for state in (before, after) if state is not None]
    cells = []
    for kind, name in enumerate(after.residual_kinds):
        if len(_known(after, kind)):
            medians = _digits.short([_statistic("median", _known(state, kind)) for state in states])
            cells.append((" <i>→</i> ".join(medians) + " px", f"residual of {name}, median"))
    for name, told in ((numbers or {}).get("inliers") or {}).items():
        share = [100.0 * told["share"]["before"]] if before is not None else []
        share = _digits.short([*share, 100.0 * told["share"]["after"]])
        cells.append((" <i>→</i> ".join(share) + " %", f"of {name} are inliers, within {told['limit_px']:.2g} px"))
    if numbers is not None:
        cells.append((f"{numbers['iterations']}", "steps"))
    cells += [(f"{count:,}", name) for name, count in counts_of(scene, after) if count][: 5 - len(cells)]
    return as_tiles(cells)


def as_tiles(cells: Sequence[tuple[str, str]]) -> str:
    """Return values, which are HTML, each above its label."""
    return "".join(f'<div class="tile"><b>{value}</b><span>{html.escape(label)}</span></div>' for value, label in cells)


def chart_cards(
    scene: Scene,
    before: Drawable | None,
    after: Drawable,
    history: Sequence[Any] | None,
    stages: Sequence[Mapping[str, Any]],
    outcomes: Mapping[str, int] | None,
    explanation: str,
) -> str:
    """Return the charts, each in a card: residuals by kind, convergence, images, tracks, outcomes of segments."""
    key = '<span class="key" style="--c:var(--after)">after</span>' if before is not None else ""
    if before is not None:
        key = '<span class="key" style="--c:var(--before)">before</span>' + key
    cards = []
    for kind, name in enumerate(after.residual_kinds):
        lengths = _known(after, kind)
        if len(lengths):
            earlier = _known(before, kind) if before is not None else None
            caption = f"Share of {len(lengths):,} residuals by magnitude, on a logarithmic axis. {key}"
            cards.append((f"Residuals of {name}", caption, _charts.histogram(earlier, lengths)))
    if history is not None:
        caption = "Cost after each step, on a logarithmic axis. Hollow: a step that was refused."
        if len(stages) > 1:
            caption += " Each loss has a cost of its own; the curves cannot be compared."
        cards.append(("Convergence", caption, _charts.convergence(history, stages)))
    if len(after.residuals):
        limit = f" The {_charts.MAX_BARS} worst are shown." if len(after.image_names) > _charts.MAX_BARS else ""
        earlier_images = before.median_by_image if before is not None else None
        chart = _charts.bars(after.image_names, earlier_images, after.median_by_image)
        cards.append(("Images", f"Median residual, pixels, worst first.{limit} {key}", chart))
    lengths = _track_lengths(scene)
    if lengths:
        text = "".join(
            f'<span class="key" style="--c:var(--{"line" if kind == "lines" else "after"})">{kind}, mean '
            f"{values.mean():.3g}</span>"
            for kind, values in lengths.items()
        )
        cards.append(("Tracks", f"In how many images landmarks are observed. {text}", _charts.tracks(lengths)))
    made = "".join(card(name, caption, chart) for name, caption, chart in cards)
    if outcomes and sum(outcomes.values()):
        parts = [(*_OUTCOMES.get(name, (name.replace("_", " "), "#a0a4aa")), count) for name, count in outcomes.items()]
        chart = _charts.shares([(text, count, colour) for text, colour, count in parts])
        caption = html.escape(explanation) or f"{sum(outcomes.values()):,} were found in the images."
        made += card("What became of the segments", caption, chart)
    return made


def number_tables(scene: Scene, before: Drawable | None, after: Drawable, numbers: Mapping[str, Any] | None) -> str:
    """Return the tables of residuals, planes, directions, time and content."""
    text = _residual_table(before, after)
    text += _plane_table(scene, after) + _direction_table(scene)
    text += _relation_table(scene, {} if numbers is None else numbers.get("relations") or {})
    rows = [[name, f"{count:,}"] for name, count in counts_of(scene, after) if count]
    text += table("Scene", "What it holds.", ["", "number"], rows)
    if numbers is not None:
        spent = numbers["seconds"]
        seconds = [[words, f"{spent[name]:.3f} s"] for name, words in _STAGES.items() if name in spent]
        text += table(
            "Time",
            "Where the last adjustment spent it; the first run on a machine compiles, too.",
            ["stage", "seconds"],
            seconds,
        )
    return text


def diagnosis_card(diagnosis: Mapping[str, Any] | None) -> str:
    """Return the findings of a diagnosis and the numbers of determined landmarks."""
    if not diagnosis:
        return ""
    items = "".join(
        f'<li class="is-{html.escape(finding["severity"])}">{html.escape(finding["sentence"])}</li>'
        for finding in diagnosis["findings"]
    )
    rows = [
        [name.replace("_", " "), *(f"{counts[key]:,}" for key in ("determined", "weak", "undetermined"))]
        for name, counts in diagnosis.get("observability", {}).items()
    ]
    counts = _table(["", "determined", "weak", "not determined"], rows) if rows else ""
    caption = (
        "Red: not determined, the standard deviation exceeds the viewing distance (or a radian). Yellow: weak, or odd. "
        "The table takes the cameras as known."
    )
    return card("What the data determine", caption, f'<ul class="findings">{items}</ul>{counts}')


def contributions_card(entries: Sequence[Mapping[str, Any]] | None) -> str:
    """Return a chart and a table of adjustments with more and more kinds of landmarks."""
    if not entries:
        return ""
    pixels = list(dict.fromkeys(name for entry in entries for name in entry["rmse_px"]))
    measures: list[tuple[str, Callable[[Mapping[str, Any]], Any]]] = [
        ("landmarks", lambda entry: f"{entry['num_landmarks']:,}"),
        ("relations", lambda entry: f"{entry['num_relations']:,}"),
        ("rejected", lambda entry: f"{entry['num_dropped']:,}"),
        *((f"{name}, px", lambda entry, name=name: entry["rmse_px"].get(name)) for name in pixels),
        ("moved", lambda entry: entry["moved"] if entry["moved"] else None),
        ("predicted", lambda entry: entry["center_sigma"]),
        ("error", lambda entry: entry["center_error"]),
        ("rotation, °", lambda entry: entry["rotation_error_deg"]),
        ("steps", lambda entry: f"{entry['iterations']}"),
    ]
    rows = [
        [name, *("–" if cell is None else cell if isinstance(cell, str) else _digits.fixed(cell) for cell in cells)]
        for name, cells in ((name, [value(entry) for entry in entries]) for name, value in measures)
        if any(cell is not None for cell in cells)
    ]
    head = [("+ " if number else "") + entry["added"] for number, entry in enumerate(entries)]
    against = [entry for entry in entries if entry["center_error_percentiles"]]
    shown = against or entries[1:]
    chart, key = "", ""
    if shown:
        field = "center_error_percentiles" if against else "moved_percentiles"
        whence = "the reference, in its units" if against else "the point-only result, scene units"
        chart = _charts.spreads(
            [(head[entries.index(entry)], entry[field], entry["center_sigma"] if against else None) for entry in shown],
            f"distance of the camera centres from {whence}",
        )
        key = " Box: the middle half of the cameras, line: from the 5th to the 95th percentile."
        if against and any(entry["center_sigma"] is not None for entry in shown):
            key = key.removesuffix(".") + ", ring: predicted."
    caption = (
        "The same scene with points only, then with further landmarks. Residuals: rms of the inliers. Moved: "
        "median distance of the camera centres from the point-only result; predicted: their median standard "
        "deviation, seen from the first camera"
        + ("; error: rms; all in units of the reference." if against else "; in scene units.")
        + key
    )
    missing = sorted({entry["center_sigma_missing"] for entry in entries if entry["center_sigma_missing"]})
    if missing:
        caption += " Not predicted: " + "; ".join(missing).rstrip(".") + "."
    return card("With and without", html.escape(caption), chart + _table([" ", *head], rows))


def card(name: str, caption: str, content: str) -> str:
    """Return a titled box; caption and content are HTML."""
    return f'<section class="card"><h2>{html.escape(name)}</h2><p class="caption">{caption}</p>{content}</section>'


# ---------------------------------------------------------------------------------------------------------- Tables


def _residual_table(before: Drawable | None, after: Drawable) -> str:
    columns = ["before", "after"] if before is not None else ["now"]
    states = [state for state in (before, after) if state is not None]
    rows = []
    for kind, name in enumerate(after.residual_kinds):
        picked = [_known(state, kind) for state in states]
        if not len(picked[-1]):
            continue
        for label in _STATISTICS:
            rows.append([f"{name}, {label}", *(f"{_digits.fixed(_statistic(label, values))} px" for values in picked)])
    unseen = [int(np.isnan(state.lengths).sum()) for state in states]
    if any(unseen):
        rows.append(["not visible from their camera", *(f"{count:,}" for count in unseen)])
    caption = "Residuals of all observations. The rms counts wrong matches in full; the median does not notice them."
    if any(name == "line ends" for name in after.residual_kinds):
        caption += " The two ends of a segment count separately; the terminal and the summary take them together."
    if before is not None:
        caption += " Kinds that are adjusted together share what is left: one may grow while the robust cost falls."
    return table("Numbers", caption, ["", *columns], rows) if rows else ""


def _plane_table(scene: Scene, after: Drawable) -> str:
    held = int(np.count_nonzero(after.patch_members))  # planes without members have neither area nor distance
    if not held:
        return ""
    order = np.argsort(-after.patch_members, kind="stable")[: min(held, MAX_LISTED_PLANES)]
    colours = PALETTE[patch_groups(after.patch_members)]
    rows: list[list[str]] = []
    areas, far_off = [], []
    for plane in order.tolist():
        hesse = scene.planes.hesse[plane]
        points, lines = (
            pairs[pairs[:, 1] == plane, 0] for pairs in (scene.relations.point_on_plane, scene.relations.line_on_plane)
        )
        places = np.concatenate([scene.points.xyz[points], scene.lines.segments[lines].reshape(-1, 3)])
        far = places @ hesse[:3] + hesse[3]
        rows.append([f"{scene.planes.ids[plane]}", f"{len(points):,}", f"{len(lines):,}"])
        areas.append(patch_area(after.patches[plane]) if len(places) >= 3 else float("nan"))
        far_off.append(_statistic("rms", far[np.isfinite(far)]))
    for row, area, far in zip(rows, _digits.even(areas), _digits.even(far_off), strict=True):
        row += [area, far]
    marks = [_colours.css(colours[plane]) for plane in order]
    left, bare = held - len(order), scene.num_planes - held
    caption = "Area of what lies on them, and rms distance of it, in scene units."
    caption += f" The {len(order)} with most on them; {left:,} more are in the scene." if left else ""
    caption += f" Not listed: {counted(bare, 'planes')} with nothing of this scene on them." if bare else ""
    return table("Planes", caption, ["plane", "points", "lines", "area", "distance"], rows, marks)


def _relation_table(scene: Scene, outcomes: Mapping[str, Mapping[str, int]]) -> str:
    """Return a table of the relations by kind, with the numbers rejected by the adjustment."""
    there = num_relations(scene)
    rejected = {kind: f"{outcome['dropped']:,}" for kind, outcome in outcomes.items()}
    rows = [
        [kind.replace("_", " "), f"{there.get(kind, 0):,}", rejected.get(kind, "")]
        for kind in scene.relations.kinds()
        if kind in there or kind in rejected
    ]
    caption = "Structural relations: how many are in the scene, and how many more the last adjustment rejected. Lines "
    caption += "that meet are held on request."
    return table("Relations", caption, ["", "number", "rejected"], rows) if rows else ""


def _direction_table(scene: Scene) -> str:
    if not scene.num_directions:
        return ""
    members = np.bincount(scene.relations.line_along_direction[:, 1], minlength=scene.num_directions)
    order = np.argsort(-members, kind="stable")[:MAX_LISTED_DIRECTIONS]
    vectors = scene.directions.vectors[order]
    angles = np.rad2deg(np.arccos(np.clip(np.abs(vectors @ vectors.T), 0.0, 1.0)))
    rows = [
        [
            f"{scene.directions.ids[direction]}",
            f"{members[direction]:,}",
            *(f"{angles[row, column]:.1f}°" if column < row else "" for column in range(len(order) - 1)),
        ]
        for row, direction in enumerate(order.tolist())
    ]
    head = ["direction", "lines", *(f"to {number}" for number in scene.directions.ids[order[:-1]])]
    left = scene.num_directions - len(order)
    caption = "How many lines follow each, and the angles between them." + (f" {left:,} more follow." if left else "")
    marks = [_colours.css(PALETTE[direction % len(PALETTE)]) for direction in order]
    return table("Directions", caption, head, rows, marks)


def table(name: str, caption: str, head: list[str], rows: list[list[str]], marks: Sequence[str] = ()) -> str:
    """Return a card with a table; everything is text, and ``marks`` are colours before the rows."""
    return card(name, html.escape(caption), _table(head, rows, marks))


def _table(head: list[str], rows: list[list[str]], marks: Sequence[str] = ()) -> str:
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = ""
    for number, row in enumerate(rows):
        mark = f'<i class="mark" style="background:{marks[number]}"></i>' if marks else ""
        cells = "".join(f"<td>{mark if not place else ''}{html.escape(cell)}</td>" for place, cell in enumerate(row))
        body += f"<tr>{cells}</tr>"
    return f'<div class="wide"><table><tr>{top}</tr>{body}</table></div>'


# ------------------------------------------------------------------------------------------------------- Statistics


def _track_lengths(scene: Scene) -> dict[str, IntArray]:
    """Return the number of images of each landmark that is observed at all, by kind."""
    points, lines = scene.point_observations, scene.line_observations
    counts = {
        "points": images_of(points.point_idx, points.image_idx, scene.num_points),
        "lines": images_of(lines.line_idx, lines.image_idx, scene.num_lines),
    }
    return {kind: count[count > 0] for kind, count in counts.items() if count.any()}


def _known(shown: Drawable, kind: int) -> FloatArray:
    """Return the lengths of the residuals of a kind, where they are known."""
    lengths = shown.lengths[shown.residual_kind == kind]
    return lengths[np.isfinite(lengths)]


def _statistic(name: str, values: FloatArray) -> float:
    return float(_STATISTICS[name](values)) if len(values) else float("nan")
