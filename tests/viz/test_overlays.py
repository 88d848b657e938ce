# SPDX-License-Identifier: BSD-3-Clause
"""Numbers of lines, images of their segments, and crops of photographs around them."""

import xml.etree.ElementTree as ElementTree

import numpy as np
from _scene import exact_scene

from groma.geometry import se3
from groma.scene import Scene, synthetic
from groma.viz.report.overlays import observation_crop, projected_places, residual_top
from groma.viz.statistics import line_statistics


def moved(distance: float) -> Scene:
    """The exact scene, where all ends measured in the first image are moved across their segment."""
    scene = exact_scene()
    seen = scene.line_observations
    segment = seen.segment.copy()
    way = segment[:, 2:] - segment[:, :2]
    across = np.column_stack([-way[:, 1], way[:, 0]]) / np.linalg.norm(way, axis=1, keepdims=True)
    first = seen.image_idx == 0
    segment[first] += distance * np.tile(across, 2)[first]
    return scene.replace(line_observations=seen.replace(segment=segment))


def polylines(scene: Scene, image: int, lines: np.ndarray) -> list[np.ndarray]:
    """Images of 3D segments without the places that are not seen."""
    return [row[kept] for row, kept in zip(*projected_places(scene, image, lines), strict=True)]


# ------------------------------------------------------------------------------------------------------ Statistics


def test_statistics_of_exact_lines():
    scene = exact_scene()
    numbers = line_statistics(scene)
    ends = scene.lines.segments
    np.testing.assert_allclose(numbers.length, np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), rtol=1e-15)
    assert numbers.num_images.tolist() == [2, 2, 2, 2]
    # Distortion is undone by iteration, to about 1e-10 of the focal length.
    assert numbers.residual_px.max() < 1e-6


def test_statistics_of_moved_ends():
    numbers = line_statistics(moved(0.8))
    np.testing.assert_allclose(numbers.observation_residual_px[:4], 0.8, atol=1e-6)
    # One of two images is off by 0.8 px.
    np.testing.assert_allclose(numbers.residual_px, 0.8 / np.sqrt(2), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(numbers.end_residuals[:4], axis=2), 0.8, atol=1e-6)


def test_statistics_count_images_and_not_observations():
    scene = exact_scene()
    twice = np.r_[np.arange(8), 0, 0]
    numbers = line_statistics(scene.replace(line_observations=scene.line_observations.take(twice)))
    assert numbers.num_images.tolist() == [2, 2, 2, 2]
    assert len(numbers.observation_residual_px) == 10


def test_statistics_of_lines_without_observations():
    scene = exact_scene()
    numbers = line_statistics(scene.replace(line_observations=scene.line_observations.take(np.array([0]))))
    assert np.isnan(numbers.residual_px[1:]).all() and np.isfinite(numbers.residual_px[0])
    assert numbers.num_images.tolist() == [1, 0, 0, 0]


def test_statistics_of_noise_are_those_of_the_noise():
    made = synthetic.holistic(20, seed=1, noise_px=0.5)
    numbers = line_statistics(made.truth)
    # Ends carry 0.5 px on both axes, of which the part across the line remains.
    rms = np.sqrt(np.mean(numbers.observation_residual_px**2))
    count = 2 * made.truth.num_line_observations
    assert abs(rms - 0.5) < 4 * 0.5 / np.sqrt(2 * count)


def test_statistics_of_an_empty_scene():
    numbers = line_statistics(Scene())
    assert len(numbers.length) == len(numbers.num_images) == len(numbers.residual_px) == 0
    assert residual_top(numbers) == 1.0


# -------------------------------------------------------------------------------------------------------- Overlays


def test_projected_segments_are_the_images_of_the_ends():
    scene = exact_scene()
    for image in (0, 1):
        rows = scene.line_observations.image_idx == image
        found = polylines(scene, image, scene.line_observations.line_idx[rows])
        # Two places under a pinhole camera, where images of lines are straight; more under the other.
        assert [len(places) == 2 for places in found] == [image == 0] * 4
        ends = np.array([np.concatenate([places[0], places[-1]]) for places in found])
        np.testing.assert_allclose(ends, scene.line_observations.segment[rows], atol=1e-9)


def test_segments_through_the_plane_of_the_camera_are_cut():
    scene = exact_scene().subset([0])
    world_from_cam = np.linalg.inv(se3.to_matrix(scene.cam_from_world)[0])
    in_cam = np.array([[[0.5, 0.2, 2.0], [0.5, 0.2, -2.0]], [[0.5, 0.2, -1.0], [0.3, 0.2, -2.0]]])
    ends = in_cam @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]
    segments = scene.lines.segments.copy()
    segments[:2] = ends
    scene = scene.replace(lines=type(scene.lines).through(segments))
    cut, behind = polylines(scene, 0, np.array([0, 1]))
    assert len(behind) == 0
    np.testing.assert_allclose(cut[0], [500 * 0.25 + 320, 510 * 0.1 + 240], atol=1e-9)
    # The image of the line leads through the principal point's far side: same direction, far away.
    assert np.isfinite(cut).all() and cut[1, 0] > 1e4
    np.testing.assert_allclose((cut[1] - [320, 240])[1] / (cut[1] - [320, 240])[0], 0.2 * 510 / (0.5 * 500), rtol=1e-9)


def test_crops_show_the_surroundings():
    picture = np.zeros((100, 200, 3), np.uint8)
    crop = observation_crop(picture, (400, 200), np.array([100.0, 90, 160, 110]), np.ones((2, 2)), "#123456")
    left, top, width, height = map(float, ElementTree.fromstring(crop).get("viewBox").split())
    assert 0 <= left < 100 and left + width > 160 and 0 <= top < 90 and top + height > 110
    assert width < 200 and "#123456" in crop


def test_crops_outside_the_photograph_are_empty():
    picture = np.zeros((100, 200, 3), np.uint8)
    assert observation_crop(picture, (200, 100), np.array([900.0, 90, 960, 110]), np.ones((2, 2)), "#fff") == ""
