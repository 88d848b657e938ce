# SPDX-License-Identifier: BSD-3-Clause
"""The problem of one pose and its matches: without a scene, whose tables and checks take longer than the factors,
unless lens or lines ask for one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.factors.contract import Ref
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry import line3
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.matches import Matches
from groma.localization.pose.one_pose import OnePose, Part
from groma.scene import LineObservations, Lines, PointObservations, Points, Scene

_ASSEMBLY = AssemblyOptions(
    point_chart="euclidean", drop_behind=False, require_in_front=True, gauge="free", refine_landmarks=False
)


def problem_of(camera: QueryCamera, matches: Matches, pose: FloatArray, refine_lens: bool = False) -> OnePose:
    """The problem of one pose, with the noise of the image alone."""
    if matches.num_lines and not camera.kind.has_pinhole_parameters:
        return OnePose(assembled(camera, matches, pose, refine_lens), pose, camera.params)
    parts = []
    for kind, count in (("points", matches.num_points), ("lines", matches.num_lines)):
        if not count:
            continue
        row, zeros = np.arange(count), np.zeros(count, np.int64)
        landmark, held = Ref(kind, row), {"pose": Ref("frames", zeros), "intrinsics": Ref("intrinsics", zeros)}
        if kind == "points":
            factor = PointReprojection(
                point=landmark, pixels=matches.points2d, sqrt_information=1.0 / matches.point_sigma,
                camera_model=camera.kind, **held,
            )  # fmt: skip
            parts.append(Part(factor, kind, row, matches.points3d))
        else:
            factor = LineReprojection(
                line=landmark, segments=matches.segments2d.reshape(-1, 4), sqrt_information=1.0 / matches.segment_sigma,
                camera_model=camera.kind, **held,
            )  # fmt: skip
            lines = line3.from_points(*matches.segments3d.swapaxes(0, 1))
            parts.append(Part(factor, kind, row, lines / np.linalg.norm(lines[:, 3:], axis=1, keepdims=True)))
    return OnePose(tuple(parts), pose, camera.params)


def assembled(camera: QueryCamera, matches: Matches, pose: FloatArray, refine_lens: bool) -> tuple[Part, ...]:
    """The parts of the same problem as they are made of a scene."""
    image = np.zeros(matches.num_points, np.int64), np.zeros(matches.num_lines, np.int64)
    scene = Scene.from_images(
        camera.table(), ["query"], [0], pose[None],
        points=Points.at(matches.points3d),
        point_observations=PointObservations.numbered(
            image[0], np.arange(matches.num_points), matches.points2d, matches.point_sigma
        ),
        lines=Lines.through(matches.segments3d),
        line_observations=LineObservations(
            image[1], np.arange(matches.num_lines), matches.segments2d.reshape(-1, 4), matches.segment_sigma
        ),
    )  # fmt: skip
    problem = assemble(scene, replace(_ASSEMBLY, refine_intrinsics=refine_lens)).problem
    parts = []
    for factor in problem.factors:
        landmark = factor.references()[1][1]
        places = np.ascontiguousarray(problem.variables[landmark.group].ambient())
        parts.append(Part(factor, landmark.group, landmark.index, places))
    return tuple(parts)
