# SPDX-License-Identifier: BSD-3-Clause
"""Rolling shutter: residuals are those at the pose of the row, with right derivatives, alone and in a rig."""

import dataclasses

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.factors._examples import random_poses
from groma.factors.checks.check import check_factor
from groma.factors.contract import Example, Ref
from groma.factors.observations.line_bearing import LineBearing
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.point_depth import PointDepth
from groma.factors.observations.point_reprojection import PointReprojection
from groma.geometry import quaternion, se3
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean

pytestmark = pytest.mark.kernels


def moving(example, rng, rows, on_rig):
    """The factors of an example seen by cameras that move, and the same for each row by a camera of its own at rest."""
    factor, (chart, poses) = example.factor, example.variables["poses"]
    count = len(factor)
    motions, which = 0.3 * rng.normal(size=(2, 6)), rng.integers(0, 2, count)
    offsets = rng.uniform(-0.5, 0.5, (count, rows))
    variables = {**example.variables, "motions": (Euclidean(6), motions)}
    rolling = {"motion": Ref("motions", which), "offsets": offsets}
    if on_rig:
        sensors = random_poses(rng, 1, rotation=1.5)
        variables["poses"] = (chart, se3.compose(se3.inverse(sensors), poses))
        variables["sensors"] = (POSE_CHARTS["left"], sensors)
        rolling["extrinsics"] = Ref("sensors", np.zeros(count, int))
    still = []
    for row in range(rows):
        s = offsets[:, row, None]
        turn = quaternion.exp(-s * motions[which, 3:])
        of_row = np.hstack([turn, -quaternion.rotate(turn, s * motions[which, :3])])
        at_row = se3.compose(of_row, poses[factor.pose.index])
        plain = dataclasses.replace(factor, pose=Ref("poses", np.arange(count)))
        still.append(Example(plain, {**example.variables, "poses": (chart, at_row)}))
    return Example(dataclasses.replace(factor, **rolling), variables), still


def residuals(example):
    ambients = {name: manifold.ambient(state) for name, (manifold, state) in example.variables.items()}
    factor = example.factor
    out = np.full((len(factor), factor.residual_size), np.nan)
    inputs = factor.prepare(tuple(ambients[ref.group] for _, ref in factor.references()))
    assert factor.residuals(inputs, 0, len(factor), out) == 0
    return out


@pytest.mark.parametrize("on_rig", [False, True])
@pytest.mark.parametrize(
    ("cls", "rows"), [(PointReprojection, 1), (LineReprojection, 2), (LineBearing, 2), (LineBearing, 1)]
)
def test_factor_with_a_rolling_shutter(cls, rows, on_rig):
    rng = np.random.default_rng(3)
    rolling, still = moving(cls.example(rng), rng, rows, on_rig)
    each = [residuals(example) for example in still]
    expected = each[0] if rows == 1 else np.column_stack([each[0][:, 0], each[1][:, 1]])
    np.testing.assert_allclose(residuals(rolling), expected, atol=1e-11 * max(1.0, np.abs(expected).max()))
    assert not np.allclose(
        each[0], residuals(dataclasses.replace(rolling, factor=cls.example(np.random.default_rng(3)).factor))
    )
    worst = check_factor(rolling).worst
    assert {"pose", "motion"} | ({"extrinsics"} if on_rig else set()) <= set(worst)


def test_what_does_not_fit_is_refused():
    factor = PointReprojection.example(np.random.default_rng(0)).factor
    motion = Ref("motions", np.zeros(len(factor), int))
    with pytest.raises(ShapeError, match=r"offsets must have shape \(6, 1\) or \(6, 2\), .* got \(6, 3\)"):
        dataclasses.replace(factor, motion=motion, offsets=np.zeros((6, 3)))
    depth = PointDepth.example(np.random.default_rng(0)).factor
    with pytest.raises(InputError, match="PointDepth knows no rolling shutter"):
        dataclasses.replace(depth, motion=motion, offsets=np.zeros((6, 1)))
