# SPDX-License-Identifier: BSD-3-Clause
"""Vanishing points of rendered segments under several cameras, their noise, and agreement across images."""

import numpy as np
import pytest

from groma.cameras import model as camera_model
from groma.errors import ShapeError
from groma.features.vanishing_points import find_vanishing_points, segment_normals
from groma.geometry import quaternion

pytestmark = pytest.mark.kernels

CAMERAS = {
    "PINHOLE": np.array([800.0, 820.0, 500.0, 400.0]),
    "OPENCV_FISHEYE": np.array([400.0, 400.0, 500.0, 400.0, 0.02, -0.01, 0.0, 0.0]),
}


def picture(rng, pose, model, params, axes, each, clutter, sigma):
    """Segments (N, 4) of 3D segments along the axes, and random ones, with noise across them; their axes."""
    labels = np.repeat(np.append(np.arange(len(axes)), -1), [*[each] * len(axes), clutter])
    direction = np.where(labels[:, None] >= 0, axes[labels], rng.normal(size=(len(labels), 3)))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = rng.uniform(-2, 2, (len(labels), 3))
    ends = middle[:, None] + np.array([-0.4, 0.4])[:, None] * direction[:, None]
    in_cam = quaternion.rotate(pose[None, None, :4], ends) + pose[4:]
    pixels = np.stack([model.project(params, np.ascontiguousarray(in_cam[:, k])) for k in (0, 1)], axis=1)
    along = pixels[:, 1] - pixels[:, 0]
    length = np.linalg.norm(along, axis=1)
    across = np.stack([-along[:, 1], along[:, 0]], axis=1) / length[:, None]
    noisy = pixels + sigma * rng.normal(size=(len(labels), 2, 1)) * across[:, None]
    kept = (in_cam[..., 2] > 0.5).all(axis=1) & (length > 25)
    return noisy.reshape(-1, 4)[kept], labels[kept]


def pose_at(turn, distance=6.0):
    return np.concatenate([quaternion.exp(np.asarray(turn, float)), [0.0, 0.0, distance]])


@pytest.mark.parametrize("name", sorted(CAMERAS))
def test_three_axes_are_found(name):
    rng = np.random.default_rng(1)
    model, params, pose = camera_model(name), CAMERAS[name], pose_at([0.4, -0.5, 0.2])
    segments, labels = picture(rng, pose, model, params, np.eye(3), 40, 30, 0.3)
    found = find_vanishing_points(segments, 0.3, model, params)
    axes = quaternion.rotate(pose[None, :4], np.eye(3))
    assert len(found) == 3
    cosine = np.abs(found.directions @ axes.T)
    spread = np.sqrt(np.linalg.eigvalsh(found.covariance)[:, -1])
    # Within four standard deviations, and these are below half a degree.
    assert (np.arccos(np.clip(cosine.max(axis=1), 0, 1)) < 4 * spread).all()
    assert spread.max() < 0.01
    assert len(found.orthogonal) == 3
    assert (found.directions[:, 2] >= 0).all()
    owner = cosine.argmax(axis=1)
    right = owner[found.label[(found.label >= 0) & (labels >= 0)]] == labels[(found.label >= 0) & (labels >= 0)]
    assert right.mean() > 0.9
    assert (found.label[labels >= 0] >= 0).mean() > 0.85
    pixels = found.pixels(model, params)
    assert pixels.shape == (3, 2)
    seen = np.isfinite(pixels).all(axis=1)
    back = model.unproject(params, np.ascontiguousarray(pixels[seen]))
    usable = np.isfinite(back).all(axis=1)
    assert np.abs(np.cross(back[usable], found.directions[seen][usable])).max() < 1e-6


def test_normals_are_as_uncertain_as_they_say():
    rng = np.random.default_rng(2)
    model, params = camera_model("PINHOLE"), CAMERAS["PINHOLE"]
    exact = np.array([200.0, 300.0, 330.0, 390.0])
    across = np.array([-90.0, 130.0]) / np.hypot(90, 130)
    draws = exact + 0.5 * np.hstack([rng.normal(size=(4000, 1)) * across, rng.normal(size=(4000, 1)) * across])
    normals, _ = segment_normals(draws, 0.5, model, params)
    _, factors = segment_normals(exact[None], 0.5, model, params)
    sampled = np.cov(normals.T)
    # 4000 draws fix variances to 2 %; second-order terms are far below.
    assert np.abs(sampled - factors[0] @ factors[0].T).max() < 0.08 * np.abs(sampled).max()


def test_degenerate_segments_take_no_part():
    model, params = camera_model("PINHOLE"), CAMERAS["PINHOLE"]
    segments = np.array([[100.0, 100, 100, 100], [10, 10, 60, 80]])
    normals, factors = segment_normals(segments, np.array([0.3, 0.0]), model, params)
    assert (normals == 0).all() and (factors == 0).all()
    found = find_vanishing_points(segments, 0.3, model, params)
    assert len(found) == 0 and found.label.tolist() == [-1, -1]
    nothing = find_vanishing_points(np.zeros((0, 4)), 0.3, model, params)
    assert len(nothing) == 0


def test_bad_input():
    model, params = camera_model("PINHOLE"), CAMERAS["PINHOLE"]
    with pytest.raises(ShapeError, match="sigma"):
        segment_normals(np.zeros((3, 4)), np.ones(2), model, params)
