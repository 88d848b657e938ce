# SPDX-License-Identifier: BSD-3-Clause
"""Relations between landmarks as differences of pixels: no weight between lengths and pixels has to be chosen.

Every image that sees a landmark adds a factor. What lies on a plane is compared with its foot on the plane; a point on
a line is tied to it through what the images saw of the other: the point keeps to the segments of the line, the line to
the pixels of the point. Points and lines stay uncoupled, so both are still eliminated.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.cameras import model as camera_model
from groma.factors.contract import Factor, Ref
from groma.factors.losses import Loss
from groma.factors.relations.line_direction import LineDirection
from groma.factors.relations.line_to_pixel import LineToPixel
from groma.factors.relations.on_plane_pixels import PointOnPlanePixels, SegmentOnPlanePixels
from groma.factors.relations.point_to_image_line import PointToImageLine
from groma.geometry import segment2
from groma.problem.variables import Variables
from groma.scene import Scene


def structure_pixel_factors(
    scene: Scene,
    sigma_px: tuple[float, float],
    loss: Loss,
    variables: dict[str, Variables],
    camera_refs,
    by_model,
) -> list[Factor]:
    """Return the factors of the relations, for the landmarks that are variables.

    Parameters
    ----------
    scene : Scene
        The scene.
    sigma_px : (float, float)
        Standard deviation of points and of segment end points, pixels.
    loss : Loss
        Robust loss of all factors.
    variables : dict
        The groups that take part.
    camera_refs, by_model : callable
        References to the pose of images, and the observations by camera model: see the assembly of a problem.
    """
    relations, factors = scene.relations, []
    points, lines = scene.point_observations, scene.line_observations
    have = {name: name in variables for name in ("points", "lines", "planes", "directions")}
    if have["points"] and have["planes"]:
        seen, plane = _join(points.point_idx, relations.point_on_plane, scene.num_points)
        for name, rows, camera in by_model(scene, points.image_idx[seen]):
            factors.append(
                PointOnPlanePixels(
                    point=Ref("points", points.point_idx[seen[rows]]),
                    plane=Ref("planes", plane[rows]),
                    camera_model=name,
                    intrinsics=Ref(f"intrinsics/{name}", camera),
                    sqrt_information=1.0 / sigma_px[0],
                    loss=loss,
                    **camera_refs(scene, points.image_idx[seen[rows]]),
                )
            )
    if have["lines"] and have["planes"]:
        seen, plane = _join(lines.line_idx, relations.line_on_plane, scene.num_lines)
        for name, rows, camera in by_model(scene, lines.image_idx[seen]):
            line = lines.line_idx[seen[rows]]
            factors.append(
                SegmentOnPlanePixels(
                    line=Ref("lines", line),
                    plane=Ref("planes", plane[rows]),
                    ends=scene.lines.segments[line],
                    camera_model=name,
                    intrinsics=Ref(f"intrinsics/{name}", camera),
                    sqrt_information=1.0 / sigma_px[1],
                    loss=loss,
                    **camera_refs(scene, lines.image_idx[seen[rows]]),
                )
            )
    if have["points"] and have["lines"] and len(relations.point_on_line):
        factors += wireframe_factors(scene, sigma_px, loss, camera_refs, by_model)
    if have["lines"] and have["directions"] and len(relations.line_along_direction):
        factors.append(_along_directions(scene, sigma_px[1], loss))
    return factors


def wireframe_factors(scene: Scene, sigma_px: tuple[float, float], loss: Loss, camera_refs, by_model) -> list[Factor]:
    """Return the factors of points on lines; parameters as for :func:`structure_pixel_factors`."""
    points, lines, factors = scene.point_observations, scene.line_observations, []
    by_line = scene.relations.point_on_line[:, ::-1]
    seen, point = _join(lines.line_idx, by_line, scene.num_lines)
    image_lines = segment2.to_line(lines.segment[seen])
    for name, rows, camera in by_model(scene, lines.image_idx[seen]):
        factors.append(
            PointToImageLine(
                point=Ref("points", point[rows]),
                image_lines=image_lines[rows],
                camera_model=name,
                intrinsics=Ref(f"intrinsics/{name}", camera),
                sqrt_information=1.0 / sigma_px[1],
                loss=loss,
                **camera_refs(scene, lines.image_idx[seen[rows]]),
            )
        )
    seen, line = _join(points.point_idx, scene.relations.point_on_line, scene.num_points)
    for name, rows, camera in by_model(scene, points.image_idx[seen]):
        if camera_model(name).has_pinhole_parameters:
            factors.append(
                LineToPixel(
                    line=Ref("lines", line[rows]),
                    pixels=points.pixel[seen[rows]],
                    camera_model=name,
                    intrinsics=Ref(f"intrinsics/{name}", camera),
                    sqrt_information=1.0 / sigma_px[0],
                    loss=loss,
                    **camera_refs(scene, points.image_idx[seen[rows]]),
                )
            )
    return factors


def _along_directions(scene: Scene, sigma_px: float, loss: Loss) -> Factor:
    """Lines along directions: the angle that the noise of end points allows for the length seen in the images."""
    line, direction = scene.relations.line_along_direction.T
    table = scene.line_observations
    length = segment2.length(table.segment)
    squares = np.bincount(table.line_idx, weights=length**2, minlength=scene.num_lines)
    # the two ends of n segments of length s fix an angle to sigma sqrt(2 / sum of s^2) in the image
    spread: FloatArray = np.sqrt(np.maximum(squares, 1e-12) / 2.0)
    return LineDirection(
        line=Ref("lines", line),
        direction=Ref("directions", direction),
        sqrt_information=spread[line] / sigma_px,
        loss=loss,
    )


def _join(landmark: IntArray, relation: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Return (observation, partner) for every observation of a landmark and every relation (landmark, partner)."""
    order = np.argsort(landmark, kind="stable")
    first = np.searchsorted(landmark[order], np.arange(count))
    number = np.bincount(landmark, minlength=count)
    of_relation = relation[:, 0] if len(relation) else np.zeros(0, np.int64)
    repeats = number[of_relation]
    owner = np.repeat(np.arange(len(of_relation)), repeats)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    observation = order[first[of_relation[owner]] + within] if len(owner) else np.zeros(0, np.int64)
    return observation, (relation[owner, 1] if len(owner) else np.zeros(0, np.int64))
