# SPDX-License-Identifier: BSD-3-Clause
"""Panoramas and wide fisheyes: the views that they are seen in, segments found there, and lines mapped from them."""

import _box_room as _room
import cv2
import numpy as np
import pytest

from groma import cameras
from groma.cameras.across import pixels_across
from groma.errors import InputError
from groma.features.lsd import LsdDetector
from groma.features.segments import Segments
from groma.geometry import quaternion
from groma.geometry.algebra import unit
from groma.mapping.lines.in_views import map_lines_in_views
from groma.mapping.lines.outcomes import Outcome
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions
from groma.mapping.wide_views import WideDetection, WideViews

PANORAMA = ("EQUIRECTANGULAR", (768.0, 384.0), 768, 384)
FISHEYE = ("OPENCV_FISHEYE", (110.0, 110.0, 180.0, 180.0, 0.03, -0.01, 0.005, -0.001), 360, 360)
EUCM = ("EUCM", (90.0, 90.0, 180.0, 180.0, 0.6, 1.1), 360, 360)


def views_of(camera):
    name, params, width, height = camera
    return WideViews.of(cameras.model(name), np.array(params), width, height)


@pytest.mark.parametrize(("camera", "count"), [(PANORAMA, 6), (FISHEYE, 5), (EUCM, 5)])
def test_every_pixel_is_in_one_view_and_comes_back(camera, count):
    views = views_of(camera)
    assert len(views) == count
    pixels = np.random.default_rng(0).uniform(3.0, np.array(camera[2:]) - 3.0, (2000, 2))
    rays = views.model.unproject(views.params, pixels)
    seen = np.isfinite(rays).all(axis=1)
    seen[seen] = np.abs(views.model.project(views.params, rays[seen]) - pixels[seen]).max(axis=1) < 1e-6
    pixels, rays = pixels[seen], rays[seen]
    own = np.stack([views.is_own(view, rays) for view in range(count)])
    shown = np.abs(rays).max(axis=1) == (rays @ views.view_from_cam[:, 2].T).max(axis=1)
    assert (own.sum(axis=0) == shown).all() and shown.mean() > 0.95
    for view in range(count):
        mine = rays[own[view]]
        flat = views.to_view(view, mine)
        assert (flat >= 0.0).all() and (flat <= views.view_size[view]).all()
        np.testing.assert_allclose(views.from_view(view, flat), mine, atol=1e-12)
        assert (views.view_of(mine) == view).all()
        source = views.source(view)
        assert source.shape == (*views.view_size[view][::-1], 2)
        row, column = (views.view_size[view][::-1] * [0.3, 0.6]).astype(int)
        ray = views.from_view(view, np.array([[column + 0.5, row + 0.5]]))
        expected = views.model.project(views.params, ray)[0]
        np.testing.assert_allclose(source[row, column] + 0.5, expected, atol=1e-3)


def test_what_a_plane_holds_has_no_views():
    assert views_of(("PINHOLE", (300.0, 300.0, 160.0, 120.0), 320, 240)) is None
    assert views_of(("OPENCV_FISHEYE", (250.0, 250.0, 160.0, 120.0, 0.0, 0.0, 0.0, 0.0), 320, 240)) is None
    assert views_of(("OPENCV_FISHEYE", (90.0, 90.0, 160.0, 120.0, 0.0, 0.0, 0.0, 0.0), 320, 240)) is not None


@pytest.mark.parametrize("camera", [PANORAMA, FISHEYE])
def test_segments_lie_on_the_edges_that_are_shown_as_closely_as_they_say(tmp_path, camera):
    scene, edges = _room.room(tmp_path, camera, count=1)
    views = views_of(camera)
    image = cv2.imread(str(tmp_path / "00.png"), cv2.IMREAD_GRAYSCALE)
    found = WideDetection.of(views).detect(LsdDetector(min_length=12.0), image)
    assert len(found) > 25
    off = _from_edges(scene, views, found, edges)
    matched = off < 2.0
    assert matched.mean() > 0.9
    assert np.median(off[matched] / found.sigma[matched]) < 1.5
    # the dark side is on the left: grey levels two pixels to either side of the middle, as the image has it
    middle, along = 0.5 * (found.ends[:, :2] + found.ends[:, 2:]), unit(found.ends[:, 2:] - found.ends[:, :2])
    short = np.hypot(*(found.ends[:, 2:] - found.ends[:, :2]).T) < 40.0  # hardly bent
    right = np.column_stack([-along[:, 1], along[:, 0]])
    grey = [_grey(image, middle[short] + side * 2.0 * right[short]) for side in (-1.0, 1.0)]
    assert (grey[1] > grey[0]).mean() > 0.9


