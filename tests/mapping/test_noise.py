# SPDX-License-Identifier: BSD-3-Clause
"""Noise from residuals: its size, noise of one size left alone, points whose noise differs told apart.

And segments: how the errors of their ends are correlated, that lines are measured where they are independent, and where
the loss that fits their errors bends.
And by how much an adjustment moves what the images see.
"""

import numpy as np
import pytest

import groma
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.pixel_residuals import squared_residuals_px
from groma.errors import InputError
from groma.evaluation import evaluate_poses
from groma.geometry import quaternion
from groma.mapping.noise.landmarks import point_noise
from groma.mapping.noise.observations import line_bend, line_end_correlation, moved_px, noise_px, with_point_noise
from groma.problem.residuals import residuals_of
from groma.scene import PointDepths, Relations, Similarity, synthetic

pytestmark = pytest.mark.kernels

NOISE = 0.5


def scene_with(sigma_of_point, seed=0, wrong=0.0):
    """A scene of points at its truth, with Gaussian noise of a size per point; a part of the pixels far off."""
    rng = np.random.default_rng(seed)
    made = synthetic.holistic(20, noise_px=0.0, seed=seed)
    truth = made.truth.replace(relations=Relations())
    table = truth.point_observations
    size = sigma_of_point(rng, truth.num_points)
    pixel = table.pixel + size[table.point_idx][:, None] * rng.normal(size=table.pixel.shape)
    off = rng.random(len(pixel)) < wrong
    pixel[off] += rng.uniform(5.0, 30.0, (int(off.sum()), 2))
    noisy = table.replace(pixel=pixel)
    start = made.start.replace(relations=Relations(), point_observations=noisy)
    return truth, start, size


def adjusted(scene, loss="cauchy", scale=2.0):
    return groma.adjust(scene, groma.AdjustOptions(loss=loss, loss_scale=scale, lines=False, planes=False)).scene


def varied(rng, count):
    return NOISE * np.exp(rng.normal(0.0, 0.7, count))


@pytest.mark.compiled
def test_size_of_the_noise():
    _, start, _ = scene_with(lambda rng, count: np.full(count, NOISE))
    assert noise_px(adjusted(start), "points") == pytest.approx(NOISE, rel=0.05)


@pytest.mark.compiled
def test_noise_of_one_size_is_left_alone():
    _, start, _ = scene_with(lambda rng, count: np.full(count, NOISE))
    own = with_point_noise(adjusted(start)).point_observations.sigma
    assert np.median(own) == pytest.approx(1.0)
    assert np.std(np.log(own)) < 0.1


@pytest.mark.compiled
def test_noise_of_each_point_is_found():
    _, start, size = scene_with(varied, wrong=0.02)
    scene = with_point_noise(adjusted(start))
    table = scene.point_observations
    own = np.ones(scene.num_points)
    own[table.point_idx] = table.sigma
    assert np.corrcoef(np.log(own), np.log(size))[0, 1] > 0.7
    # Chance takes part in single values; the spread must be that of the noise, drawn together.
    assert 0.35 < np.std(np.log(own)) < 0.8


@pytest.mark.compiled
def test_weights_by_it_bring_the_cameras_nearer():
    plain, weighted = [], []
    for seed in range(4):
        truth, start, _ = scene_with(varied, seed, wrong=0.02)
        scene = adjusted(start, "geman_mcclure", 6.0)
        plain.append(evaluate_poses(scene, truth).center_rmse)
        scene = adjusted(with_point_noise(scene), "geman_mcclure", 6.0)
        weighted.append(evaluate_poses(scene, truth).center_rmse)
    assert np.mean(weighted) < 0.85 * np.mean(plain)


@pytest.mark.compiled
def test_given_deviations_are_kept_in_proportion():
    _, start, _ = scene_with(lambda rng, count: np.full(count, NOISE))
    table = start.point_observations
    given = np.where(np.arange(len(table)) % 2, 1.0, 2.0)
    exact = synthetic.holistic(20, noise_px=0.0, seed=0).truth.point_observations.pixel
    uneven = start.replace(
        point_observations=table.replace(pixel=exact + given[:, None] * (table.pixel - exact), sigma=given)
    )
    own = with_point_noise(adjusted(uneven)).point_observations.sigma
    assert np.std(np.log(own / given)) < 0.1


def test_scenes_that_tell_nothing_are_returned():
    exact = synthetic.holistic(20, noise_px=0.0, seed=0).truth
    assert with_point_noise(exact) is exact
    small = synthetic.holistic(4, noise_px=1.0, seed=0).truth
    assert with_point_noise(small) is small


