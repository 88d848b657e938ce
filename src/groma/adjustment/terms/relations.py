# SPDX-License-Identifier: BSD-3-Clause
"""Relations between landmarks as factors: what lies on what, and what runs along what."""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.cameras import model as camera_model
from groma.factors.contract import Factor, Ref
from groma.factors.losses import Loss
from groma.factors.relations.line_direction import LineDirection
from groma.factors.relations.line_on_plane import SegmentOnPlane
from groma.factors.relations.point_on_line import PointOnLine
from groma.factors.relations.point_on_plane import PointOnPlane
from groma.problem.variables import Variables
from groma.scene import Scene

#: How well landmarks keep to what they lie on, as a length in the images, pixels: walls are not flat.
SURFACE_SIGMA_PX = 0.2
#: Types of the factors of relations, and the relation of the scene each stands for.
RELATION_FACTORS = {
    "point_on_plane": "point_on_plane",
    "segment_on_plane": "line_on_plane",
    "line_direction": "line_along_direction",
    "point_on_line": "point_on_line",
}
#: Points on lines tie points to lines, and only one of the two can be eliminated. With more lines than this they are
#: measured in pixels instead, which leaves points and lines uncoupled. The solver keeps no more of its own accord.
MAX_COUPLED_LINES = 4000


def lengths_per_pixel(scene: Scene, kind: str) -> FloatArray:
    r"""Return the length that a pixel spans at the distance of each landmark, the mean over its images, scene units.

    .. math:: \frac{1}{n} \sum_i |X - C_i| / f_i

    Landmarks that no image sees get the median over all observations.

    Parameters
    ----------
    scene : Scene
        Cameras and landmarks.
    kind : "point" or "line"
        Of which landmarks; lines count at the middle of their segments.

    Returns
    -------
    (P,) or (L,) float64
    """
    if kind == "point":
        image_idx, index, places = (
            scene.point_observations.image_idx, scene.point_observations.point_idx, scene.points.xyz,
        )  # fmt: skip
    else:
        image_idx, index, places = (
            scene.line_observations.image_idx, scene.line_observations.line_idx, scene.lines.segments.mean(axis=1),
        )  # fmt: skip
    focal_of = np.array(
        [
            scene.cameras.params_of(c)[list(camera_model(name).focal_indices)].mean()
            for c, name in enumerate(scene.cameras.models)
        ]
    )
    away = scene.cam_centers_in_world.take(image_idx, axis=0) - places.take(index, axis=0)
    length = np.sqrt(np.einsum("ni,ni->n", away, away)) / focal_of[scene.images.camera_idx][image_idx]
    count = np.bincount(index, minlength=len(places))
    mean = np.bincount(index, weights=length, minlength=len(places)) / np.maximum(count, 1)
    fallback = float(np.median(length)) if len(length) else 1.0
    return np.where(count > 0, mean, fallback)


def structure_factors(scene: Scene, sigma_px: float, loss: Loss, variables: dict[str, Variables]) -> list[Factor]:
    """Return the factors of the relations, for the landmarks that are variables.

    ``sigma_px`` says how well landmarks keep to what they lie on, as a length in the images.
    """
    relations = scene.relations
    factors: list[Factor] = []
    have = {name: name in variables for name in ("points", "lines", "planes", "directions")}
    if have["points"] and (len(relations.point_on_plane) or len(relations.point_on_line)):
        per_point = 1.0 / (sigma_px * lengths_per_pixel(scene, "point"))
        if have["planes"] and len(relations.point_on_plane):
            point, plane = relations.point_on_plane.T
            factors.append(
                PointOnPlane(
                    point=Ref("points", point),
                    plane=Ref("planes", plane),
                    sqrt_information=per_point[point],
                    loss=loss,
                )
            )
        if have["lines"] and len(relations.point_on_line) and scene.num_lines <= MAX_COUPLED_LINES:
            point, line = relations.point_on_line.T
            factors.append(
                PointOnLine(
                    point=Ref("points", point),
                    line=Ref("lines", line),
                    sqrt_information=per_point[point],
                    loss=loss,
                )
            )
    if have["lines"] and (len(relations.line_on_plane) or len(relations.line_along_direction)):
        per_line = 1.0 / (sigma_px * lengths_per_pixel(scene, "line"))
        ends = scene.lines.segments
        if have["planes"] and len(relations.line_on_plane):
            line, plane = relations.line_on_plane.T
            factors.append(
                SegmentOnPlane(
                    line=Ref("lines", line),
                    plane=Ref("planes", plane),
                    ends=ends[line],
                    sqrt_information=per_line[line],
                    loss=loss,
                )
            )
        if have["directions"] and len(relations.line_along_direction):
            line, direction = relations.line_along_direction.T
            length = np.linalg.norm(ends[line, 1] - ends[line, 0], axis=1)
            factors.append(
                LineDirection(
                    line=Ref("lines", line),
                    direction=Ref("directions", direction),
                    sqrt_information=per_line[line] * np.maximum(0.5 * length, 1e-12),
                    loss=loss,
                )
            )
    return factors