def _from_edges(scene, views, found, edges):
    """Distances (N,) of segments from the nearest edge that may show there, pixels across it."""
    pose = scene.cam_from_world[0]
    local = (quaternion.rotate(pose[:4], edges.reshape(-1, 3)) + pose[4:]).reshape(-1, 2, 3)
    normal = unit(np.cross(local[:, 0], local[:, 1]))
    first, second = (views.model.unproject(views.params, found.ends[:, part]) for part in (slice(0, 2), slice(2, 4)))
    across = pixels_across(views.model, views.params, first, second)
    away = np.abs(np.stack([first @ normal.T, second @ normal.T], axis=-1) * across[:, None]).max(axis=-1)
    ends = unit(local)
    half = 0.5 * np.arccos((ends[:, 0] * ends[:, 1]).sum(axis=1))
    beside = np.arccos(np.clip(unit(first + second) @ unit(ends.sum(axis=1)).T, -1.0, 1.0)) > half + 0.02
    return np.where(beside, np.inf, away).min(axis=1)


def _grey(image, pixels):
    u, v = np.floor(pixels).astype(int).T
    return image[np.clip(v, 0, image.shape[0] - 1), u % image.shape[1]].astype(float)


def test_an_edge_across_the_border_of_a_panorama_goes_on():
    views = views_of(PANORAMA)
    back = int(np.flatnonzero(views.view_from_cam[:, 2, 2] < -0.5)[0])
    ends = np.array([[80.0, 100.0, 280.0, 110.0]])
    found = views.to_image(back, Segments.from_ends(ends))
    assert abs(found.ends[0, 2] - found.ends[0, 0]) < 0.4 * PANORAMA[2]
    rays = views.model.unproject(views.params, found.ends.reshape(2, 2))
    np.testing.assert_allclose(views.to_view(back, rays).ravel(), ends[0], atol=1e-9)


@pytest.mark.parametrize("camera", [pytest.param(PANORAMA, marks=pytest.mark.slow), FISHEYE])
def test_a_room_is_mapped(tmp_path, camera):
    scene, edges = _room.room(tmp_path / "images", camera, count=6)
    result = map_images(tmp_path / "images", tmp_path / "work", scene, MapOptions(threads=1))
    ends = result.scene.lines.segments
    assert len(ends) > 35
    places = ends[:, :1] + np.array([0.1, 0.5, 0.9])[:, None] * (ends[:, 1:] - ends[:, :1])
    away = _room.distance_to_edges(places.reshape(-1, 3), edges).reshape(-1, 3).max(axis=1)
    assert np.median(away) < 0.004 and np.mean(away < 0.02) > 0.9
    observed = result.scene.line_observations
    for line in range(result.scene.num_lines):
        assert len(np.unique(observed.image_idx[observed.line_idx == line])) >= 3
    # the poses were exact, and stay nearly so
    moved = np.linalg.norm(result.scene.cam_centers_in_world - scene.cam_centers_in_world, axis=1)
    assert moved.max() < 2e-3


def test_segments_of_views_are_told_of_their_images(tmp_path):
    """Lines from the exact images of edges: every observation is of the segment of its image, and of its line."""
    scene, edges = _room.room(tmp_path, PANORAMA, count=6, samples=1)
    views, edges = views_of(PANORAMA), edges[8:20]
    segments = [_seen(views, pose, edges) for pose in scene.cam_from_world]
    found = map_lines_in_views(scene, segments)
    assert found.num_lines >= 8
    assert [len(one) for one in found.outcomes] == [len(one) for one in segments]
    for line in range(found.num_lines):
        rows = found.line_idx == line
        assert found.num_images[line] == len(set(found.image_idx[rows].tolist())) >= 3
        assert set(found.segment_idx[rows].tolist()) == {found.segment_idx[rows][0]}  # an edge has one number here
    mapped = np.concatenate(found.outcomes) <= Outcome.RECOVERED
    first = np.cumsum([0, *(len(one) for one in segments)])
    np.testing.assert_array_equal(np.flatnonzero(mapped), np.sort(first[found.image_idx] + found.segment_idx))
    for image, near in enumerate(found.neighbors):
        assert image not in near
    with pytest.raises(InputError, match="images that a plane holds"):
        map_lines_in_views(scene, segments, matches={})


def _seen(views, pose, edges):
    """The images of the middle thirds of edges, whatever is before them."""
    places = edges[:, :1] + np.array([0.34, 0.66])[:, None] * (edges[:, 1:] - edges[:, :1])
    local = quaternion.rotate(pose[:4], places.reshape(-1, 3)) + pose[4:]
    pixels = views.model.project(views.params, local).reshape(-1, 2, 2)
    second = pixels[:, 0] + views.model.pixel_difference(views.params, pixels[:, 1], pixels[:, 0])
    return Segments.from_ends(np.hstack([pixels[:, 0], second]), 0.1)