def lines_with(correlation, seed=0, num_images=30, freedom=np.inf):
    """A scene of lines whose segments have ends with correlated noise, as fits to the pixels of an edge do.

    With degrees of freedom it follows Student's distribution.
    """
    made = synthetic.holistic(num_images, noise_px=0.0, seed=seed)
    truth, rng = made.truth.replace(relations=Relations()), np.random.default_rng(seed)
    table = truth.line_observations
    first, second = table.segment[:, :2], table.segment[:, 2:]
    normal = (second - first)[:, ::-1] * [-1.0, 1.0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    shift, turn = rng.normal(size=(2, len(table), 1)) * NOISE
    if np.isfinite(freedom):
        shift, turn = np.array([shift, turn]) / np.sqrt(rng.chisquare(freedom, (len(table), 1)) / freedom)
    shift, turn = shift * np.sqrt((1 + correlation) / 2), turn * np.sqrt((1 - correlation) / 2)
    noisy = np.hstack([first + (shift - turn) * normal, second + (shift + turn) * normal])
    start = made.start.replace(relations=Relations(), line_observations=table.replace(segment=noisy))
    return truth, start


@pytest.mark.parametrize("correlation", [-0.5, 0.0, 0.5])
def test_correlation_of_the_ends_of_segments_and_its_noise(correlation):
    truth, start = lines_with(correlation, num_images=60)
    options = groma.AdjustOptions(loss="none", points=False, planes=False, refine_poses=False)
    scene = groma.adjust(start.with_poses(truth.cam_from_world), options).scene
    found = line_end_correlation(scene)
    assert found == pytest.approx(correlation, abs=0.15)
    assert noise_px(scene, "lines", found) == pytest.approx(NOISE, rel=0.15)


@pytest.mark.parametrize("freedom", [1.5, 3.0, 8.0])
def test_a_loss_of_segments_bends_where_their_errors_do(freedom):
    """The scale of Student's distribution, in deviations that the median tells; of normal noise it is far out."""
    truth, start = lines_with(-0.5, num_images=60, freedom=freedom)
    exact = truth.replace(line_observations=start.line_observations)
    median = 2.0 * np.log(2.0)
    expected = np.sqrt(median / (2.0 ** (2.0 / freedom) - 1.0))
    # Of n squares the bend is known to about 1 / sqrt(n) in the mean, here 3 %, and to twice that at 8.
    assert line_bend(exact, -0.5) == pytest.approx(expected, rel=0.2)


def test_a_loss_of_normal_segments_hardly_bends():
    truth, start = lines_with(-0.5, num_images=60)
    assert line_bend(truth.replace(line_observations=start.line_observations), -0.5) > 4.0


def test_few_segments_tell_no_bend():
    assert line_bend(lines_with(-0.5, num_images=6)[1]) == np.inf
    assert line_bend(scene_with(varied)[1].points_only()) == np.inf


@pytest.mark.parametrize("correlation", [-0.5, 0.5])
def test_lines_are_measured_where_errors_are_independent(correlation):
    truth, start = lines_with(correlation, num_images=60)
    exact = truth.replace(line_observations=start.line_observations)
    problem = assemble(exact, AssemblyOptions(points=False, line_sigma_px=NOISE, line_end_correlation=correlation))
    (factor,) = problem.problem.factors
    whitened = residuals_of(factor, problem.problem.variables) * np.asarray(factor.sqrt_information)[:, None]
    np.testing.assert_allclose(np.cov(whitened.T), np.eye(2), atol=0.2)


@pytest.mark.parametrize("correlation", [-0.5, 0.4])
def test_reported_distances_are_those_of_the_ends(correlation):
    scene = lines_with(0.0)[1]
    at_ends, elsewhere = (
        squared_residuals_px(assemble(scene, AssemblyOptions(points=False, line_end_correlation=number)))["lines"]
        for number in (0.0, correlation)
    )
    np.testing.assert_allclose(elsewhere, at_ends, rtol=1e-6, atol=1e-9)


def test_a_correlation_of_one_is_refused():
    with pytest.raises(InputError, match="line_end_correlation must be between -1 and 1"):
        AssemblyOptions(line_end_correlation=1.0)


def test_few_lines_tell_no_correlation():
    assert line_end_correlation(lines_with(-0.5, num_images=6)[1]) == 0.0
    assert line_end_correlation(scene_with(varied)[1].points_only()) == 0.0


def test_what_images_see_does_not_move_with_the_frame():
    truth, start, _ = scene_with(varied)
    turned = truth.transformed(Similarity(2.0, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([1.0, 2, 3])))
    assert moved_px(truth, turned, 0.1) < 1e-9
    assert moved_px(truth, start, 0.5) > 1.0
    assert moved_px(truth, start, 0.1) > moved_px(truth, start, 0.5)


def test_a_depth_tells_where_a_point_is():
    """Along the axis of the camera that measured it, a point is known as well as its depth, far better than before."""
    truth, _, _ = scene_with(lambda rng, count: np.full(count, NOISE))
    point = np.arange(truth.num_points)
    axis = quaternion.to_matrix(truth.cam_from_world[:1, :4])[0, 2]
    depth = truth.points.xyz @ axis + truth.cam_from_world[0, 6]
    image = np.zeros(len(point), np.int64)
    before = point_noise(truth, 1.0).covariance
    after = point_noise(truth.replace(point_depths=PointDepths(image, point, depth, np.full(len(point), 1e-4))), 1.0)
    along = np.sqrt(np.einsum("i,nij,j->n", axis, after.covariance, axis))
    assert (along < 1e-4).all()
    assert np.median(along) > 0.9e-4
    assert (np.sqrt(np.einsum("i,nij,j->n", axis, before, axis)) > 2e-4).all()
