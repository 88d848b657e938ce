# SPDX-License-Identifier: BSD-3-Clause
"""Lines from segments and depth: on a surface, in a crease, at the edge of what hides something; covariance against
many noise draws; holes, mixed pixels at the edge, segments that cannot be fitted.
"""

import numpy as np
import pytest
from _depth_scenes import FLOOR, PINHOLE, SHAPE, WALL, noisy, plane, render

from groma.errors import InputError, ShapeError
from groma.features.depth.lines import CREASE, LEFT, NONE, RIGHT, SURFACE, DepthLineGates, fit_depth_lines
from groma.features.depth.noise import DepthNoise

pytestmark = pytest.mark.kernels
#: Nothing in common between pixels, so that errors are those of white noise.
NOISE = DepthNoise(tilt=0.0, shift=0.0)
SLOPED = plane([0.5, 0.2, -1.0], 1.5)


def on_plane(pixels, surface):
    """Points of a plane seen at pixels (..., 2)."""
    directions = np.concatenate([(pixels - PINHOLE[2:]) / PINHOLE[:2], np.ones((*pixels.shape[:-1], 1))], -1)
    return directions * (-surface[3] / (directions @ surface[:3]))[..., None]


def crease():
    """The image of the line in which floor and wall meet, as a segment."""
    across = WALL[:3] / WALL[3] - FLOOR[:3] / FLOOR[3]
    u = np.array([30.0, 130.0])
    x = (u - PINHOLE[2]) / PINHOLE[0]
    y = -(across[0] * x + across[2]) / across[1]
    return np.column_stack([u, PINHOLE[1] * y + PINHOLE[3]]).reshape(1, 4)


def test_on_a_slanted_surface():
    ends = np.array([[20.0, 15.0, 140.0, 100.0], [140.0, 30.0, 40.0, 35.0], [60.0, 20.0, 60.0, 100.0]])
    found = fit_depth_lines(ends, render([SLOPED])[0], PINHOLE, NOISE)
    assert found.support.tolist() == [SURFACE] * 3
    np.testing.assert_allclose(found.end_points, on_plane(ends.reshape(-1, 2, 2), SLOPED), rtol=0, atol=1e-5)
    np.testing.assert_allclose(found.plucker[:, 3:], found.end_points[:, 1] - found.end_points[:, 0])
    assert found.inlier_share.min() > 0.99


def test_in_a_crease():
    depth, _ = render([FLOOR, WALL])
    found = fit_depth_lines(crease(), depth, PINHOLE, NOISE)
    assert found.support.tolist() == [CREASE]
    np.testing.assert_allclose(
        found.end_points, on_plane(crease().reshape(1, 2, 2), WALL), rtol=0, atol=2e-3
    )  # the pixels that the crease passes belong to one side


@pytest.mark.parametrize("nearer", [LEFT, RIGHT])
def test_an_edge_belongs_to_the_nearer_side(nearer):
    depth, _ = render([SLOPED])
    behind = depth + 0.8
    # A segment from top to bottom has larger columns to its left.
    left = np.arange(SHAPE[1]) >= 80
    scene = np.where(left == (nearer == LEFT), depth, behind)
    ends = np.array([[80.0, 20.0, 80.0, 100.0]])
    found = fit_depth_lines(ends, scene, PINHOLE, NOISE)
    assert found.support.tolist() == [nearer]
    np.testing.assert_allclose(found.end_points, on_plane(ends.reshape(1, 2, 2), SLOPED), rtol=0, atol=1e-4)
    # Reversed it is the other side, and the same line.
    back = fit_depth_lines(ends[:, [2, 3, 0, 1]], scene, PINHOLE, NOISE)
    assert back.support.tolist() == [LEFT + RIGHT - nearer]
    np.testing.assert_allclose(back.end_points[:, ::-1], found.end_points, atol=1e-4)


def test_mixed_pixels_and_a_displaced_edge_are_left_out():
    depth, _ = render([SLOPED])
    scene = np.where(np.arange(SHAPE[1]) >= 80, depth + 0.8, depth)
    scene[:, 79:82] = depth[:, 79:82] + np.random.default_rng(0).uniform(0.1, 0.7, (SHAPE[0], 3))
    ends = np.array([[80.0, 20.0, 80.0, 100.0]])
    found = fit_depth_lines(ends, scene, PINHOLE, NOISE)
    assert found.support.tolist() == [RIGHT]
    np.testing.assert_allclose(found.end_points, on_plane(ends.reshape(1, 2, 2), SLOPED), rtol=0, atol=5e-3)


