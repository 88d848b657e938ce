# SPDX-License-Identifier: BSD-3-Clause
"""Errors that neighbours in an image share: found where there are some, weighed down where many share them."""

import numpy as np
import pytest

import groma
from groma.evaluation import evaluate_poses
from groma.mapping.noise.landmarks import pixels_of, project_points
from groma.mapping.noise.shared import with_shared_noise
from groma.scene import PointObservations, Points, Relations, Scene, synthetic

pytestmark = pytest.mark.kernels

NOISE, NUM_IMAGES = 0.2, 6


def crowded(seed: int, shared_px: float, count: int = 800) -> tuple[Scene, Scene]:
    """Truth, and observations of it: most points crowd in one place; errors wave through every image."""
    rng = np.random.default_rng(seed)
    made = synthetic.holistic(NUM_IMAGES, noise_px=0.0, seed=seed).truth.points_only()
    low, high = np.quantile(made.points.xyz, [0.1, 0.9], axis=0)
    xyz = rng.uniform(low, high, (count, 3))
    xyz[count // 4 :] = rng.uniform(low, high) + 0.1 * (high - low) * rng.normal(size=(count - count // 4, 3))
    image_idx, point_idx = (index.ravel() for index in np.indices((NUM_IMAGES, count)))
    everything = made.replace(
        points=Points.at(xyz),
        point_observations=PointObservations.numbered(image_idx, point_idx, np.zeros((len(image_idx), 2))),
        relations=Relations(),
    )
    pixel = pixels_of(everything, image_idx, xyz[point_idx])
    camera = made.cameras
    inside = (pixel > 0).all(axis=1) & (pixel < [camera.width[0], camera.height[0]]).all(axis=1)
    exact, image, point = pixel[inside], image_idx[inside], point_idx[inside]
    truth = everything.replace(point_observations=PointObservations.numbered(image, point, exact))
    # Waves of three hundred pixels and more, of their own in every image.
    wave = rng.normal(size=(6, NUM_IMAGES, 2, 2)) * 2 * np.pi / 300 / np.sqrt(2)
    phase = rng.uniform(0, 2 * np.pi, (6, NUM_IMAGES, 2))
    turns = np.einsum("wnck,nk->wnc", wave[:, image], exact) + phase[:, image]
    shared = shared_px * np.sqrt(2 / 6) * np.cos(turns).sum(axis=0)
    noisy = exact + shared + NOISE * rng.normal(size=exact.shape)
    return truth, truth.replace(point_observations=PointObservations.numbered(image, point, noisy))


def adjusted(scene: Scene) -> Scene:
    return groma.adjust(scene, groma.AdjustOptions(loss="none", point_sigma_px=NOISE)).scene


@pytest.mark.compiled
def test_independent_errors_leave_every_observation_its_weight():
    scene = adjusted(crowded(0, 0.0)[1])
    found = with_shared_noise(scene, NOISE, NOISE)
    np.testing.assert_array_equal(found.point_observations.sigma, scene.point_observations.sigma)


@pytest.mark.compiled
def test_a_crowd_that_shares_errors_weighs_less():
    scene = adjusted(crowded(0, 0.2)[1])
    factor = with_shared_noise(scene, NOISE, NOISE).point_observations.sigma
    crowd = scene.point_observations.point_idx >= scene.num_points // 4
    assert np.median(factor) == pytest.approx(1.0)
    assert np.median(factor[crowd]) > 1.5 * np.median(factor[~crowd])


@pytest.mark.compiled
def test_cameras_come_nearer_for_it():
    plain, weighed = [], []
    for seed in range(4):
        truth, scene = crowded(seed, 0.2)
        scene = adjusted(scene)
        plain.append(evaluate_poses(scene, truth).center_rmse)
        weighed.append(evaluate_poses(adjusted(with_shared_noise(scene, NOISE, NOISE)), truth).center_rmse)
    assert np.mean(np.log(weighed)) < np.mean(np.log(plain)) - 0.1


@pytest.mark.compiled
def test_a_spot_that_is_found_twice_shares_the_weight_of_one():
    scene = adjusted(crowded(0, 0.0)[1])
    table = scene.point_observations
    order = np.r_[np.arange(len(table)), np.arange(100)]
    twice = scene.replace(point_observations=table.take(order))
    sigma = with_shared_noise(twice, NOISE, NOISE).point_observations.sigma
    np.testing.assert_allclose(sigma * np.where(order < 100, 1 / np.sqrt(2), 1.0), np.ones(len(order)))


def test_scenes_that_tell_nothing_are_returned():
    small = synthetic.holistic(4, noise_px=1.0, seed=0).truth
    assert with_shared_noise(small, 1.0, 1.0) is small


def test_derivatives_of_pixels_are_those_of_differences():
    """Also behind cameras: nothing is known there, in pixels nor in derivatives."""
    scene = synthetic.holistic(NUM_IMAGES, noise_px=0.0, seed=3).truth
    image_idx = np.repeat(np.arange(NUM_IMAGES), 40)
    places = np.random.default_rng(1).uniform(-8.0, 8.0, (len(image_idx), 3))
    pixels, by_world = project_points(scene, image_idx, places)
    np.testing.assert_array_equal(pixels_of(scene, image_idx, places), pixels)
    seen = np.isfinite(pixels).all(axis=1)
    assert seen.any() and not seen.all() and np.isnan(by_world[~seen]).all()
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        difference = pixels_of(scene, image_idx, places + step) - pixels_of(scene, image_idx, places - step)
        scale = np.abs(by_world[seen]).max(axis=(1, 2))[:, None]
        near = np.isfinite(difference[seen]).all(axis=1)
        np.testing.assert_allclose(
            (difference[seen] / 2e-6 / scale)[near], (by_world[seen, :, axis] / scale)[near], atol=1e-4
        )
