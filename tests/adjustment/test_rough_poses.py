# SPDX-License-Identifier: BSD-3-Clause
"""Poses that are known roughly, beside relations between landmarks, which are lengths and would shrink the scene."""

import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.evaluation import evaluate_poses
from groma.scene.measurements import PosePriors
from groma.scene.synthetic import holistic


def _at_poses(sigma):
    """A scene with planes at its true poses, whose centres are known to so many units and rotations to a radian."""
    truth = holistic(8, 3, noise_px=0.5).truth
    poses = truth.frames.rig_from_world
    priors = PosePriors(np.arange(len(poses)), poses, np.tile([sigma] * 3 + [1.0] * 3, (len(poses), 1)))
    return truth, truth.replace(pose_priors=priors)


@pytest.mark.kernels
def test_relations_do_not_shrink_a_scene_of_rough_poses():
    """By a thousandth at most; without the held scale it becomes a twelfth of its size."""
    truth, scene = _at_poses(5.0)
    found = groma.adjust(scene, groma.AdjustOptions(loss="none")).scene
    assert evaluate_poses(found, truth).alignment.scale == pytest.approx(1.0, abs=2e-3)


def test_exact_poses_determine_the_scale_themselves():
    for sigma, count in ((5.0, 1), (1e-4, None)):
        assert assemble(_at_poses(sigma)[1], AssemblyOptions()).num_measurements.get("held scale") == count
