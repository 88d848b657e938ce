# SPDX-License-Identifier: BSD-3-Clause
"""Observed and projected line segments over their images, as pieces of HTML that need nothing else.

Each image is a JPEG inside an inline SVG whose unit is the pixel of the image. The image of every 3D segment is a thin
white line; what was measured of it lies on top, coloured by its residual: where a segment is well explained the two
cover each other, and the white line goes on where the line is known from other images.
"""

from __future__ import annotations

import html
from collections.abc import Iterator

import numpy as np

from groma import cameras
from groma._typing import BoolArray, FloatArray, IntArray
from groma.errors import InputError
from groma.geometry import se3
from groma.scene import Scene
from groma.scene.line_intervals import one_line_per_interval
from groma.viz import colours as _colours
from groma.viz.pictures import ImageFiles, Picture, data_address, image_file, read_picture
from groma.viz.statistics import LineStatistics, line_statistics

#: Camera models under which the image of a straight line is straight.
_STRAIGHT = ("PINHOLE", "SIMPLE_PINHOLE")
#: Places along a segment where its image is computed under other models.
_SAMPLES = 17

_STYLE = """<style>
.overlays > div { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(480px, 100%), 1fr)); gap: 14px; }
.overlays figure { margin: 0; } .overlays figcaption { font-size: 13px; opacity: .75; overflow-wrap: anywhere; }
.overlays svg { display: block; width: 100%; height: auto; overflow: hidden; border-radius: 8px; background: #33363b; }
.overlays path { fill: none; stroke-linecap: round; vector-effect: non-scaling-stroke; }
.overlays .projected { stroke: #fff; stroke-width: 1; opacity: .85; }
.overlays .observed { stroke-width: 2.2; } .overlays .observed:hover { stroke-width: 5; }
.overlays > label { margin-right: 14px; font-size: 13px; }
.overlays .ramp { display: inline-block; width: 110px; height: 8px; border-radius: 4px; margin: 0 6px;
  background: linear-gradient(90deg, #2c6fbb, #3fb6a8, #e8c53a, #d9472b); }
.overlays > .o:not(:checked) ~ div .observed, .overlays > .p:not(:checked) ~ div .projected,
.overlays > .i:not(:checked) ~ div image { display: none; }
</style>"""


def line_overlays(
    scene: Scene,
    images: ImageFiles | None,
    max_images: int = 6,
    *,
    max_size: int = 1000,
    top_px: float | None = None,
    statistics: LineStatistics | None = None,
) -> list[str]:
    """Return one HTML ``<figure>`` per chosen image: the photograph with the lines seen in it.

    Parameters
    ----------
    scene : Scene
        Lines, their observations, images and cameras.
    images : path or mapping, optional
        Folder of the images, or files by image name. Images without a readable file are drawn on a dark ground.
    max_images : int
        At most so many images, spread over the scene: from each of as many stretches of it, the one with most lines.
    max_size : int
        Longer side of the photographs in the page, pixels.
    top_px : float, optional
        Residual with the last colour, pixels; by default :func:`residual_top` of the scene.
    statistics : LineStatistics, optional
        The numbers of the lines, where they are known already.

    Returns
    -------
    list of str
        Fragments without scripts, links or style; empty where no image observes a line.

    Raises
    ------
    InputError
        If ``max_images`` or ``max_size`` is not positive.
    """
    for name, value in (("max_images", max_images), ("max_size", max_size)):
        if value < 1:
            raise InputError(f"{name} must be at least 1; got {value}.")
    numbers = statistics or line_statistics(scene)
    top = top_px if top_px is not None else residual_top(numbers)
    return [_figure(scene, images, image, numbers, top, max_size) for image in _choose(scene, max_images)]


def overlay_section(scene: Scene, images: ImageFiles | None, max_images: int = 6, *, max_size: int = 1000) -> str:
    """Return a ``<section class="card">`` with the overlays, their style, legend and switches; empty without lines.

    The switches work without scripts. Parameters are those of :func:`line_overlays`.
    """
    numbers = line_statistics(scene)
    top = residual_top(numbers)
    figures = line_overlays(scene, images, max_images, max_size=max_size, top_px=top, statistics=numbers)
    if not figures:
        return ""
    switches = "".join(
        f'<input type="checkbox" class="{key}" id="overlay-{key}" checked> <label for="overlay-{key}">{text}</label>'
        for key, text in (("o", "measured"), ("p", "image of the 3D segment"), ("i", "photograph"))
    )
    return (
        f'<section class="card">{_STYLE}<h2>Lines in the images</h2>'
        '<p class="caption">Measured segments, coloured by their distance from the image of their line; thin and white '
        "the image of the whole 3D segment. Point at a segment for its numbers.</p>"
        f'<div class="overlays">{switches}<label>0 px<span class="ramp"></span>{top:.2g} px or more</label>'
        f"<div>{''.join(figures)}</div></div></section>"
    )


