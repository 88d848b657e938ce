# SPDX-License-Identifier: BSD-3-Clause
"""Renderings with exact truth: anti-aliased polygons whose edges are known below a hundredth of a pixel."""

import numpy as np
from scipy.special import ndtr


def coverage(vertices, width, height, samples=8):
    """Share of each pixel covered by a convex polygon; vertices count from the corner of the image."""
    vertices = np.asarray(vertices, dtype=np.float64)
    # Beside the polygon there is nothing to sample.
    left, top = np.clip(np.floor(vertices.min(axis=0)), 0, [width, height]).astype(int)
    right, bottom = np.clip(np.ceil(vertices.max(axis=0)), [left, top], [width, height]).astype(int)
    u = (np.arange(left * samples, right * samples) + 0.5) / samples
    v = (np.arange(top * samples, bottom * samples) + 0.5) / samples
    inside = np.ones((len(v), len(u)), dtype=bool)
    center = vertices.mean(axis=0)
    for start, end in zip(vertices, np.roll(vertices, -1, axis=0), strict=True):
        normal = np.array([start[1] - end[1], end[0] - start[0]])
        if normal @ (center - start) < 0.0:
            normal = -normal
        inside &= (u[None, :] - start[0]) * normal[0] + (v[:, None] - start[1]) * normal[1] >= 0.0
    share = np.zeros((height, width))
    share[top:bottom, left:right] = inside.reshape(bottom - top, samples, right - left, samples).mean(axis=(1, 3))
    return share


def rectangle(center, half, angle):
    """Corners (4, 2) of a turned rectangle."""
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(center) + (np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half) @ np.array([[c, s], [-s, c]])


def to_uint8(image, rng=None, noise=0.0):
    if rng is not None:
        image = image + rng.normal(0.0, noise, image.shape)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def box_image(rng, noise, dark=60.0, bright=190.0, size=160, angle=None):
    """One bright turned box; its grey image and corners."""
    angle = rng.uniform(0.0, 2.0 * np.pi) if angle is None else angle
    corners = rectangle(size / 2 + rng.uniform(-2.0, 2.0, 2), rng.uniform(32.0, 48.0, 2), angle)
    return to_uint8(dark + (bright - dark) * coverage(corners, size, size), rng, noise), corners


def edges_of(corners):
    """(4, 4) edges of a polygon."""
    return np.hstack([corners, np.roll(corners, -1, axis=0)])


def distance_to_edges(ends, corners):
    """Signed distances (N, 2) of both end points from the nearest edge (positive outside), and that edge's index."""
    edges = edges_of(corners)
    along = (edges[:, 2:] - edges[:, :2]) / np.linalg.norm(edges[:, 2:] - edges[:, :2], axis=1, keepdims=True)
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    outward = normal * np.sign(((edges[:, :2] - corners.mean(axis=0)) * normal).sum(axis=1))[:, None]
    distances = np.stack(
        [((ends[:, None, k : k + 2] - edges[None, :, :2]) * outward).sum(axis=-1) for k in (0, 2)], axis=-1
    )
    nearest = np.abs(distances).max(axis=-1).argmin(axis=1)
    return distances[np.arange(len(ends)), nearest], nearest, outward


def board(rng, width=320, height=240, tiles=14):
    """A cluttered scene of random tiles: a float image, repeated nowhere."""
    image = np.full((height, width), 110.0)
    for _ in range(tiles):
        corners = rectangle(rng.uniform([30, 30], [width - 30, height - 30]), rng.uniform(14, 42, 2), rng.uniform(0, 3))
        cover = coverage(corners, width, height, 4)
        image = image * (1.0 - cover) + rng.uniform(10.0, 245.0) * cover
    return image


def _twice_integrated(x, blur):
    """Second integral of a blurred step."""
    z = x / blur
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)
    return 0.5 * ((x * x + blur * blur) * ndtr(z) + blur * x * density)


def steps(angle, offsets, heights, base, blur, size=96, turn=0.0):
    """Steps across parallel lines, blurred and integrated over square pixels exactly; offsets are to the right hand.

    Steps after the first are turned by an angle against it.
    """
    y, x = np.mgrid[0:size, 0:size] + 0.5 - size / 2
    image = np.full((size, size), float(base))
    for k, (offset, height) in enumerate(zip(offsets, heights, strict=True)):
        at = angle + (turn if k else 0.0)
        distance = y * np.cos(at) - x * np.sin(at) - offset
        a, b = max(abs(np.sin(at)), 1e-3), max(abs(np.cos(at)), 1e-3)
        corners = [(a + b, 1.0), (a - b, -1.0), (b - a, -1.0), (-a - b, 1.0)]
        image += height * sum(sign * _twice_integrated(distance + c / 2, blur) for c, sign in corners) / (a * b)
    return image


def segment_on(angle, offset, length, size=96):
    """Ends (1, 4) of a segment along the middle of a step of :func:`steps`, darker side left if it rises."""
    along, across = np.array([np.cos(angle), np.sin(angle)]), np.array([-np.sin(angle), np.cos(angle)])
    middle = size / 2 + offset * across
    return np.concatenate([middle - 0.5 * length * along, middle + 0.5 * length * along])[None]
