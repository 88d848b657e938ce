# SPDX-License-Identifier: BSD-3-Clause
"""The problem of one image before landmarks that are held, as :mod:`groma.adjustment.assemble` makes it of a scene.

Localising a photograph takes several of them, and the tables of a scene, with their checks, take longer than
the factors.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.cameras import CameraModel
from groma.factors.contract import Factor, Ref
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.problem import Problem
from groma.problem.variables import Variables


def one_image_problem(
    camera: tuple[CameraModel, FloatArray],
    pose: FloatArray,
    points: tuple[FloatArray, FloatArray, FloatArray],
    lines: tuple[FloatArray, FloatArray, FloatArray],
) -> Problem:
    """Return the problem of one pose.

    Parameters
    ----------
    camera
        Model and parameters (k,), which are held. Lines ask for a model without distortion.
    pose : (7,)
        cam_from_world.
    points
        Pixels (N, 2), places in the world (N, 3), standard deviations (N,) in pixels; each of a point of its own.
    lines
        Segments (M, 4) in pixels, Plücker lines (M, 6), standard deviations (M,) of their ends in pixels.
    """
    model, params = camera
    variables = {"frames": Variables(POSE_CHARTS["left"], pose[None])}
    factors: list[Factor] = []
    intrinsics = f"intrinsics/{model.name}"
    if len(points[0]) or len(lines[0]):
        variables[intrinsics] = Variables(Euclidean(model.num_parameters, "intrinsics"), params[None], True)
    for group, (seen, place, sigma) in (("points", points), ("lines", lines)):
        if not len(seen):
            continue
        zeros = np.zeros(len(seen), np.int64)
        common = {
            "camera_model": model, "pose": Ref("frames", zeros), "intrinsics": Ref(intrinsics, zeros),
            "sqrt_information": 1.0 / sigma,
        }  # fmt: skip
        own = Ref(group, np.arange(len(seen)))
        if group == "points":
            variables[group] = Variables(Euclidean(3, "point"), place, True)
            factors.append(PointReprojection(point=own, pixels=seen, **common))
        else:
            chart = LINE_CHARTS["cartesian"]
            variables[group] = Variables(chart, chart.from_ambient(place), True)
            factors.append(LineReprojection(line=own, segments=seen, **common))
    return Problem(variables, factors)