def residual_top(numbers: LineStatistics) -> float:
    """Residual that gets the last colour: what 95 of 100 observations stay below, at least 0.1 px."""
    known = numbers.observation_residual_px[np.isfinite(numbers.observation_residual_px)]
    return max(float(np.percentile(known, 95)), 0.1) if len(known) else 1.0


def is_straight(model: str) -> bool:
    """Tell whether the images of straight lines are straight under a camera model."""
    return model in _STRAIGHT


def projected_segments(scene: Scene, image_idx: int, line_idx: IntArray) -> list[FloatArray]:
    """Return the images of 3D segments as polylines (n, 2) in pixels; empty ones for segments behind the camera."""
    return [row[kept] for row, kept in zip(*projected_places(scene, image_idx, line_idx), strict=True)]


def projected_places(scene: Scene, image_idx: int, line_idx: IntArray) -> tuple[FloatArray, BoolArray]:
    """Return places along the images of 3D segments (N, n, 2) in pixels, and which of them are seen (N, n).

    Parameters
    ----------
    scene : Scene
        The scene.
    image_idx : int
        The image.
    line_idx : (n,) int
        Lines.
    """
    camera = int(scene.images.camera_idx[image_idx])
    model = cameras.model(scene.cameras.models[camera])
    params = np.ascontiguousarray(scene.cameras.params[camera, : model.num_parameters])
    pose = se3.to_matrix(scene.cam_from_world[image_idx : image_idx + 1])[0]
    ends = scene.lines.segments[line_idx] @ pose[:3, :3].T + pose[:3, 3]
    depth = ends[..., 2]
    near = 1e-3 * np.abs(depth).max(axis=1, initial=1e-12)
    if model.sees_behind:
        near = np.full_like(near, -np.inf)
    # Where a segment passes through the camera's plane only the part before it is seen.
    share = np.clip((near[:, None] - depth) / np.where(depth == depth[:, ::-1], 1.0, depth[:, ::-1] - depth), 0.0, 1.0)
    ends = np.where((depth < near[:, None])[..., None], ends + share[..., None] * (ends[:, ::-1] - ends), ends)
    steps = np.linspace(0.0, 1.0, 2 if is_straight(model.name) else _SAMPLES)[None, :, None]
    places = ends[:, :1] * (1.0 - steps) + ends[:, 1:] * steps
    pixels = model.project(params, np.ascontiguousarray(places.reshape(-1, 3))).reshape(*places.shape[:2], 2)
    if not model.is_planar:  # on across the border rather than back through the image
        ways = model.pixel_difference(params, pixels[:, 1:].reshape(-1, 2), pixels[:, :-1].reshape(-1, 2))
        pixels[:, 1:] = pixels[:, :1] + np.cumsum(ways.reshape(len(pixels), -1, 2), axis=1)
    good = np.isfinite(pixels).all(axis=2) & (depth.max(axis=1) > near)[:, None]
    return pixels, good


