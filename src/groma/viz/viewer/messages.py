# SPDX-License-Identifier: BSD-3-Clause
"""Messages of the panel of the viewer, as HTML."""

from __future__ import annotations

import html

import numpy as np

from groma._counted import counted
from groma.scene import Scene
from groma.viz import colours as _colours
from groma.viz.pack import thin
from groma.viz.pictures import ImageFiles, image_file, read_picture
from groma.viz.report.overlays import observation_crop, residual_top
from groma.viz.report.tables import words
from groma.viz.viewer.content import ViewContent

#: Listed observations of a line, and crops of photographs.
MAX_LISTED = 40
MAX_CROPS = 4
HINT = "Click a line to see where it was observed."
_RAMP = "linear-gradient(90deg,#2c6fbb,#3fb6a8,#e8c53a,#d9472b)"


def counts(scene: Scene, max_cameras: int) -> str:
    """Return the counts of a scene, and how many cameras are drawn."""
    kinds = ("images", "points", "lines", "planes", "directions")
    text = words([(kind, getattr(scene, f"num_{kind}")) for kind in kinds])
    return text + (f". {max_cameras} of the cameras are drawn" if scene.num_images > max_cameras else "")


def legend(low: str | None, high: str | None, meaning: str, shown: int, count: int) -> str:
    """Return the ramp of the colours of the lines, and how many of them are drawn."""
    text = f"{shown:,} of {count:,} lines." if shown < count else ""
    if low is None:
        return note(" ".join(part for part in (meaning, text) if part))
    bar = f"<span style='flex:1;height:8px;border-radius:4px;background:{_RAMP}'></span>"
    return (
        f"<div style='padding:0 1em;font-size:0.8em'><div style='display:flex;gap:8px;align-items:center'>"
        f"{html.escape(low)}{bar}{html.escape(high or '')}</div>{text}</div>"
    )


def note(text: str) -> str:
    """Return a sentence in small grey letters."""
    return f"<div style='padding:0.2em 1em;font-size:0.8em;opacity:.7'>{html.escape(text)}</div>"


def describe_line(content: ViewContent, line: int, images: ImageFiles | None = None) -> str:
    """Return the numbers of a line, its observations worst first, and the photographs around some of them."""
    numbers, scene = content.statistics, content.scene
    seen = scene.line_observations
    rows = np.flatnonzero(seen.line_idx == line)
    order = rows[np.argsort(-np.nan_to_num(numbers.observation_residual_px[rows], nan=np.inf), kind="stable")]
    top = residual_top(numbers)
    planes = scene.relations.line_on_plane
    on = ", ".join(str(scene.planes.ids[plane]) for plane in planes[planes[:, 0] == line, 1])
    met = ", ".join(str(scene.lines.ids[other]) for other in content.lines_met(line))
    lines = [
        f"<b>Line {scene.lines.ids[line]}</b>: length {numbers.length[line]:.4g}, "
        f"{counted(int(numbers.num_images[line]), 'images')}, {_px(numbers.residual_px[line])} rms"
        + (f", on plane {on}" if on else "")
        + (f", meets line {met}" if met else "")
    ]
    for row in order[thin(len(order), MAX_CROPS)]:
        lines.append(
            _crop(content, int(row), images, _colours.css(_colours.ramp(numbers.observation_residual_px[row] / top)))
        )
    left = "<td style='text-align:left;overflow-wrap:anywhere'>"
    entries = [f"<tr style='opacity:.6'>{left}image</td><td colspan='2'>ends, px</td><td>long, px</td></tr>"]
    for row in order[:MAX_LISTED]:
        first, second = np.linalg.norm(numbers.end_residuals[row], axis=1)
        length = np.linalg.norm(seen.segment[row, 2:] - seen.segment[row, :2])
        entries.append(
            f"<tr>{left}{html.escape(scene.images.names[seen.image_idx[row]])}</td>"
            f"<td>{first:.2f}</td><td>{second:.2f}</td><td>{length:.0f}</td></tr>"
        )
    style = "width:100%;text-align:right;border-spacing:6px 1px;font-variant-numeric:tabular-nums"
    lines.append(
        f"<div style='max-height:16em;overflow-y:auto'><table style='{style}'>{''.join(entries)}</table></div>"
    )
    if len(order) > MAX_LISTED:
        lines.append(note(f"and {len(order) - MAX_LISTED} more"))
    return f"<div style='padding:0.4em 1em;font-size:0.85em'>{''.join(lines)}</div>"


def _crop(content: ViewContent, row: int, images: ImageFiles | None, colour: str) -> str:
    scene, seen = content.scene, content.scene.line_observations
    image = int(seen.image_idx[row])
    path = image_file(images, scene.images.names[image])
    picture = read_picture(path) if path is not None else None
    if picture is None:
        return ""
    camera = scene.images.camera_idx[image]
    size = float(scene.cameras.width[camera]), float(scene.cameras.height[camera])
    ends, ways = seen.segment[row].reshape(2, 2), content.statistics.end_residuals[row]
    for _ in range(content.camera_turns[image]):
        picture, size = np.rot90(picture, -1), (size[1], size[0])
        ends = np.column_stack([(size[0] or picture.shape[1]) - ends[:, 1], ends[:, 0]])
        ways = np.column_stack([-ways[:, 1], ways[:, 0]])
    crop = observation_crop(picture, size, ends.ravel(), ways, colour)
    return f"<div style='margin:6px 0 2px;opacity:.75'>{html.escape(scene.images.names[image])}</div>{crop}"


def _px(value: float) -> str:
    return f"{value:.2f} px" if np.isfinite(value) else "not measured"
