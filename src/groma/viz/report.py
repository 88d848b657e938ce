# SPDX-License-Identifier: BSD-3-Clause
"""A scene, or a scene before and after adjustment, as one self-contained HTML file.

The file needs no network and no server: styles, viewer and data lie inside. The scene is drawn in 3D on a canvas;
charts are inline SVG; numbers stand in tables. Arrays travel as base64 float32, less a common offset, so that far
away coordinates keep their digits.
"""

from __future__ import annotations

import base64
import html
import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError, OutputError
from groma.viz import _charts
from groma.viz._drawable import Drawable, drawable
from groma.viz.overlays import overlay_section

if TYPE_CHECKING:
    from groma.scene import Scene

#: More points, and more residuals, than this are thinned out evenly: a page should open in a second.
MAX_POINTS = 200_000
MAX_RESIDUALS = 60_000


class Report(Protocol):
    """What the page reads of the report of an adjustment."""

    @property
    def history(self) -> Sequence[Any]:
        """Steps: mappings or objects with iteration, cost, accepted."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences for the user."""
        ...

    @property
    def termination(self) -> Any:
        """An enumeration member with a ``sentence``."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers of the machine-readable report."""
        ...


def write_report(
    path: str | os.PathLike[str],
    scene_before: Scene | None,
    scene_after: Scene,
    report: Report | None = None,
    images: Mapping[str, str | os.PathLike[str]] | None = None,
    title: str = "Adjustment",
) -> None:
    """Write a page that opens in any browser.

    Parameters
    ----------
    path
        The HTML file; it is replaced.
    scene_before, scene_after
        The same scene before and after; ``scene_before`` may be None to show a single scene.
    report
        Report of the adjustment, for the numbers, the convergence curve and the warnings.
    images
        Image files by image name, shown behind the residuals; others show residuals alone.
    title
        Heading of the page.

    Raises
    ------
    InputError
        If the two scenes do not hold the same landmarks and observations.
    OutputError
        If the file cannot be written.
    """
    after = drawable(scene_after)
    before = drawable(scene_before) if scene_before is not None else None
    if before is not None and not _same_shape(before, after):
        raise InputError(
            "scene_before and scene_after must hold the same images, landmarks and observations, in the same order; "
            "they do not. Pass the input and the result of one adjustment, or scene_before=None."
        )
    states = [state for state in (before, after) if state is not None]
    numbers = report.to_dict() if report is not None else None
    page = files("groma.viz").joinpath("_page.html").read_text(encoding="utf-8")
    parts = {
        "TITLE": html.escape(title),
        "LEAD": html.escape(_lead(after, report)),
        "TILES": _tiles(before, after, numbers),
        "WARNINGS": "".join(
            f'<p class="warning">{html.escape(text)}</p>' for text in (report.warnings if report else ())
        ),
        "CHARTS": _chart_cards(before, after, report),
        "NUMBERS": _numbers(before, after),
        "TABLES": _tables(after, numbers),
        "OVERLAYS": overlay_section(scene_after, images) if images else "",
        "FOOTER": _footer(),
        "DATA": _json(_data(states, images or {})),
    }
    page = re.sub(r"\{\{([A-Z]+)\}\}", lambda match: parts[match[1]], page)
    try:
        Path(path).write_text(page, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}. Choose another place.") from error


def _same_shape(first: Drawable, second: Drawable) -> bool:
    names = ("points", "segments", "quads", "cam_from_world", "residuals", "residual_image")
    return all(np.shape(getattr(first, name)) == np.shape(getattr(second, name)) for name in names)


# ----------------------------------------------------------------------------------------------------------- Words


def _counts(scene: Drawable) -> list[tuple[str, int]]:
    return [
        ("images", len(scene.cam_from_world)),
        ("points", len(scene.points)),
        ("lines", len(scene.segments)),
        ("planes", len(scene.quads)),
        ("observations", scene.num_observations),
    ]


def _lead(scene: Drawable, report: Report | None) -> str:
    counts = _words(_counts(scene))
    return f"{counts}. {report.termination.sentence}" if report is not None else f"{counts}."


def _words(counts: Sequence[tuple[str, int]]) -> str:
    return ", ".join(f"{count:,} {name if count != 1 else name[:-1]}" for name, count in counts if count)