def observation_crop(
    picture: Picture, size: tuple[float, float], segment: FloatArray, ways: FloatArray, colour: str, width: int = 300
) -> str:
    """Return an inline SVG of the surroundings of one observed segment, with what the scene says about it.

    Parameters
    ----------
    picture : (H, W, 3) uint8
        The photograph.
    size : (width, height)
        Size of the image in the pixels of the observation; zero where it is that of the photograph.
    segment : (4,) float
        Measured ends, pixels.
    ways : (2, 2) float
        Ways from the ends to the image of the line, pixels.
    colour : str
        Colour of the measured segment.
    width : int
        Width of the photograph in the page, pixels.
    """
    full = np.array([size[0] or picture.shape[1], size[1] or picture.shape[0]], float)
    ends = segment.reshape(2, 2)
    across, down = 0.6 * np.abs(ends[1] - ends[0]) + 12.0
    half = np.array([max(across, 1.6 * down), max(down, 0.4 * across)])
    scale = np.array(picture.shape[1::-1]) / full
    low = np.floor(np.clip(ends.mean(axis=0) - half, 0.0, full) * scale).astype(int)
    high = np.ceil(np.clip(ends.mean(axis=0) + half, 0.0, full) * scale).astype(int)
    high = np.maximum(high, low + 1)
    piece = picture[low[1] : high[1], low[0] : high[0]]
    if piece.size == 0:
        return ""
    step = max(1, piece.shape[1] // (2 * width))
    (left, top), (wide, tall) = low / scale, (high - low) / scale
    lines = [_path("p", "#fff", ends + np.nan_to_num(ways), 'stroke-width="3"'), _path("o", colour, ends)]
    return (
        f'<svg viewBox="{left:.1f} {top:.1f} {wide:.1f} {tall:.1f}" style="width:100%;display:block;border-radius:4px">'
        f'<image href="{data_address(np.ascontiguousarray(piece[::step, ::step]))}" x="{left:.1f}" y="{top:.1f}" '
        f'width="{wide:.1f}" height="{tall:.1f}" preserveAspectRatio="none"/>{"".join(lines)}</svg>'
    )


# ------------------------------------------------------------------------------------------------------------- Parts


def _choose(scene: Scene, count: int) -> IntArray:
    """Return images that observe lines, spread over the scene."""
    lines = np.bincount(scene.line_observations.image_idx, minlength=scene.num_images)
    stretches = np.array_split(np.flatnonzero(lines), min(count, max(int((lines > 0).sum()), 1)))
    return np.array([part[np.argmax(lines[part])] for part in stretches if len(part)], np.int64)


def _figure(
    scene: Scene, images: ImageFiles | None, image: int, numbers: LineStatistics, top: float, max_size: int
) -> str:
    seen = scene.line_observations
    rows = np.flatnonzero(seen.image_idx == image)
    # The worst are drawn last, so that they are not covered.
    rows = rows[np.argsort(np.nan_to_num(numbers.observation_residual_px[rows], nan=-1.0), kind="stable")]
    name = scene.images.names[image]
    path = image_file(images, name)
    picture = read_picture(path, max_size) if path is not None else None
    left, upper, width, height = _frame(scene, image, rows)
    ground = (
        f'<image href="{data_address(picture)}" x="0" y="0" width="{width:g}" height="{height:g}" '
        'preserveAspectRatio="none"/>'
        if picture is not None and left == upper == 0.0
        else ""
    )
    lines, pieces = seen.line_idx[rows], one_line_per_interval(scene)
    projected = "".join(
        f'<path class="projected" d="{_points(places)}"/>'
        for places in _near_frame(
            projected_segments(pieces, image, pieces.line_observations.line_idx[rows]), left, upper, width, height
        )
        if len(places) > 1
    )
    residual = numbers.observation_residual_px[rows]
    observed = "".join(
        f'<path class="observed" stroke="{_colours.css(colour)}" d="{_points(segment.reshape(2, 2))}"><title>'
        f"line {scene.lines.ids[line]}: {far:.2f} px here, {numbers.residual_px[line]:.2f} px over "
        f"{numbers.num_images[line]} images, length {numbers.length[line]:.4g}</title></path>"
        for segment, line, far, colour in zip(
            seen.segment[rows], lines, residual, _colours.ramp(residual / top), strict=True
        )
    )
    known = residual[np.isfinite(residual)]
    middle = f", median residual {np.median(known):.2f} px" if len(known) else ""
    return (
        f'<figure><svg viewBox="{left:g} {upper:g} {width:g} {height:g}" role="img">{ground}<g>{projected}</g>'
        f"<g>{observed}</g></svg><figcaption>{html.escape(name)}: {len(rows):,} segments{middle}"
        f"{'' if picture is not None else ' (no photograph)'}</figcaption></figure>"
    )


def _frame(scene: Scene, image: int, rows: IntArray) -> tuple[float, float, float, float]:
    """Return left, top, width, height of an image, or of what was measured in it where its size is unknown."""
    camera = scene.images.camera_idx[image]
    width, height = float(scene.cameras.width[camera]), float(scene.cameras.height[camera])
    if width > 0 and height > 0:
        return 0.0, 0.0, width, height
    ends = scene.line_observations.segment[rows].reshape(-1, 2)
    low, high = ends.min(axis=0) - 10.0, ends.max(axis=0) + 10.0
    return float(low[0]), float(low[1]), float(high[0] - low[0]), float(high[1] - low[1])


def _near_frame(
    polylines: list[FloatArray], left: float, top: float, width: float, height: float
) -> Iterator[FloatArray]:
    """Drop places of bent lines that are far outside, where models of distortion are not meant to be used."""
    low, high = np.array([left - width, top - height]), np.array([left + 2 * width, top + 2 * height])
    for places in polylines:
        yield places if len(places) == 2 else places[((places > low) & (places < high)).all(axis=1)]


def _points(places: FloatArray) -> str:
    return "M" + " ".join(f"{x:.1f} {y:.1f}" for x, y in places)


def _path(name: str, colour: str, places: FloatArray, more: str = 'stroke-width="2"') -> str:
    return (
        f'<path class="{name}" d="{_points(places)}" stroke="{colour}" fill="none" stroke-linecap="round" '
        f'vector-effect="non-scaling-stroke" {more}/>'
    )
