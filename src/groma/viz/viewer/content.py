# SPDX-License-Identifier: BSD-3-Clause
"""Content of the viewer as arrays, without server or browser.

The frame of the viewer has its origin in the middle of the scene, +z up, and the scene is about ten units wide: places
far from the world origin keep their digits in single precision, and sizes are independent of the scene. Displayed
numbers are in scene units and pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.geometry import quaternion
from groma.io.drawn import openings
from groma.scene import Scene
from groma.scene.line_intervals import line_pieces
from groma.scene.local_frame import up_of
from groma.scene.similarity import Similarity
from groma.viz import colours as _colours
from groma.viz.colours import Colours
from groma.viz.drawable import Drawable, drawable, junctions
from groma.viz.framing import OPENING, horizontal, starting_view
from groma.viz.pictures import ImageFiles, turns_of
from groma.viz.statistics import LineStatistics, line_statistics

#: Half the size of the scene in the frame of the viewer: half the height of the initial picture, where it is centred.
REACH = 5.0
#: Colour modes of lines.
LINE_MODES = ("direction", "shared direction", "length", "reprojection error", "number of images", "confidence")


@dataclass(frozen=True)
class LineColours:
    """Colours of the lines, and the labels of the ramp."""

    #: (L, 3)
    colours: Colours
    #: Labels of the ends of the ramp; None for colours that do not show numbers.
    low: str | None = None
    high: str | None = None
    #: The meaning of such colours.
    meaning: str = ""


@dataclass(frozen=True)
class ViewContent:
    """The content of the viewer."""

    scene: Scene
    statistics: LineStatistics
    view_from_world: Similarity
    #: (P, 3) points in a random order: the first of them are an even sample.
    points: FloatArray
    #: By mode: (P, 3), in the same order.
    point_colours: dict[str, Colours]
    #: (S, 2, 3) supported intervals of the lines, and the line (S,) of each.
    segments: FloatArray
    segment_line: IntArray
    #: K convex polygons (n, 3), and how many landmarks lie on each.
    patches: list[FloatArray]
    patch_members: IntArray
    #: (J, 3) places where lines meet, and the two lines (J, 2) of each.
    junctions: FloatArray
    junction_lines: IntArray
    #: (D, 3) unit vectors, and how many lines follow each.
    directions: FloatArray
    direction_members: IntArray
    #: (N, 4) quaternions [w x y z] and (N, 3) places of the cameras, ``view_from_cam``.
    camera_wxyz: FloatArray
    camera_centers: FloatArray
    #: (N,) vertical opening, radians, and width over height.
    camera_openings: FloatArray
    camera_aspects: FloatArray
    #: (N,) quarter turns to the right that show their photographs upright.
    camera_turns: IntArray
    #: Initial viewpoint; it looks at the origin.
    start_position: FloatArray

    def upright_from(self, image: int) -> tuple[FloatArray, float]:
        """Return the orientation [w x y z] and the vertical opening of a view in which a photograph is upright."""
        turns, opening = self.camera_turns[image], self.camera_openings[image]
        roll = np.array([0.0, 0.0, -np.sin(0.25 * np.pi * turns), np.cos(0.25 * np.pi * turns)])
        if turns % 2:
            opening = 2.0 * np.arctan(self.camera_aspects[image] * np.tan(0.5 * opening))
        return quaternion.multiply(self.camera_wxyz[image, [1, 2, 3, 0]], roll)[[3, 0, 1, 2]], float(opening)

    def line_colours(self, mode: str) -> LineColours:
        """Return the colours of the lines by one of ``LINE_MODES``."""
        numbers = self.statistics
        if mode == "length":
            return _by_number(numbers.length, "", logarithmic=True)
        if mode == "reprojection error":
            return _by_number(numbers.residual_px, " px", from_zero=True)
        if mode == "number of images":
            return _by_number(numbers.num_images.astype(float), " images")
        if mode == "confidence":
            known = np.where(self.scene.lines.confidence >= 0.0, self.scene.lines.confidence, np.nan)
            return LineColours(_colours.ramp(known), "0 ", "1 ", "Probability to be right; grey: not known.")
        if mode == "shared direction":
            meaning = "One colour per shared direction; others grey."
            return LineColours(_colours.of_shared_directions(self.scene), meaning=meaning)
        meaning = "Red, blue and green along the three directions at right angles that most lines follow; others grey."
        return LineColours(_colours.of_lines(self.scene), meaning=meaning)

    def lines_met(self, line: int) -> IntArray:
        """Return the lines that a line meets."""
        pairs = self.junction_lines
        return np.unique(np.concatenate([pairs[pairs[:, 0] == line, 1], pairs[pairs[:, 1] == line, 0]]))

    def pick(self, origin: FloatArray, direction: FloatArray, tolerance: float, shown: BoolArray) -> int | None:
        """Return the line under a ray, or None.

        Parameters
        ----------
        origin, direction : (3,) float
            The ray, in the frame of the viewer.
        tolerance : float
            Tangent of the angle up to which a line counts as hit.
        shown : (L,) bool
            Lines that can be hit.
        """
        distance, depth = ray_to_segments(origin, direction, self.segments)
        distance[~shown[self.segment_line]] = np.inf
        nearest = distance.min(initial=np.inf)
        if not nearest <= tolerance:
            return None
        # Of lines that are hit about equally well, the one in front.
        candidates = np.flatnonzero(distance <= nearest + 0.25 * tolerance)
        return int(self.segment_line[candidates[np.argmin(depth[candidates])]])


def view_content(scene: Scene, images: ImageFiles | None = None) -> ViewContent:
    """Compute what the viewer draws of a scene, whose photographs may have been taken with the camera on its side."""
    turns = turns_of(images, scene.images.names)
    shown = replace(drawable(scene), up=up_of(scene, turns))
    pieces, line = line_pieces(scene)
    frame, position = _frame(shown)
    order = np.random.default_rng(0).permutation(scene.num_points)
    errors = shown.point_errors[order]
    known = errors[np.isfinite(errors)]
    point_colours = {}
    if scene.points.color.any():
        point_colours["photographs"] = np.ascontiguousarray(scene.points.color[order])
    if len(known):
        point_colours["reprojection error"] = _colours.ramp(errors / max(float(np.percentile(known, 90)), 1e-12))
    point_colours["plain"] = np.tile(np.array([[96, 104, 116]], np.uint8), (len(order), 1))
    world_from_cam = quaternion.conjugate(frame.poses(scene.cam_from_world)[:, :4])
    opening, aspect = openings(scene)
    return ViewContent(
        scene=scene,
        statistics=line_statistics(scene, shown),
        view_from_world=frame,
        points=frame.points(scene.points.xyz[order]),
        point_colours=point_colours,
        segments=frame.points(pieces),
        segment_line=line,
        patches=[frame.points(patch) for patch in shown.patches],
        patch_members=shown.patch_members,
        junctions=frame.points(junctions(shown.segments, scene.relations.lines_meeting)),
        junction_lines=scene.relations.lines_meeting,
        directions=frame.directions(scene.directions.vectors),
        direction_members=np.bincount(
            scene.relations.line_along_direction[:, 1], minlength=scene.num_directions
        ).astype(np.int64),
        camera_wxyz=world_from_cam[:, [3, 0, 1, 2]],
        camera_centers=frame.points(scene.cam_centers_in_world),
        camera_openings=opening,
        camera_aspects=aspect,
        camera_turns=turns,
        start_position=position,
    )


def ray_to_segments(origin: FloatArray, direction: FloatArray, segments: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return angular distances of segments (L, 2, 3) from a ray, seen from its origin.

    Returns
    -------
    distance : (L,) float
        Tangent of the smallest angle between the ray and a point of the segment; infinite behind the origin.
    depth : (L,) float
        Depth along the ray where that is.
    """
    forward = np.asarray(direction, float) / np.linalg.norm(direction)
    side = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    side /= np.linalg.norm(side)
    seen = (segments - origin) @ np.stack([side, np.cross(forward, side), forward]).T
    depth = seen[..., 2]
    near = 1e-6 * np.maximum(np.abs(depth).max(axis=1, initial=0.0), 1e-12)
    # Clip the part behind; the rest projects to a segment in the plane at depth 1.
    gap = depth[:, ::-1] - depth
    share = np.clip((near[:, None] - depth) / np.where(gap == 0.0, 1.0, gap), 0.0, 1.0)
    cut = np.where((depth < near[:, None])[..., None], seen + share[..., None] * (seen[:, ::-1] - seen), seen)
    cut[..., 2] = np.maximum(cut[..., 2], near[:, None])
    flat = cut[..., :2] / cut[..., 2:]
    way = flat[:, 1] - flat[:, 0]
    squared = np.einsum("li,li->l", way, way)
    along = np.clip(-np.einsum("li,li->l", flat[:, 0], way) / np.where(squared > 0.0, squared, 1.0), 0.0, 1.0)
    distance = np.linalg.norm(flat[:, 0] + along[:, None] * way, axis=1)
    behind = depth.max(axis=1, initial=-np.inf) <= near
    # In the image plane, inverse depth is linear along a segment.
    inverse = (1.0 - along) / cut[:, 0, 2] + along / cut[:, 1, 2]
    return np.where(behind, np.inf, distance), 1.0 / inverse


def _by_number(values: FloatArray, unit: str, logarithmic: bool = False, from_zero: bool = False) -> LineColours:
    """Colour by number, from the 5th to the 95th percentile."""
    known = values[np.isfinite(values)]
    if not len(known):
        return LineColours(_colours.ramp(values), meaning="Not known.")
    low, high = np.percentile(known, (5, 95))
    low = 0.0 if from_zero else low
    if logarithmic and low > 0:
        share = np.log(np.maximum(values, 1e-300) / low) / max(np.log(high / low), 1e-12)
    else:
        share = (values - low) / max(high - low, 1e-12)
    return LineColours(_colours.ramp(share), f"{low:.3g}{unit}", f"{high:.3g}{unit}")


def _frame(shown: Drawable) -> tuple[Similarity, FloatArray]:
    """Return ``view_from_world``, and the initial viewpoint in the viewer, which looks at its origin."""
    view = starting_view(shown, np.zeros(3))
    away = REACH / OPENING[1]
    scale = away / view.distance
    rotation = np.stack([*horizontal(view.up), view.up])
    turn, rise = view.azimuth, view.elevation
    back = np.array([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)])
    return Similarity(scale, rotation, -scale * (rotation @ view.pivot)), away * back
