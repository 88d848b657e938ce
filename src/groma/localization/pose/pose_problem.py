# SPDX-License-Identifier: BSD-3-Clause
"""The problem of one pose and its matches: without a scene, unless lens or lines ask for one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.one_image import one_image_problem
from groma.geometry import line3
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.matches import Matches
from groma.localization.pose.one_pose import OnePose
from groma.scene import LineObservations, Lines, PointObservations, Points, Scene

_ASSEMBLY = AssemblyOptions(
    point_chart="euclidean", drop_behind=False, require_in_front=True, gauge="free", refine_landmarks=False
)


def problem_of(camera: QueryCamera, matches: Matches, pose: FloatArray, refine_lens: bool = False) -> OnePose:
    """The problem of one pose, with the noise of the image alone."""
    if camera.kind.has_pinhole_parameters or not matches.num_lines:
        lines = line3.from_points(*matches.segments3d.swapaxes(0, 1))
        lines /= np.linalg.norm(lines[:, 3:], axis=1, keepdims=True)
        problem = one_image_problem(
            (camera.kind, camera.params), pose, (matches.points2d, matches.points3d, matches.point_sigma),
            (matches.segments2d.reshape(-1, 4), lines, matches.segment_sigma),
        )  # fmt: skip
        return OnePose.of(problem, camera.params)
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
    return OnePose.of(assemble(scene, replace(_ASSEMBLY, refine_intrinsics=refine_lens)).problem, camera.params)
