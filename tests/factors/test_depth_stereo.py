# SPDX-License-Identifier: BSD-3-Clause
"""Depths, and rectified stereo: equal to the factors of two single cameras; degeneracies and errors."""

import dataclasses

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.factors.contract import Ref
from groma.factors.observations.line_reprojection import LineReprojection
from groma.factors.observations.point_depth import PointDepth
from groma.factors.observations.point_reprojection import PointReprojection
from groma.factors.observations.stereo_line import StereoLine
from groma.factors.observations.stereo_point import StereoPoint

pytestmark = pytest.mark.kernels

IDENTITY = np.array([[1.0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]])
K = np.array([[500.0, 480.0, 320.0, 240.0]])


def evaluate(factor, ambients, sizes):
    """Blocks and residual side by side (N, m, width), number of degenerate factors."""
    columns = tuple(int(c) for c in np.cumsum([0, *sizes[:-1]]))
    record = np.full((len(factor), factor.residual_size, sum(sizes) + 1), np.nan)
    return record, factor.linearize(factor.prepare(ambients), 0, len(factor), columns, record)


def of_example(cls, seed):
    """An example, its ambient arrays, and the same with the cameras moved to the right by the baseline (0.5)."""
    example = cls.example(np.random.default_rng(seed))
    factor = dataclasses.replace(example.factor, baseline=0.5)
    ambients = [manifold.ambient(state) for manifold, state in example.variables.values()]
    right = [ambient.copy() for ambient in ambients]
    right[0][:, 3] -= 0.5
    return factor, tuple(ambients), tuple(right)


def test_depth_is_the_coordinate_along_the_axis():
    zero = np.zeros(1, int)
    factor = PointDepth(pose=Ref("poses", zero), point=Ref("points", zero), depths=np.array([4.0]))
    pose = np.array([[0.0, 0, 1, 0.1, 0, 1, 0, 0.2, -1, 0, 0, 0.3]])
    record, degenerate = evaluate(factor, (pose, np.array([[-5.0, 7.0, 9.0]])), (6, 3))
    np.testing.assert_allclose(record[0, 0], [0, 0, 1, 7.2, -9.1, 0, -1, 0, 0, 1.3], atol=1e-14)
    assert degenerate == 0
    record, degenerate = evaluate(factor, (pose, np.array([[np.nan, 7.0, 9.0]])), (6, 3))
    assert degenerate == 1 and not record.any()


def test_stereo_point_is_two_cameras():
    factor, left, right = of_example(StereoPoint, 0)
    sizes = (6, 3, 4)
    record, degenerate = evaluate(factor, left, sizes)
    assert degenerate == 0
    refs = {"pose": factor.pose, "point": factor.point, "intrinsics": factor.intrinsics}
    first, _ = evaluate(PointReprojection(**refs, camera_model="PINHOLE", pixels=factor.pixels[:, :2]), left, sizes)
    second, _ = evaluate(
        PointReprojection(**refs, camera_model="PINHOLE", pixels=factor.pixels[:, [2, 1]]), right, sizes
    )
    np.testing.assert_allclose(record[:, :2], first, atol=1e-10)
    np.testing.assert_allclose(record[:, 2, 6:], second[:, 0, 6:], atol=1e-10)
    # The pose of the left camera moves the right one by the adjoint of the step between them, [t]x in its lower part.
    lever = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5], [0.0, -0.5, 0.0]])
    np.testing.assert_allclose(record[:, 2, :3], second[:, 0, :3], atol=1e-10)
    np.testing.assert_allclose(record[:, 2, 3:6], second[:, 0, 3:6] + second[:, 0, :3] @ lever, atol=1e-10)


