# SPDX-License-Identifier: BSD-3-Clause
"""The problem of one pose and its matches: without a scene, unless lines under distortion ask for one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.one_image import one_image_factors
from groma.factors.contract import Factor
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
    factors = one_image_factors(
        camera.kind, (matches.points2d, matches.point_sigma),
        (matches.segments2d.reshape(-1, 4), matches.segment_sigma),
    )  # fmt: skip
    lines = line3.from_points(*matches.segments3d.swapaxes(0, 1))
    places = {"points": matches.points3d, "lines": lines / np.linalg.norm(lines[:, 3:], axis=1, keepdims=True)}
    return OnePose(_parts(factors, places), pose, camera.params)


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
    places = {name: np.ascontiguousarray(group.ambient()) for name, group in problem.variables.items()}
    return _parts(problem.factors, places)


def _parts(factors: Sequence[Factor], places: Mapping[str, FloatArray]) -> tuple[Part, ...]:
    landmarks = [factor.references()[1][1] for factor in factors]
    made = zip(factors, landmarks, strict=True)
    return tuple(Part(factor, own.group, own.index, places[own.group]) for factor, own in made)
