# SPDX-License-Identifier: BSD-3-Clause
"""The default losses follow the noise: as good as least squares without outliers, and untouched by outliers."""

from dataclasses import replace

import numpy as np
import pytest

import groma
from groma.adjustment.adjust import _wide_enough
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.stages import STAGES, with_loss
from groma.errors import InputError
from groma.evaluation import evaluate_poses
from groma.factors.losses import Cauchy, GemanMcClure, Trivial
from groma.scene import Relations, synthetic

pytestmark = pytest.mark.kernels


def _scene(noise_px):
    scene = synthetic.holistic(20, noise_px=noise_px, seed=2)
    return scene.truth.replace(relations=Relations()), scene.start.replace(relations=Relations())


def test_last_scale_follows_the_noise():
    truth, _ = _scene(1.5)
    assembly = assemble(truth, AssemblyOptions(planes=False))
    wide = _wide_enough(GemanMcClure(2.0), assembly)
    assert wide.scale == pytest.approx(STAGES.last_scale * 1.5, rel=0.1)
    assert _wide_enough(GemanMcClure(100.0), assembly).scale == 100.0
    for other in (Trivial(), Cauchy(1.0)):
        assert _wide_enough(other, assembly) is other


def test_segments_have_a_scale_of_their_own():
    truth, _ = _scene(1.5)
    assembly = assemble(truth, AssemblyOptions(planes=False, loss=Cauchy(4.0), line_loss_factor=0.25))
    again = with_loss(assemble(truth, AssemblyOptions(planes=False)).problem, Cauchy(4.0), line_loss_factor=0.25)
    for factors in (assembly.problem.factors, again.factors):
        kinds = {"lines" if factor.type_name.startswith("line_") else "points": factor.loss for factor in factors}
        assert kinds == {"points": Cauchy(4.0), "lines": Cauchy(1.0)}
    with pytest.raises(InputError, match="line_loss_factor must be a positive number"):
        groma.AdjustOptions(line_loss_factor=0.0)


@pytest.mark.compiled
def test_a_narrow_loss_of_segments_leaves_wrong_ones_out():
    """Every tenth segment is off by 3 pixels: lines among exact cameras are nearer with the loss bent at one sigma."""
    truth, start = _scene(0.5)
    start = start.with_poses(truth.cam_from_world)
    table = start.line_observations
    segment = table.segment.copy()
    segment[::10] += 3.0
    spoiled = start.replace(line_observations=table.replace(segment=segment))
    usual = groma.AdjustOptions(
        loss="cauchy", loss_scale=8.0, points=False, planes=False, refine_poses=False, line_sigma_px=0.5
    )
    errors = []
    for factor in (1.0, 0.125):
        found = groma.adjust(spoiled, replace(usual, line_loss_factor=factor)).scene.lines.plucker
        errors.append(np.median(np.linalg.norm(np.cross(found[:, 3:], truth.lines.plucker[:, 3:]), axis=1)))
    assert errors[1] < errors[0]


@pytest.mark.compiled
def test_without_outliers_the_default_is_as_good_as_least_squares():
    truth, start = _scene(1.5)
    errors = [
        evaluate_poses(groma.adjust(start, groma.AdjustOptions(loss=loss, planes=False)).scene, truth).center_rmse
        for loss in ("auto", "none")
    ]
    assert errors[0] < 1.03 * errors[1]


@pytest.mark.compiled
def test_with_outliers_it_is_far_better():
    truth, start = _scene(0.5)
    table = start.point_observations
    pixel = table.pixel.copy()
    rows = np.arange(0, len(pixel), 20)
    pixel[rows] += np.random.default_rng(0).uniform(20.0, 60.0, (len(rows), 2))
    spoiled = start.replace(point_observations=table.replace(pixel=pixel))
    robust, plain = (
        evaluate_poses(groma.adjust(spoiled, groma.AdjustOptions(loss=loss, planes=False)).scene, truth).center_rmse
        for loss in ("auto", "none")
    )
    assert robust < 0.2 * plain