def test_one_side_without_depth():
    depth, _ = render([SLOPED])
    depth[:, :80] = 0.0
    ends = np.array([[80.0, 20.0, 80.0, 100.0]])
    found = fit_depth_lines(ends, depth, PINHOLE, NOISE)
    assert found.support.tolist() == [LEFT]
    np.testing.assert_allclose(found.end_points, on_plane(ends.reshape(1, 2, 2), SLOPED), rtol=0, atol=1e-4)


@pytest.mark.compiled
def test_covariance_is_that_of_the_errors():
    rng = np.random.default_rng(11)
    surface, _ = render([SLOPED])
    hidden = np.where(np.arange(SHAPE[1]) >= 80, surface + 0.8, surface)
    on_surface = np.array([[20.0, 15.0, 70.0, 100.0], [75.0, 30.0, 20.0, 35.0]])
    edge = np.array([[80.0, 20.0, 80.0, 100.0]])
    for ends, depth in ((on_surface, surface), (edge, hidden)):
        truth = 1.0 / on_plane(ends.reshape(-1, 2, 2), SLOPED)[..., 2]
        values = []
        for _ in range(80):
            found = fit_depth_lines(ends, noisy(depth, NOISE, rng), PINHOLE, NOISE)
            assert found.good.all()
            for e, c in zip(found.inverse_depth - truth, found.inverse_depth_covariances, strict=True):
                values.append(e @ np.linalg.solve(c, e))
        # Chi-square with two degrees of freedom: the mean of 80 has a standard deviation of 0.22. Neighbouring samples
        # can fall on one pixel and inliers are cut at three sigma, both worth some percent.
        assert 1.5 < np.mean(values) < 2.9


def test_covariance_of_end_points():
    ends = np.array([[20.0, 15.0, 140.0, 100.0]])
    depth = render([SLOPED])[0]
    found = fit_depth_lines(ends, depth, PINHOLE, NOISE, sigma=0.4)
    assert np.linalg.matrix_rank(found.covariances[0], tol=1e-12) == 4
    # By differences: the segment shifted across by a standard deviation, at the same inverse depths.
    direction = (ends[0, 2:] - ends[0, :2]) / np.linalg.norm(ends[0, 2:] - ends[0, :2])
    shift = 0.4 * np.array([direction[1], -direction[0]]) / PINHOLE[:2] / found.inverse_depth[0, 0]
    without = fit_depth_lines(ends, depth, PINHOLE, NOISE, sigma=0.0)
    np.testing.assert_allclose(
        (found.covariances - without.covariances)[0, :2, :2], np.outer(shift, shift), rtol=1e-9, atol=1e-15
    )
    ray = found.end_points[0, 0]
    np.testing.assert_allclose(
        without.covariances[0, :3, :3],
        np.outer(ray, ray) * without.inverse_depth_covariances[0, 0, 0] / found.inverse_depth[0, 0] ** 2,
        rtol=1e-9,
    )


def test_errors_common_to_all_pixels():
    ends, depth = np.array([[20.0, 15.0, 140.0, 100.0]]), render([SLOPED])[0]
    white = fit_depth_lines(ends, depth, PINHOLE, NOISE)
    real = fit_depth_lines(ends, depth, PINHOLE, DepthNoise(tilt=0.01, shift=0.02))
    more = (real.inverse_depth_covariances - white.inverse_depth_covariances)[0]
    depth_more = more / np.outer(real.inverse_depth[0] ** 2, real.inverse_depth[0] ** 2)  # of depth, square metres
    length = np.linalg.norm(real.end_points[0, 1] - real.end_points[0, 0])
    assert np.ones(2) @ depth_more @ np.ones(2) == pytest.approx(4 * 0.02**2)
    assert np.array([-1, 1]) @ depth_more @ np.array([-1, 1]) == pytest.approx((0.01 * length) ** 2)


def test_what_cannot_be_fitted_is_refused():
    rng = np.random.default_rng(2)
    ends = np.array([[20.0, 15.0, 140.0, 100.0], [5.0, 5.0, 5.5, 5.5], [-90.0, -50.0, -10.0, -40.0]])
    for depth in (np.zeros(SHAPE), np.full(SHAPE, np.nan), rng.uniform(0.5, 4.0, SHAPE)):
        found = fit_depth_lines(ends, depth, PINHOLE, NOISE)
        assert not found.good.any()
        assert found.support.tolist() == [NONE] * 3
        for values in (found.end_points, found.covariances, found.inverse_depth, found.plucker):
            assert not values.any()
    assert len(fit_depth_lines(np.zeros((0, 4)), np.ones(SHAPE), PINHOLE)) == 0
    with pytest.raises(ShapeError, match=r"\(N, 4\)"):
        fit_depth_lines(np.zeros(4), np.ones(SHAPE), PINHOLE)
    with pytest.raises(InputError, match="near"):
        fit_depth_lines(ends, np.ones(SHAPE), PINHOLE, gates=DepthLineGates(near=5, far=2))
