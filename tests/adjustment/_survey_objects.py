# SPDX-License-Identifier: BSD-3-Clause
"""A made scene with control points, and what measurements of its objects are checked by."""

import numpy as np
from _survey import control

from groma.adjustment.adjust import AdjustOptions
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.geometry import quaternion
from groma.io.survey import DirectionsFile
from groma.problem.residuals import residuals_of
from groma.scene.synthetic.scenes import holistic

LEAST_SQUARES = AdjustOptions(loss="none", point_sigma_px=0.5, check_lens=False)
#: Down in the world.
DOWN = np.array([0.0, 0.0, -1.0])


def with_control():
    """A scene with points, lines and planes, and four control points."""
    scene = holistic(8, noise_px=0.5, seed=1).truth
    points, marks, xyz = control(scene, np.random.default_rng(2), 4, 0)
    return scene.replace(control_points=points.replace(xyz=xyz, role=np.zeros(4, int)), marks=marks)


def residuals(scene, kind):
    """Residuals of the factors of one type at a scene."""
    problem = assemble(scene, AssemblyOptions()).problem
    return np.concatenate([residuals_of(f, problem.variables) for f in problem.factors if f.type_name == kind])


def gravity_file(scene, rng, sigma_deg=0.5, world=DOWN):
    """Where down is in the cameras of a scene whose world has it at ``world``."""
    turn = scene.cam_from_world[:, :4]
    seen = quaternion.rotate(turn, np.tile(world, (len(turn), 1)))
    seen = quaternion.rotate(quaternion.exp(rng.normal(size=(len(turn), 3)) * np.radians(sigma_deg)), seen)
    count = len(seen)
    return DirectionsFile(scene.images.names, seen, np.tile(DOWN, (count, 1)), np.full(count, sigma_deg), "imu.txt")
