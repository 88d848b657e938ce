# SPDX-License-Identifier: BSD-3-Clause
"""Line against plane normal: both sines from geometry, scale of the line, the anchor at the camera, errors."""

import numpy as np
import pytest

from groma.errors import InputError
from groma.factors.contract import Ref
from groma.factors.observations.line_normal import LineNormal

pytestmark = pytest.mark.kernels


def evaluate(normal, pose, line):
    """Residual (2,), pose block (2, 6), line block (2, 6), number of degenerate factors."""
    zero = np.zeros(1, dtype=int)
    factor = LineNormal(pose=Ref("poses", zero), line=Ref("lines", zero), normals=np.array([normal], dtype=float))
    record = np.full((1, 2, 13), np.nan)
    inputs = factor.prepare((np.array(pose, dtype=float).reshape(1, 12), np.array([line], dtype=float)))
    degenerate = factor.linearize(inputs, 0, 1, (0, 6), record)
    return record[0, :, 12], record[0, :, :6], record[0, :, 6:12], degenerate


def plucker(first, second):
    return np.hstack([np.cross(first, second), np.subtract(second, first)])


def make_pose(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q)), rng.normal(size=3) * 3.0


def test_residual_is_two_sines():
    rng = np.random.default_rng(0)
    for _ in range(20):
        R, t = make_pose(rng)
        first, second = rng.normal(size=(2, 3)) * 2.0
        normal = rng.normal(size=3)
        direction = (second - first) / np.linalg.norm(second - first)
        anchor = first - direction * (first @ direction)
        ray = anchor + R.T @ t  # from the camera centre to the anchor
        unit = R.T @ normal / np.linalg.norm(normal)
        residual, _, _, degenerate = evaluate(normal, np.hstack([R, t[:, None]]), plucker(first, second))
        np.testing.assert_allclose(residual, [unit @ direction, -unit @ ray / np.linalg.norm(ray)], atol=1e-13)
        assert degenerate == 0


def test_perfect_measurement_gives_zero():
    rng = np.random.default_rng(1)
    R, t = make_pose(rng)
    ends = rng.normal(size=(2, 3))
    bearings = ends @ R.T + t
    residual, *_ = evaluate(np.cross(*bearings), np.hstack([R, t[:, None]]), plucker(*ends))
    np.testing.assert_allclose(residual, 0.0, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-5, 40.0, 1e6, -1.0, -2e3])
def test_line_has_no_scale(scale):
    rng = np.random.default_rng(2)
    R, t = make_pose(rng)
    pose, line = np.hstack([R, t[:, None]]), plucker(*rng.normal(size=(2, 3)))
    residual, by_pose, by_line, _ = evaluate([0.1, 0.5, -0.3], pose, line)
    scaled, scaled_by_pose, scaled_by_line, _ = evaluate([0.1, 0.5, -0.3], pose, scale * line)
    signs = np.array([np.sign(scale), 1.0])  # the direction turns round, the anchor stays
    np.testing.assert_allclose(scaled, signs * residual, rtol=1e-12)
    np.testing.assert_allclose(scaled_by_pose, signs[:, None] * by_pose, rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(scaled_by_line * scale, signs[:, None] * by_line, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(by_line @ line, 0.0, atol=1e-13)


def test_anchor_at_the_camera_is_left_out_and_counted():
    # The camera stands at the point of the line closest to the world origin.
    line = plucker([0.0, 2.0, 0.0], [1.0, 2.0, 0.0])
    pose = [1, 0, 0, 0, 0, 1, 0, -2.0, 0, 0, 1, 0]
    residual, by_pose, by_line, degenerate = evaluate([0.0, 1.0, 1.0], pose, line)
    assert degenerate == 1 and not residual.any() and not by_pose.any() and not by_line.any()
    pose[7] = -2.0 + 1e-4
    residual, by_pose, by_line, degenerate = evaluate([0.0, 1.0, 1.0], pose, line)
    assert degenerate == 0
    np.testing.assert_allclose(residual, [0.0, -np.sqrt(0.5)], rtol=1e-9)


def test_line_through_the_camera_beside_its_anchor_stays():
    line = plucker([0.0, 2.0, 0.0], [1.0, 2.0, 0.0])
    pose = [1, 0, 0, -3.0, 0, 1, 0, -2.0, 0, 0, 1, 0]  # centre (3, 2, 0), on the line
    residual, by_pose, _, degenerate = evaluate([0.6, 0.0, 0.8], pose, line)
    assert degenerate == 0 and np.isfinite(by_pose).all()
    np.testing.assert_allclose(residual, [0.6, 0.6], atol=1e-15)


def test_line_at_infinity_is_left_out():
    *_, degenerate = evaluate([0.0, 0.0, 1.0], [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 1], [1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    assert degenerate == 1


def test_line_through_the_world_origin_has_all_derivatives():
    """There the anchor moves in two directions: the column by which the orthonormal chart loses rank is present."""
    pose = [1, 0, 0, 0.5, 0, 1, 0, -0.4, 0, 0, 1, 5.0]
    _, _, by_line, degenerate = evaluate([0.3, 0.9, 0.2], pose, plucker([0.0, 0.0, 0.0], [1.0, 0.2, 0.1]))
    assert degenerate == 0
    assert np.linalg.matrix_rank(by_line[:, :3]) == 1 and np.linalg.matrix_rank(by_line) == 2


def test_normals_of_any_length_but_zero():
    rng = np.random.default_rng(4)
    pose, line = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 5.0], plucker(*rng.normal(size=(2, 3)))
    first, second = evaluate([1.0, 2.0, 2.0], pose, line), evaluate([100.0, 200.0, 200.0], pose, line)
    np.testing.assert_allclose(first[0], second[0], rtol=1e-14)
    with pytest.raises(InputError, match="must not be zero"):
        evaluate([0.0, 0.0, 0.0], pose, line)
