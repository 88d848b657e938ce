# SPDX-License-Identifier: BSD-3-Clause
"""Points measured again in photographs: pictures of a wall given by a formula, exact poses and points."""

import numpy as np
import pytest

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.errors import InputError
from groma.execution import work_with
from groma.geometry import quaternion, se3
from groma.io import read_scene, write_scene
from groma.mapping import refine_points as refining
from groma.mapping.noise.observations import noise_px
from groma.mapping.refine_points import refine_points
from groma.scene import Cameras, PointObservations, Points, Scene

WIDTH, HEIGHT, FOCAL, NOISE = 320, 240, 300.0, 0.3
CAMERA = np.array([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2])


def wall(places):
    """Grey levels of the plane z = 0 at (..., 2); a unit is seen at about 60 pixels."""
    rng = np.random.default_rng(1)
    frequency, heading, phase = 2 * np.pi * 60.0 / rng.uniform(6.0, 25.0, 40), *rng.uniform(0.0, 2 * np.pi, (2, 40))
    waves = np.stack([frequency * np.cos(heading), frequency * np.sin(heading)])
    return 127.0 + 10.0 * np.cos(places @ waves + phase).sum(axis=-1)


def picture(pose, rng):
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - CAMERA[2]) / FOCAL, (v - CAMERA[3]) / FOCAL, np.ones_like(u)], axis=-1)
    R = quaternion.to_matrix(pose[None, :4])[0]
    center, rays = -R.T @ pose[4:], rays @ R
    places = center[:2] - center[2] * rays[..., :2] / rays[..., 2:]
    return np.clip(np.round(wall(places) + rng.normal(0.0, 2.0, u.shape)), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def world():
    """Truth, the truth seen with noisy keypoints, and the pictures."""
    rng = np.random.default_rng(3)
    centers = [[x, y, -5.0 + 0.2 * x] for x in (-1.5, -0.5, 0.5, 1.5) for y in (-0.6, 0.6)]
    poses = se3.looking_at(centers, np.multiply(centers, [0.2, 0.0, 0.0]), up=[0.0, -1.0, 0.0])
    images = [picture(pose, rng) for pose in poses]
    xyz = np.column_stack([rng.uniform([-1.8, -1.2], [1.8, 1.2], (150, 2)), np.zeros(150)])
    rows = []
    for i, pose in enumerate(poses):
        local = quaternion.rotate(pose[:4], xyz) + pose[4:]
        pixel = FOCAL * local[:, :2] / local[:, 2:] + CAMERA[2:]
        seen = np.flatnonzero(((pixel > 2) & (pixel < [WIDTH - 2, HEIGHT - 2])).all(axis=1))
        rows.append((np.full(len(seen), i), seen, pixel[seen]))
    image, point, pixel = (np.concatenate(column) for column in zip(*rows, strict=True))

    def scene(pixels):
        return Scene.from_images(
            Cameras(np.array([1]), ("PINHOLE",), CAMERA[None], np.array([WIDTH]), np.array([HEIGHT])),
            [f"{i}.png" for i in range(len(poses))],
            np.zeros(len(poses), int),
            poses,
            points=Points.at(xyz),
            point_observations=PointObservations(image, point, pixels, np.arange(len(image))),
        )

    return scene(pixel), scene(pixel + rng.normal(0.0, NOISE, pixel.shape)), images


def center_errors(scene, truth):
    """Distances of camera centres after similarity alignment."""
    found, right = scene.cam_centers_in_world, truth.cam_centers_in_world
    a, b = found - found.mean(axis=0), right - right.mean(axis=0)
    U, size, V = np.linalg.svd(b.T @ a)
    turn = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ V))]) @ V
    return np.linalg.norm((size.sum() / (a**2).sum()) * a @ turn.T - b, axis=1)