def _rms(lengths: FloatArray) -> float:
    return float(np.sqrt(np.mean(known**2))) if len(known := _known(lengths)) else float("nan")


def _known(lengths: FloatArray) -> FloatArray:
    return lengths[np.isfinite(lengths)]


def _tiles(before: Drawable | None, after: Drawable, numbers: dict[str, Any] | None) -> str:
    def change(first: float | None, second: float, unit: str) -> str:
        start = f"{_short(first)} <i>→</i> " if first is not None else ""
        return f"{start}{_short(second)}{unit}"

    def summary(statistic: Callable[[FloatArray], float]) -> str:
        return change(statistic(before.lengths) if before is not None else None, statistic(after.lengths), " px")

    tiles = [(summary(_rms), "residual, root mean square"), (summary(_median), "residual, median")]
    if numbers is not None:
        tiles += [
            (change(numbers["initial_cost"], numbers["final_cost"], ""), "cost"),
            (f"{numbers['iterations']}", "steps"),
            (f"{numbers['seconds']['total']:.2f} s", "time of the solve"),
        ]
    else:
        tiles += [(f"{count:,}", name) for name, count in _counts(after)[:3]]
    return "".join(f'<div class="tile"><b>{value}</b><span>{label}</span></div>' for value, label in tiles)


def _short(value: float) -> str:
    """Return three digits, with k and M for thousands and millions."""
    for limit, unit in ((1e6, "M"), (1e3, "k")):
        if limit <= abs(value) < 1e3 * limit:
            return f"{value / limit:.3g} {unit}"
    return f"{value:.3g}"


def _footer() -> str:
    from groma import __version__

    return f"Written by groma {__version__}. Pixels: the centre of the first pixel is (0.5, 0.5)."


# ---------------------------------------------------------------------------------------------------------- Charts


def _with_start(report: Report) -> list[Any]:
    """Return the history with the cost at the start as step 0."""
    numbers = report.to_dict()
    stages = numbers.get("stages") or [numbers]
    start = {"iteration": 0, "cost": stages[0]["initial_cost"], "accepted": True, "stage": 1}
    return [start, *(step for step in report.history if _charts.entry(step)["iteration"] > 0)]


def _chart_cards(before: Drawable | None, after: Drawable, report: Report | None) -> str:
    key = '<span class="key" style="--c:var(--after)">after</span>'
    if before is not None:
        key = '<span class="key" style="--c:var(--before)">before</span>' + key
    cards = []
    if len(after.residuals):
        earlier = _known(before.lengths) if before is not None else None
        cards.append(
            (
                "Residuals",
                f"Share of the observations by length of the residual, logarithmic. {key}",
                _charts.histogram(earlier, _known(after.lengths)),
            )
        )
    if report is not None:
        cards.append(
            (
                "Convergence",
                "Cost after each step, logarithmic. Hollow: a step that was refused.",
                _charts.convergence(_with_start(report)),
            )
        )
    if len(after.residuals):
        shown = "" if len(after.image_names) <= _charts.MAX_BARS else f" The {_charts.MAX_BARS} worst are shown."
        cards.append(
            (
                "Images",
                f"Root mean square residual of each image, pixels, worst first.{shown} {key}",
                _charts.bars(
                    after.image_names, before.rms_by_image if before is not None else None, after.rms_by_image
                ),
            )
        )
    return "".join(
        f'<section class="card"><h2>{name}</h2><p class="caption">{caption}</p>{chart}</section>'
        for name, caption, chart in cards
    )


# ---------------------------------------------------------------------------------------------------------- Tables


def _numbers(before: Drawable | None, after: Drawable) -> str:
    columns = ["before", "after"] if before is not None else ["now"]
    states = [scene for scene in (before, after) if scene is not None]
    rows = []
    for number, kind in enumerate(after.residual_kinds):
        picked = [scene.lengths[scene.residual_kind == number] for scene in states]
        if not len(picked[0]):
            continue
        for label, function in (("rms", _rms), ("median", _median), ("95 of 100 below", _high), ("largest", _largest)):
            rows.append([f"{kind}, {label}", *(f"{function(values):.3f} px" for values in picked)])
    unseen = [int(np.isnan(scene.lengths).sum()) for scene in states]
    if any(unseen):
        rows.append(["not visible from their camera", *(f"{count:,}" for count in unseen)])
    return _card("Numbers", "Residuals of all observations.", ["", *columns], rows) if rows else ""