def test_stereo_line_is_two_cameras():
    factor, left, right = of_example(StereoLine, 1)
    sizes = (6, 6, 4)
    record, degenerate = evaluate(factor, left, sizes)
    assert degenerate == 0
    refs = {"pose": factor.pose, "line": factor.line, "intrinsics": factor.intrinsics}
    first, _ = evaluate(LineReprojection(**refs, camera_model="PINHOLE", segments=factor.segments[:, :4]), left, sizes)
    second, _ = evaluate(
        LineReprojection(**refs, camera_model="PINHOLE", segments=factor.segments[:, 4:]), right, sizes
    )
    np.testing.assert_allclose(record[:, :2], first, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(record[:, 2:, 6:], second[:, :, 6:], rtol=1e-9, atol=1e-9)


def test_perfect_stereo_measurements_give_zero():
    ends = np.array([[0.3, -0.2, 4.0], [-0.5, 0.4, 6.0]])
    left = K[0, :2] * ends[:, :2] / ends[:, 2:] + K[0, 2:]
    right = K[0, :2] * (ends[:, :2] - [0.4, 0.0]) / ends[:, 2:] + K[0, 2:]
    zero = np.zeros(2, int)
    point = StereoPoint(
        pose=Ref("poses", zero),
        point=Ref("points", [0, 1]),
        intrinsics=Ref("intrinsics", zero),
        camera_model="PINHOLE",
        pixels=np.column_stack([left, right[:, 0]]),
        baseline=0.4,
    )
    record, _ = evaluate(point, (IDENTITY, ends, K), (6, 3, 4))
    np.testing.assert_allclose(record[:, :, -1], 0.0, atol=1e-11)
    line = StereoLine(
        pose=Ref("poses", zero[:1]),
        line=Ref("lines", zero[:1]),
        intrinsics=Ref("intrinsics", zero[:1]),
        camera_model="PINHOLE",
        segments=np.hstack([left.ravel(), right.ravel()])[None],
        baseline=np.array([0.4]),
    )
    plucker = np.hstack([np.cross(*ends), ends[1] - ends[0]])[None]
    record, _ = evaluate(line, (IDENTITY, plucker, K), (6, 6, 4))
    np.testing.assert_allclose(record[:, :, -1], 0.0, atol=1e-10)
    scaled, _ = evaluate(line, (IDENTITY, -3.0 * plucker, K), (6, 6, 4))
    np.testing.assert_allclose(scaled[:, :, :6], -record[:, :, :6], rtol=1e-10, atol=1e-9)


def stereo_line():
    zero = np.zeros(1, int)
    return StereoLine(
        pose=Ref("poses", zero),
        line=Ref("lines", zero),
        intrinsics=Ref("intrinsics", zero),
        camera_model="PINHOLE",
        segments=np.arange(8.0)[None],
        baseline=0.5,
    )


@pytest.mark.parametrize("center", [[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])
def test_stereo_line_through_either_centre_is_left_out(center):
    line = np.hstack([np.cross(center, [0.2, 0.3, 1.0]), [0.2, 0.3, 1.0]])[None]
    record, degenerate = evaluate(stereo_line(), (IDENTITY, line, K), (6, 6, 4))
    assert degenerate == 1 and not record.any()


def test_stereo_point_behind_the_pair_is_left_out():
    zero = np.zeros(1, int)
    factor = StereoPoint(
        pose=Ref("poses", zero),
        point=Ref("points", zero),
        intrinsics=Ref("intrinsics", zero),
        camera_model="PINHOLE",
        pixels=np.zeros((1, 3)),
        baseline=0.5,
    )
    for depth in (-3.0, 0.0, np.nan):
        record, degenerate = evaluate(factor, (IDENTITY, np.array([[0.1, 0.2, depth]]), K), (6, 3, 4))
        assert degenerate == 1 and not record.any()


def test_errors_say_what_to_do():
    with pytest.raises(InputError, match="Swap left and right"):
        dataclasses.replace(stereo_line(), baseline=-0.5)
    with pytest.raises(ShapeError, match=r"number or \(1,\)"):
        dataclasses.replace(stereo_line(), baseline=np.ones(3))
    with pytest.raises(InputError, match="without distortion"):
        dataclasses.replace(stereo_line(), camera_model="OPENCV")
