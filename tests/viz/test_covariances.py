# SPDX-License-Identifier: BSD-3-Clause
"""Covariances for the page: read as they were written, matched by name, moved with the origin."""

import numpy as np
import pytest
from _scene import exact_scene

from groma.adjustment.covariance_files import write_covariances
from groma.adjustment.uncertainty import uncertainty
from groma.errors import FileFormatError, InputError
from groma.scene import Similarity
from groma.scene.synthetic.scenes import holistic
from groma.viz.report.covariances import LandmarkCovariances, centers_of_images, read_covariances


@pytest.fixture(scope="module")
def scene():
    return holistic(8, seed=3).truth


@pytest.fixture(scope="module")
def found(scene):
    return uncertainty(scene)


def test_files_are_read_as_they_were_written(tmp_path, scene, found):
    write_covariances(tmp_path / "c.npz", scene, found)
    read = read_covariances(tmp_path / "c.npz", scene)
    for name in ("points", "lines", "planes"):
        np.testing.assert_array_equal(getattr(read, name), getattr(found, name))
    centers = centers_of_images(scene, found.centers, scene.images.frame_idx)
    np.testing.assert_array_equal(read.centers, centers)
    assert np.isfinite(read.lines).all() and read.centers.shape == (scene.num_images, 3, 3)


def test_landmarks_are_matched_by_their_identifiers(tmp_path, scene, found):
    """A scene with fewer landmarks in it than the file, and with one that the file does not know."""
    write_covariances(tmp_path / "c.npz", scene, found)
    kept = np.arange(scene.num_lines) % 3 != 1
    ids = scene.lines.ids[kept].copy()
    ids[0] = 10**6
    fewer = scene.keep(lines=kept)
    fewer = fewer.replace(lines=fewer.lines.replace(ids=ids))
    read = read_covariances(tmp_path / "c.npz", fewer)
    assert np.isnan(read.lines[0]).all()
    np.testing.assert_array_equal(read.lines[1:], found.lines[kept][1:])


def test_covariances_move_with_the_origin(scene):
    """Against random lines and planes whose coordinates are shifted one by one."""
    rng = np.random.default_rng(1)
    offset = np.array([3.0, -20.0, 7.0])
    root = rng.normal(size=(6, 6))
    moments = 1e-3 * rng.normal(size=(200_000, 6)) @ root
    line = moments + np.concatenate([np.cross([1.0, 2, 3], [0, 0.6, 0.8]), [0, 0.6, 0.8]])
    moved = np.concatenate([line[:, :3] - np.cross(offset, line[:, 3:]), line[:, 3:]], axis=1)
    planes = moments[:, :4] + np.array([0, 0, 1.0, 4.0])
    shifted = np.concatenate([planes[:, :3], (planes[:, 3] + planes[:, :3] @ offset)[:, None]], axis=1)
    before = LandmarkCovariances("", np.eye(3)[None], np.cov(line.T)[None], np.cov(planes.T)[None], np.eye(3)[None])
    after = before.moved(offset)
    np.testing.assert_allclose(after.lines[0], np.cov(moved.T), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(after.planes[0], np.cov(shifted.T), rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(after.points, before.points)
    # The moment that the page uses is that of the scene moved by the offset.
    gone = scene.transformed(Similarity(1.0, np.eye(3), -offset))
    expected = scene.lines.plucker[:, :3] - np.cross(offset, scene.lines.plucker[:, 3:])
    np.testing.assert_allclose(gone.lines.plucker[:, :3], expected, atol=1e-9)


def test_other_files_are_refused(tmp_path, scene, found):
    write_covariances(tmp_path / "c.npz", scene, found)
    write_covariances(tmp_path / "c.json", scene, found)
    with pytest.raises(InputError, match=r"\.npz"):
        read_covariances(tmp_path / "c.json", scene)
    np.savez(tmp_path / "other.npz", points=np.zeros((2, 3)))
    with pytest.raises(FileFormatError, match=r"missing|shape"):
        read_covariances(tmp_path / "other.npz", scene)
    strange = exact_scene(("x.jpg", "y.jpg"))
    strange = strange.keep(planes=[]).replace(
        points=strange.points.replace(ids=strange.points.ids + 10**7),
        lines=strange.lines.replace(ids=strange.lines.ids + 10**7),
    )
    with pytest.raises(InputError, match="none of the landmarks"):
        read_covariances(tmp_path / "c.npz", strange)
