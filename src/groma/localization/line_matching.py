# SPDX-License-Identifier: BSD-3-Clause
"""Segments of a query that may show lines of a map: by their surroundings, and where a pose says the lines are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.features.matching.descriptor import Descriptors
from groma.features.segments import Segments
from groma.gates import gate
from groma.geometry import se3
from groma.localization.camera import QueryCamera


@dataclass(frozen=True)
class GuidedLineGates:
    """Which segments may show a line that a pose puts near them."""

    angle: float = gate(0.1, "rad", "between a segment and the image of a line", "derived from the noise of short segments")
    overlap: float = gate(0.3, "share", "of the segment, that the image of the 3D segment covers", "convention: a third")
    descriptor: float = gate(0.9, "1", "largest distance of descriptors", "convention: that of wide_baseline")


GATES = GuidedLineGates()


@dataclass(frozen=True, eq=False)
class SeenLines:
    """Lines of a map, each with descriptors from some of its images."""

    #: (n,) the line that each descriptor belongs to, as a row of the segments below; (n, 72) descriptors.
    owner: IntArray
    descriptors: Descriptors
    #: (L, 2, 3) ends of the 3D segments.
    ends: FloatArray


def lines_near(
    camera: QueryCamera,
    pose: FloatArray,
    seen: SeenLines,
    segments: Segments,
    descriptors: Descriptors,
    reach: float,
    gates: GuidedLineGates = GATES,
) -> IntArray:
    """Return pairs (n, 2) of lines and segments that are near each other under a pose, and look alike.

    Parameters
    ----------
    camera, pose : QueryCamera, (7,)
        Where the image was taken from.
    seen
        Lines of the map.
    segments, descriptors
        Of the image.
    reach
        Largest distance of a segment's ends from the image of the line, pixels.
    gates
        Numbers of the search.
    """
    if not len(segments) or not len(seen.ends) or not len(seen.owner):
        return np.zeros((0, 2), np.int64)
    straight = camera.straight(segments.ends.reshape(-1, 2)).reshape(-1, 2, 2)
    projected, visible = _projected(camera, pose, seen.ends)
    near = _near(projected, straight, reach, gates) & visible[:, None]
    rows, columns = np.nonzero(near)
    if not len(rows):
        return np.zeros((0, 2), np.int64)
    far = _descriptor_distance(seen, descriptors)[rows, columns]
    alike = far <= gates.descriptor
    return np.column_stack([rows[alike], columns[alike]])


def _projected(camera: QueryCamera, pose: FloatArray, ends: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Images (L, 2, 2) of 3D segments without distortion, cut before the camera; and which are in front of it."""
    R_t = se3.to_matrix(pose[None])[0]
    inside = ends @ R_t[:3, :3].T + R_t[:3, 3]
    depth = inside[..., 2]
    least = 1e-3 * np.abs(depth).max(axis=1)
    behind = depth < least[:, None]
    step = np.where(depth == depth[:, ::-1], 1.0, depth[:, ::-1] - depth)
    share = np.clip((least[:, None] - depth) / step, 0.0, 1.0)
    cut = np.where(behind[..., None], inside + share[..., None] * (inside[:, ::-1] - inside), inside)
    visible = ~behind.all(axis=1)
    cut[~visible] = 1.0
    K = camera.matrix
    return cut[..., :2] / cut[..., 2:] * K[[0, 1], [0, 1]] + K[:2, 2], visible


def _near(lines: FloatArray, segments: FloatArray, reach: float, gates: GuidedLineGates) -> BoolArray:
    """Which of (L, M) images of lines and segments are near, of about the same direction, and side by side."""
    way = lines[:, 1] - lines[:, 0]
    length = np.maximum(np.linalg.norm(way, axis=1), 1e-9)
    along = way / length[:, None]
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    offset = segments[None] - lines[:, None, None, 0]
    across = np.abs(np.einsum("lmek,lk->lme", offset, normal)).max(axis=2)
    place = np.einsum("lmek,lk->lme", offset, along)
    own = segments[:, 1] - segments[:, 0]
    own_length = np.maximum(np.linalg.norm(own, axis=1), 1e-9)
    turn = np.abs(np.einsum("mk,lk->lm", own / own_length[:, None], normal))
    common = np.minimum(place.max(axis=2), length[:, None]) - np.maximum(place.min(axis=2), 0.0)
    with np.errstate(invalid="ignore"):
        return (across <= reach) & (turn <= gates.angle) & (common >= gates.overlap * own_length)


def _descriptor_distance(seen: SeenLines, descriptors: Descriptors) -> FloatArray:
    """Least distance (L, M) of the descriptors of each line from those of segments."""
    product = seen.descriptors @ descriptors.T
    best = np.full((len(seen.ends), len(descriptors)), -1.0, np.float32)
    np.maximum.at(best, seen.owner, product)
    return np.sqrt(np.maximum(2.0 - 2.0 * best.astype(np.float64), 0.0))


__all__ = ["GATES", "GuidedLineGates", "SeenLines", "lines_near"]
