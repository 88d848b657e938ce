# SPDX-License-Identifier: BSD-3-Clause
"""The synthetic scenes are what they promise: counts, tracks, incidences, noise, perturbation, repeatability."""

import numpy as np
import pytest
from _comparison import equal

from groma.errors import InputError
from groma.evaluation.poses import rotation_angle
from groma.scene.synthetic.noise import project_pinhole
from groma.scene.synthetic.scenes import corridor, holistic


def incidence_error(scene) -> float:
    """Return the largest distance of a related point or line end from its plane or line."""
    relations, hesse = scene.relations, scene.planes.hesse
    on_plane = relations.point_on_plane
    worst = [np.abs((scene.points.xyz[on_plane[:, 0]] * hesse[on_plane[:, 1], :3]).sum(1) + hesse[on_plane[:, 1], 3])]
    on_plane = relations.line_on_plane
    ends = scene.lines.segments[on_plane[:, 0]]
    worst.append(np.abs(np.einsum("lei,li->le", ends, hesse[on_plane[:, 1], :3]) + hesse[on_plane[:, 1], 3:]).ravel())
    on_line = relations.point_on_line
    plucker = scene.lines.plucker[on_line[:, 1]]
    worst.append(np.linalg.norm(np.cross(scene.points.xyz[on_line[:, 0]], plucker[:, 3:]) - plucker[:, :3], axis=1))
    return float(np.concatenate(worst).max())


def point_residuals(scene) -> np.ndarray:
    seen = scene.point_observations
    poses = scene.cam_from_world[seen.image_idx]
    pixel, depth = project_pinhole(scene.cameras.params[0], poses, scene.points.xyz[seen.point_idx])
    assert depth.min() > 0.3
    return pixel - seen.pixel


def line_residuals(scene) -> np.ndarray:
    """Distances of measured end points from the projected line."""
    seen = scene.line_observations
    ends = scene.lines.segments[seen.line_idx]
    params, poses = scene.cameras.params[0], scene.cam_from_world[seen.image_idx]
    one, two = (project_pinhole(params, poses, ends[:, end])[0] for end in (0, 1))
    along = (two - one) / np.linalg.norm(two - one, axis=1, keepdims=True)
    normal = np.column_stack([-along[:, 1], along[:, 0]])
    return np.concatenate(
        [((seen.segment[:, :2] - one) * normal).sum(1), ((seen.segment[:, 2:] - one) * normal).sum(1)]
    )


@pytest.mark.parametrize("views", ["random", "near"])
@pytest.mark.parametrize("num_images", [50, 150])
def test_holistic(num_images, views):
    made = holistic(num_images, seed=7, views=views)
    scene = made.truth
    assert (scene.num_points, scene.num_lines, scene.num_planes) == (10 * num_images, num_images, num_images // 5)
    assert np.bincount(scene.relations.point_on_plane[:, 1]).tolist() == [10] * scene.num_planes
    assert np.bincount(scene.relations.line_on_plane[:, 1]).tolist() == [2] * scene.num_planes
    assert np.bincount(scene.relations.point_on_line[:, 1]).tolist() == [3] * num_images
    for owner, count in (
        (scene.point_observations.point_idx, scene.num_points),
        (scene.line_observations.line_idx, scene.num_lines),
    ):
        tracks = np.bincount(owner, minlength=count)
        assert (tracks.min(), tracks.max()) == (4, 8)
    assert incidence_error(scene) < 1e-12
    length = np.linalg.norm(scene.lines.segments[:, 1] - scene.lines.segments[:, 0], axis=1)
    assert 0.5 <= length.min() and length.max() <= 3.0
    assert max(np.abs(scene.points.xyz).max(), np.abs(scene.lines.segments).max()) <= 3 + 1e-9
    assert (np.sort(np.abs(scene.planes.hesse[:, :3]), axis=1) == [0, 0, 1]).all()
    # Standard errors: 1 px / sqrt(2 n), n residuals; five of them are allowed.
    for residual in (point_residuals(scene), line_residuals(scene)):
        assert abs(residual.std() - 1) < 5 / np.sqrt(2 * residual.size)
    start = made.start
    for one, two, sigma in (
        (start.cam_from_world[:, 4:], scene.cam_from_world[:, 4:], 0.05),
        (start.points.xyz, scene.points.xyz, 0.1),
        (start.lines.segments, scene.lines.segments, 0.1),
    ):
        assert abs((one - two).std() / sigma - 1) < 5 / np.sqrt(2 * one.size)
    angle = np.rad2deg(rotation_angle(start.cam_from_world[:, :4], scene.cam_from_world[:, :4]))
    assert abs(np.sqrt((angle**2).mean() / 3) - 1) < 5 / np.sqrt(6 * num_images)


def test_near_views_make_a_band():
    spread = {}
    for views in ("random", "near"):
        scene = holistic(150, seed=1, views=views).truth
        center = scene.cam_centers_in_world
        azimuth = np.exp(1j * np.arctan2(center[:, 1], center[:, 0]))
        seen = scene.point_observations
        total = np.zeros(scene.num_points, complex)
        np.add.at(total, seen.point_idx, azimuth[seen.image_idx])
        spread[views] = np.abs(total / np.bincount(seen.point_idx)).mean()
    assert spread["near"] > 0.95 > 0.7 > spread["random"]


@pytest.mark.parametrize("num_images", [2, 3, 4, 7])
def test_few_images(num_images):
    scene = holistic(num_images, seed=3).truth
    assert np.bincount(scene.point_observations.point_idx).min() >= 2
    assert np.isfinite(point_residuals(scene)).all()


@pytest.mark.parametrize("size", ["tiny", 30])
def test_corridor(size):
    made = corridor(size, seed=2)
    scene = made.truth
    assert incidence_error(scene) < 1e-11
    assert np.bincount(scene.point_observations.point_idx).min() >= 2
    assert np.bincount(scene.line_observations.line_idx).min() >= 3
    assert len(scene.relations.point_on_plane) == scene.num_points
    for residual in (point_residuals(scene), line_residuals(scene)):
        assert abs(residual.std() / 0.5 - 1) < 5 / np.sqrt(2 * residual.size)
    assert abs((made.start.points.xyz - scene.points.xyz).std() / 0.05 - 1) < 5 / np.sqrt(6 * scene.num_points)


@pytest.mark.parametrize("make", [holistic, corridor])
def test_seeds(make):
    first, again, other = make(20, seed=4), make(20, seed=4), make(20, seed=5)
    assert equal(first.truth, again.truth)
    assert equal(first.start, again.start)
    assert not equal(first.truth, other.truth)
    calm = make(20, seed=4, noise_px=0.0).truth
    assert np.abs(point_residuals(calm)).max() < 1e-9


def test_messages():
    with pytest.raises(InputError, match="at least 2"):
        holistic(1)
    with pytest.raises(InputError, match="'random' or 'near'"):
        holistic(10, views="all")
    with pytest.raises(InputError, match="tiny, small"):
        corridor("huge")