def _tables(after: Drawable, numbers: dict[str, Any] | None) -> str:
    text = ""
    if numbers is not None:
        seconds = [[name, f"{value:.3f} s"] for name, value in numbers["seconds"].items() if name != "total"]
        seconds.append(["total", f"{numbers['seconds']['total']:.3f} s"])
        text += _card("Time", "Where the solve spent it.", ["stage", "seconds"], seconds)
    text += _card("Scene", "What it holds.", ["", "number"], [[name, f"{count:,}"] for name, count in _counts(after)])
    return text


def _median(values: FloatArray) -> float:
    return float(np.median(known)) if len(known := _known(values)) else float("nan")


def _high(values: FloatArray) -> float:
    return float(np.percentile(known, 95)) if len(known := _known(values)) else float("nan")


def _largest(values: FloatArray) -> float:
    return float(known.max()) if len(known := _known(values)) else float("nan")


def _card(name: str, caption: str, head: list[str], rows: list[list[str]]) -> str:
    top = "".join(f"<th>{html.escape(cell)}</th>" for cell in head)
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    table = f"<table><tr>{top}</tr>{body}</table>"
    return f'<section class="card"><h2>{name}</h2><p class="caption">{caption}</p>{table}</section>'


# ------------------------------------------------------------------------------------------------------------ Data


@dataclass(frozen=True)
class _View:
    """Where the viewer starts."""

    pivot: FloatArray
    up: FloatArray
    azimuth: float
    elevation: float
    distance: float
    camera_size: float


def _data(states: list[Drawable], images: Mapping[str, str | os.PathLike[str]]) -> dict[str, Any]:
    after = states[-1]
    offset = _middle(after)
    keep = _thin(len(after.points), MAX_POINTS)
    view = _view(after, offset)
    entries, rows = _residual_rows(states, images)
    errors = np.concatenate([scene.point_errors[keep] for scene in states])
    known = errors[np.isfinite(errors) & (errors > 0)]
    return {
        "states": [
            {
                "points": _pack(scene.points[keep] - offset),
                "errors": _pack(np.nan_to_num(scene.point_errors[keep])) if len(known) else "",
                "lines": _pack(scene.segments - offset),
                "planes": _pack(scene.quads - offset),
                "cameras": _pack(_camera_axes(scene, offset)),
            }
            for scene in states
        ],
        "colours": base64.b64encode(after.colours[keep].tobytes()).decode() if after.colours is not None else "",
        "residuals": _pack(rows),
        "images": entries,
        "view": {
            "pivot": (view.pivot - offset).tolist(),
            "up": view.up.tolist(),
            "azimuth": view.azimuth,
            "elevation": view.elevation,
            "distance": view.distance,
            "camera_size": view.camera_size,
            "error_top": float(np.percentile(known, 90)) if len(known) else 1.0,
        },
    }


