# SPDX-License-Identifier: BSD-3-Clause
"""Cameras in rigs: every camera factor with extrinsics has the residual of the composed pose and right derivatives."""

import dataclasses

import numpy as np
import pytest

from groma.errors import ShapeError
from groma.factors._examples import random_poses
from groma.factors.checks.check import check_factor
from groma.factors.contract import Example, Ref
from groma.factors.observations.line_bearing import LineBearing
from groma.factors.observations.line_normal import LineNormal
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.plane_observation import PlaneObservation
from groma.factors.observations.plane_quaternion import PlaneQuaternion
from groma.factors.observations.point_depth import PointDepth
from groma.factors.observations.point_reprojection import PointReprojection
from groma.factors.observations.stereo_line import StereoLine
from groma.factors.observations.stereo_point import StereoPoint
from groma.geometry import se3
from groma.geometry.charts.pose_charts import POSE_CHARTS

pytestmark = pytest.mark.kernels

CAMERA_FACTORS = [
    LineBearing,
    LineNormal,
    LineReprojection,
    PlaneObservation,
    PlaneQuaternion,
    PointDepth,
    PointReprojection,
    StereoLine,
    StereoPoint,
]


def with_rig(example: Example, rng: np.random.Generator) -> tuple[Example, Example]:
    """Mount the cameras of an example on bodies: two sensors, as many bodies as needed; and the same without a rig."""
    factor = example.factor
    _, poses = example.variables["poses"]
    sensor = rng.integers(0, 2, len(factor))
    sensors = random_poses(rng, 2, rotation=1.5)
    # one camera pose for each body and sensor; bodies so that sensor 0 is where the example's cameras are
    bodies = se3.compose(se3.inverse(sensors[:1]), poses)
    sensors[1] = se3.compose(random_poses(rng, 1, rotation=0.05) * [1, 1, 1, 1, 0.1, 0.1, 0.1], sensors[:1])[0]
    cameras = se3.compose(sensors[:, None], bodies[None]).reshape(-1, 7)
    rigged = dataclasses.replace(factor, extrinsics=Ref("sensors", sensor))
    plain = dataclasses.replace(factor, pose=Ref("poses", sensor * len(poses) + factor.pose.index))
    chart, sensor_chart = example.variables["poses"][0], POSE_CHARTS["left"]
    return (
        Example(rigged, {**example.variables, "poses": (chart, bodies), "sensors": (sensor_chart, sensors)}),
        Example(plain, {**example.variables, "poses": (chart, cameras)}),
    )


def residuals(example: Example) -> np.ndarray:
    ambients = {name: manifold.ambient(state) for name, (manifold, state) in example.variables.items()}
    factor = example.factor
    out = np.full((len(factor), factor.residual_size), np.nan)
    inputs = factor.prepare(tuple(ambients[ref.group] for _, ref in factor.references()))
    assert factor.residuals(inputs, 0, len(factor), out) == 0
    return out


@pytest.mark.parametrize("cls", CAMERA_FACTORS)
def test_factor_in_a_rig(cls):
    rng = np.random.default_rng(0)
    rigged, plain = with_rig(cls.example(rng), rng)
    expected = residuals(plain)
    np.testing.assert_allclose(residuals(rigged), expected, atol=1e-11 * max(1.0, np.abs(expected).max()))
    worst = check_factor(rigged).worst
    assert "extrinsics" in worst and "pose" in worst


def test_poses_are_composed_once_per_pair():
    rng = np.random.default_rng(1)
    count = 200
    body, sensor = rng.integers(0, 5, count), rng.integers(0, 3, count)
    factor = PointDepth(
        pose=Ref("bodies", body),
        point=Ref("points", np.zeros(count, int)),
        extrinsics=Ref("sensors", sensor),
        depths=np.zeros(count),
    )
    bodies, sensors = random_poses(rng, 5, 2.0), random_poses(rng, 3, 2.0)
    to_ambient = POSE_CHARTS["left"].ambient
    inputs = factor.prepare((to_ambient(bodies), np.zeros((1, 3)), to_ambient(sensors)))
    assert inputs[1].shape == (15, 12)
    expected = se3.to_matrix(se3.compose(sensors[sensor], bodies[body]))[:, :3].reshape(-1, 12)
    np.testing.assert_allclose(inputs[1][inputs[2]], expected, atol=1e-13)


def test_no_factors_in_a_rig():
    none = np.zeros(0, int)
    factor = PointDepth(
        pose=Ref("bodies", none), point=Ref("points", none), extrinsics=Ref("sensors", none), depths=np.zeros(0)
    )
    inputs = factor.prepare((np.zeros((0, 12)), np.zeros((0, 3)), np.zeros((0, 12))))
    assert factor.linearize(inputs, 0, 0, (0, 6, 9), np.zeros((0, 1, 16))) == 0


def test_extrinsics_must_fit():
    with pytest.raises(ShapeError, match="extrinsics must have one index per factor, 2 like its pose; got 1"):
        PointDepth(
            pose=Ref("bodies", [0, 0]), point=Ref("points", [0, 0]), extrinsics=Ref("sensors", [0]), depths=np.zeros(2)
        )
