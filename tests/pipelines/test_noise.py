# SPDX-License-Identifier: BSD-3-Clause
"""Noise from residuals: its size, noise of one size left alone, and points whose noise differs told apart."""

import numpy as np
import pytest

import groma
from groma.evaluation import evaluate_poses
from groma.pipelines._noise import noise_px, with_point_noise
from groma.scene import Relations, synthetic

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


def test_size_of_the_noise():
    _, start, _ = scene_with(lambda rng, count: np.full(count, NOISE))
    assert noise_px(adjusted(start), "points") == pytest.approx(NOISE, rel=0.05)


def test_noise_of_one_size_is_left_alone():
    _, start, _ = scene_with(lambda rng, count: np.full(count, NOISE))
    own = with_point_noise(adjusted(start)).point_observations.sigma
    assert np.median(own) == pytest.approx(1.0)
    assert np.std(np.log(own)) < 0.1


def test_noise_of_each_point_is_found():
    _, start, size = scene_with(varied, wrong=0.02)
    scene = with_point_noise(adjusted(start))
    table = scene.point_observations
    own = np.ones(scene.num_points)
    own[table.point_idx] = table.sigma
    assert np.corrcoef(np.log(own), np.log(size))[0, 1] > 0.7
    # Chance takes part in single values; the spread must be that of the noise, drawn together.
    assert 0.35 < np.std(np.log(own)) < 0.8


def test_weights_by_it_bring_the_cameras_nearer():
    plain, weighted = [], []
    for seed in range(4):
        truth, start, _ = scene_with(varied, seed, wrong=0.02)
        scene = adjusted(start, "geman_mcclure", 6.0)
        plain.append(evaluate_poses(scene, truth).center_rmse)
        scene = adjusted(with_point_noise(scene), "geman_mcclure", 6.0)
        weighted.append(evaluate_poses(scene, truth).center_rmse)
    assert np.mean(weighted) < 0.85 * np.mean(plain)


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