def test_observations_of_a_point_agree_to_a_few_hundredths_of_a_pixel(world):
    """The noise falls to a quarter and less, by residuals and by the errors of the cameras."""
    truth, noisy, images = world
    before = adjust(noisy).scene
    found = refine_points(before, images.__getitem__, noise_px(before, "points"))
    assert found.refined[~found.reference].mean() > 0.85
    after = adjust(found.scene, AdjustOptions(point_sigma_px=found.sigma_px)).scene
    assert noise_px(before, "points") == pytest.approx(NOISE, rel=0.1)
    assert noise_px(after, "points") < 0.25 * NOISE
    # what the images promise is what the residuals show
    assert noise_px(after, "points") == pytest.approx(found.sigma_px, rel=0.5)
    rms = [np.sqrt((center_errors(scene, truth) ** 2).mean()) for scene in (before, after)]
    assert rms[1] < 0.35 * rms[0]


def test_points_in_chunks_and_threads_give_the_same(world, monkeypatch):
    _, noisy, images = world
    with work_with(1):
        once = refine_points(noisy, images.__getitem__, NOISE)
    seen = []
    monkeypatch.setattr(refining, "GATES", refining.PointRefinementGates(points_at_once=40))
    with work_with(2):
        again = refine_points(noisy, images.__getitem__, NOISE, lambda done, total: seen.append((done, total)))
    np.testing.assert_array_equal(again.scene.point_observations.pixel, once.scene.point_observations.pixel)
    np.testing.assert_array_equal(again.scene.point_observations.sigma, once.scene.point_observations.sigma)
    assert seen[-1] == (64, 64)  # four chunks, eight images, each read twice


def test_pictures_that_say_nothing_change_nothing(world):
    _, noisy, images = world
    black = refine_points(noisy, lambda image: np.zeros_like(images[image]), NOISE)
    assert not black.refined.any()
    assert black.sigma_px == NOISE
    np.testing.assert_array_equal(black.scene.point_observations.pixel, noisy.point_observations.pixel)
    np.testing.assert_array_equal(black.scene.point_observations.sigma, 1.0)
    # pictures of something else: what correlates by chance is rare and stays near
    other = refine_points(noisy, lambda image: images[(image + 3) % 8][::-1].copy(), NOISE)
    assert other.refined.mean() < 0.1


def test_wrong_matches_keep_their_places(world):
    _, noisy, images = world
    table = noisy.point_observations
    rows = np.arange(0, len(table), 10)
    pixel = table.pixel.copy()
    pixel[rows] = np.random.default_rng(0).uniform(20.0, 220.0, (len(rows), 2))
    spoiled = noisy.replace(point_observations=table.replace(pixel=pixel))
    found = refine_points(spoiled, images.__getitem__, NOISE)
    kept = np.linalg.norm(found.scene.point_observations.pixel[rows] - pixel[rows], axis=1) == 0.0
    assert kept.mean() > 0.9


def test_noise_must_be_positive(world):
    with pytest.raises(InputError, match="sigma_px must be positive"):
        refine_points(world[1], world[2].__getitem__, 0.0)


def test_deviations_survive_the_archive(world, tmp_path):
    _, noisy, _ = world
    sigma = np.linspace(0.5, 2.0, len(noisy.point_observations))
    write_scene(noisy.replace(point_observations=noisy.point_observations.replace(sigma=sigma)), tmp_path / "a.npz")
    np.testing.assert_array_equal(read_scene(tmp_path / "a.npz").point_observations.sigma, sigma)
    write_scene(noisy, tmp_path / "b.npz")
    with np.load(tmp_path / "b.npz") as archive:
        assert "point_observations.sigma" not in archive.files  # as old readers expect it
    np.testing.assert_array_equal(read_scene(tmp_path / "b.npz").point_observations.sigma, 1.0)
    with pytest.raises(InputError, match=r"PointObservations\.sigma must be positive"):
        noisy.point_observations.replace(sigma=0.0 * sigma)