def _json(content: dict[str, Any]) -> str:
    # Nothing inside may end the script element or begin a comment.
    return json.dumps(content, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")


def _pack(values: FloatArray) -> str:
    return base64.b64encode(np.ascontiguousarray(np.nan_to_num(values), dtype="<f4").tobytes()).decode()


def _thin(count: int, limit: int) -> np.ndarray:
    return np.arange(count) if count <= limit else np.linspace(0, count - 1, limit).astype(np.int64)


def _middle(scene: Drawable) -> FloatArray:
    places = np.concatenate([scene.points, scene.segments.reshape(-1, 3), scene.centers])
    places = places[np.isfinite(places).all(axis=1)]
    return np.median(places, axis=0) if len(places) else np.zeros(3)


def _view(scene: Drawable, middle: FloatArray) -> _View:
    """Look from behind the cameras and from a little above, with nearly everything in the picture."""
    landmarks = np.concatenate([scene.points, scene.segments.reshape(-1, 3)])
    landmarks = landmarks[np.isfinite(landmarks).all(axis=1)]
    center = np.median(landmarks, axis=0) if len(landmarks) else middle
    axes = scene.world_from_cam_axes
    up = -axes[:, 1].sum(axis=0) if len(axes) else np.zeros(3)
    if np.linalg.norm(up) < 0.3 * max(len(axes), 1):
        up = np.array([0.0, 0.0, 1.0])  # cameras all around: no common up
    up = up / np.linalg.norm(up)
    back = scene.centers.mean(axis=0) - center if len(axes) else np.array([1.0, 1.0, 0.0])
    helper = np.array([1.0, 0.0, 0.0]) if abs(up[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(helper, up)
    first /= np.linalg.norm(first)
    second = np.cross(up, first)
    azimuth, elevation = float(np.arctan2(back @ second, back @ first)) + 0.45, 0.38
    back = np.cos(elevation) * (np.cos(azimuth) * first + np.sin(azimuth) * second) + np.sin(elevation) * up
    right = np.cross(up, back) / np.cos(elevation)
    frame = np.stack([right, np.cross(back, right), back])
    places = (np.concatenate([landmarks, scene.centers]) - center) @ frame.T
    low, high = (np.percentile(places, share, axis=0) if len(places) else np.zeros(3) for share in (3, 97))
    if len(axes):
        cameras = (scene.centers - center) @ frame.T
        low, high = np.minimum(low, cameras.min(axis=0)), np.maximum(high, cameras.max(axis=0))
    half = (high - low) / 2
    # The viewer's focal length is 1.1 times its height, and it is about twice as wide as high.
    distance = float(1.15 * max(2.2 * half[1], 1.1 * half[0]) + 0.6 * half[2]) or 1.0
    return _View(
        pivot=center + (low + half) @ frame,
        up=up,
        azimuth=azimuth,
        elevation=elevation,
        distance=distance,
        camera_size=0.018 * distance,
    )


def _camera_axes(scene: Drawable, offset: FloatArray) -> FloatArray:
    return np.concatenate([(scene.centers - offset)[:, None], scene.world_from_cam_axes], axis=1).reshape(-1, 12)


def _residual_rows(
    states: list[Drawable], images: Mapping[str, str | os.PathLike[str]]
) -> tuple[list[dict[str, Any]], FloatArray]:
    """Return per image where its rows begin and end, and the rows: measured place, then the residual of each state."""
    after = states[-1]
    order = np.argsort(after.residual_image, kind="stable")
    bounds = np.searchsorted(after.residual_image[order], np.arange(len(after.image_names) + 1))
    limit = max(50, MAX_RESIDUALS // max(len(after.image_names), 1))
    entries: list[dict[str, Any]] = []
    rows: list[FloatArray] = []
    begin = 0
    for index, name in enumerate(after.image_names):
        mine = order[bounds[index] : bounds[index + 1]]
        if not len(mine):
            continue
        shown = mine[_thin(len(mine), limit)]
        rows.append(
            np.concatenate([after.residual_place[shown], *(scene.residuals[shown] for scene in states)], axis=1)
        )
        left, top, width, height = _frame(after, index, mine)
        entries.append(
            {
                "name": name,
                "begin": begin,
                "end": begin + len(shown),
                "count": len(mine),
                "left": left,
                "top": top,
                "width": width,
                "height": height,
                "rms": [float(scene.rms_by_image[index]) for scene in states],
                "picture": _picture(images[name]) if name in images and len(entries) < 12 else "",
            }
        )
        begin += len(shown)
    return entries, np.concatenate(rows) if rows else np.zeros((0, 2 + 2 * len(states)))


def _frame(scene: Drawable, index: int, rows: np.ndarray) -> tuple[float, float, float, float]:
    """Return left, top, width, height of the image, or of what was measured in it where the size is unknown."""
    width, height = scene.image_sizes[index]
    if width > 0 and height > 0:
        return 0.0, 0.0, float(width), float(height)
    low, high = scene.residual_place[rows].min(axis=0), scene.residual_place[rows].max(axis=0)
    margin = 0.03 * max(float((high - low).max()), 1.0)
    left, top = low - margin
    width, height = np.maximum(high - low, 1.0) + 2 * margin
    return float(left), float(top), float(width), float(height)


def _picture(path: str | os.PathLike[str]) -> str:
    """Return the image file, made smaller, as a data address; empty when it cannot be read."""
    import cv2

    picture = cv2.imread(os.fspath(path))
    if picture is None:
        return ""
    scale = 1000 / picture.shape[1]
    if scale < 1:
        picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    good, encoded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 78])
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode() if good else ""
