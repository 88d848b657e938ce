# SPDX-License-Identifier: BSD-3-Clause
"""Images of 3D segments, and crops of photographs around observed segments, as inline SVG."""

from __future__ import annotations

import numpy as np

from groma import cameras
from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry import se3
from groma.scene import Scene
from groma.viz.pictures import Picture, data_address
from groma.viz.statistics import LineStatistics

#: Places along a segment where its image is computed under models with distortion.
_SAMPLES = 17
#: Width of a crop in the page, pixels.
_CROP = 300


def residual_top(numbers: LineStatistics) -> float:
    """Residual that gets the last colour: what 95 of 100 observations stay below, at least 0.1 px."""
    known = numbers.observation_residual_px[np.isfinite(numbers.observation_residual_px)]
    return max(float(np.percentile(known, 95)), 0.1) if len(known) else 1.0


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
    steps = np.linspace(0.0, 1.0, 2 if model.has_pinhole_parameters else _SAMPLES)[None, :, None]
    places = ends[:, :1] * (1.0 - steps) + ends[:, 1:] * steps
    pixels = model.project(params, np.ascontiguousarray(places.reshape(-1, 3))).reshape(*places.shape[:2], 2)
    if not model.is_planar:  # on across the border rather than back through the image
        ways = model.pixel_difference(params, pixels[:, 1:].reshape(-1, 2), pixels[:, :-1].reshape(-1, 2))
        pixels[:, 1:] = pixels[:, :1] + np.cumsum(ways.reshape(len(pixels), -1, 2), axis=1)
    good = np.isfinite(pixels).all(axis=2) & (depth.max(axis=1) > near)[:, None]
    return pixels, good


def observation_crop(
    picture: Picture, size: tuple[float, float], segment: FloatArray, ways: FloatArray, colour: str
) -> str:
    """Return an inline SVG of the surroundings of one observed segment, with the image of its 3D line.

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
    step = max(1, piece.shape[1] // (2 * _CROP))
    (left, top), (wide, tall) = low / scale, (high - low) / scale
    lines = [
        f'<path d="M{x1:.1f} {y1:.1f} {x2:.1f} {y2:.1f}" stroke="{stroke}" stroke-width="{thick}" fill="none" '
        'stroke-linecap="round" vector-effect="non-scaling-stroke"/>'
        for ((x1, y1), (x2, y2)), stroke, thick in ((ends + np.nan_to_num(ways), "#fff", 3), (ends, colour, 2))
    ]
    return (
        f'<svg viewBox="{left:.1f} {top:.1f} {wide:.1f} {tall:.1f}" style="width:100%;display:block;border-radius:4px">'
        f'<image href="{data_address(np.ascontiguousarray(piece[::step, ::step]))}" x="{left:.1f}" y="{top:.1f}" '
        f'width="{wide:.1f}" height="{tall:.1f}" preserveAspectRatio="none"/>{"".join(lines)}</svg>'
    )
