# SPDX-License-Identifier: BSD-3-Clause
"""Planes and normals of depth images: exact planes, covariance against many noise draws, holes, what must not be
joined, empty and hostile images; the number of planes in real images.
"""

import numpy as np
import pytest
from _depth_scenes import FLOOR, PINHOLE, SHAPE, WALL, noisy, plane, render

from groma.errors import InputError, ShapeError
from groma.features.depth.noise import DepthNoise
from groma.features.depth.planes import PlaneSearchOptions, find_depth_planes
from groma.geometry.charts.plane_normal_offset import NormalOffsetPlane
from groma.io.sequences import open_sequence

pytestmark = pytest.mark.kernels
#: Nothing in common between pixels, so that errors are those of white noise.
NOISE = DepthNoise(tilt=0.0, shift=0.0)


def matched(found, truth):
    """Row of each true plane among those found, by the normal."""
    return [int(np.argmax(found.planes[:, :3] @ p[:3])) for p in truth]


def test_exact_planes_are_found_exactly():
    depth, label = render([FLOOR, WALL])
    found = find_depth_planes(depth, PINHOLE, NOISE)
    assert len(found) == 2
    rows = matched(found, [FLOOR, WALL])
    np.testing.assert_allclose(found.planes[rows], [FLOOR, WALL], rtol=0, atol=1e-6)  # depth has 24 bits
    seen = found.labels[label[1::2, 1::2] == 0]
    assert (seen == rows[0]).mean() > 0.98  # the crease is open to both
    assert found.labels.shape == (60, 80)
    assert found.num_samples.sum() == (found.labels >= 0).sum()
    assert (found.planes[:, 3] > 0).all()
    on_plane = np.einsum("kj,kj->k", found.planes[:, :3], found.centers) + found.planes[:, 3]
    assert np.abs(on_plane).max() < 0.02


@pytest.mark.compiled
@pytest.mark.parametrize("step", [1, 2])
def test_covariance_is_that_of_the_errors(step):
    rng = np.random.default_rng(5)
    depth, _ = render([FLOOR, WALL])
    chart, total, spread, draws = NormalOffsetPlane(), [], [], 24
    for _ in range(draws):
        found = find_depth_planes(noisy(depth, NOISE, rng), PINHOLE, NOISE, PlaneSearchOptions(step=step))
        rows = matched(found, [FLOOR, WALL])
        errors = chart.local(found.planes[rows], np.array([FLOOR, WALL]))
        total += [e @ np.linalg.solve(c, e) for e, c in zip(errors, found.covariances[rows], strict=True)]
        spread += list(found.reduced_chi_square[rows])
    # 2 * 24 * 3 = 144 degrees of freedom: the mean is 3, with a standard deviation of 0.35.
    assert 2.1 < np.mean(total) < 4.1
    assert 0.9 < np.mean(spread) < 1.1


def test_the_two_forms_of_the_covariance_agree():
    found = find_depth_planes(render([FLOOR, WALL])[0], PINHOLE, NOISE)
    basis = NormalOffsetPlane().basis(found.planes)
    np.testing.assert_allclose(
        basis @ found.covariances @ basis.transpose(0, 2, 1), found.covariances_hesse, rtol=0, atol=1e-12
    )


def test_errors_common_to_all_pixels_are_about_the_middle():
    depth = render([FLOOR, WALL])[0]
    white = find_depth_planes(depth, PINHOLE, NOISE)
    real = find_depth_planes(depth, PINHOLE, DepthNoise(tilt=0.01, shift=0.02))
    more = real.covariances_hesse - white.covariances_hesse
    for normal, middle, covariance in zip(real.planes[:, :3], real.centers, more, strict=True):
        # The distance of a point at the middle is uncertain by the shift; one beside it by the tilt too.
        beside = np.cross(normal, [1.0, 0.0, 0.0])
        beside *= 2.0 / np.linalg.norm(beside)
        for point, variance in ((middle, 0.02**2), (middle + beside, 0.02**2 + (2.0 * 0.01) ** 2)):
            at = np.append(point, 1.0)
            np.testing.assert_allclose(at @ covariance @ at, variance, rtol=1e-9)


def test_holes_of_ninety_percent():
    rng = np.random.default_rng(3)
    depth = noisy(render([FLOOR, WALL])[0], NOISE, rng)
    depth[rng.random(SHAPE) < 0.9] = 0.0
    found = find_depth_planes(depth, PINHOLE, NOISE)
    assert (len(found), found.step) == (2, 1)
    rows = matched(found, [FLOOR, WALL])
    errors = NormalOffsetPlane().local(found.planes[rows], np.array([FLOOR, WALL]))
    assert np.abs(errors[:, :2]).max() < 0.02
    assert np.abs(errors[:, 2]).max() < 0.02
    # A hole that leaves only the top of the image.
    depth = noisy(render([FLOOR, WALL])[0], NOISE, rng)
    depth[12:] = 0.0
    found = find_depth_planes(depth, PINHOLE, NOISE)
    assert len(found) == 1
    assert np.abs(NormalOffsetPlane().local(found.planes, WALL[None])).max() < 0.05


def test_a_step_and_an_angle_keep_planes_apart():
    step = [plane([0, 0, -1.0], 1.0), plane([0, 0, -1.0], 1.06)]
    depth, _ = render([step[0]])
    depth[:, 80:] = 1.06
    found = find_depth_planes(noisy(depth, NOISE, np.random.default_rng(0)), PINHOLE, NOISE)
    assert len(found) == 2
    np.testing.assert_allclose(np.sort(found.planes[:, 3]), [1.0, 1.06], atol=0.003)
    # A roof of 150 degrees.
    roof = [plane([0.26, 0, -1.0], 1.0), plane([-0.26, 0, -1.0], 1.0)]
    depth, _ = render(roof)
    assert len(find_depth_planes(noisy(depth, NOISE, np.random.default_rng(0)), PINHOLE, NOISE)) == 2


def test_one_plane_behind_an_obstacle_is_one():
    depth, _ = render([WALL])
    depth[:, 70:90] = 0.9
    found = find_depth_planes(noisy(depth, NOISE, np.random.default_rng(1)), PINHOLE, NOISE)
    assert len(found) == 2
    row = matched(found, [WALL])[0]
    assert (found.labels[:, :34] == row).mean() > 0.95
    assert (found.labels[:, 46:] == row).mean() > 0.95


def test_noise_without_surface_gives_no_plane():
    rng = np.random.default_rng(0)
    assert len(find_depth_planes(rng.uniform(0.5, 4.0, SHAPE), PINHOLE, NOISE)) == 0
    for empty in (np.zeros(SHAPE), np.full(SHAPE, np.nan), np.full(SHAPE, -1.0), np.full(SHAPE, 99.0)):
        found = find_depth_planes(empty, PINHOLE, NOISE)
        assert len(found) == 0
        assert found.planes.shape == (0, 4)
        assert found.covariances.shape == (0, 3, 3)
        assert (found.labels == -1).all()
    found = find_depth_planes(np.ones((7, 5), np.float32), PINHOLE, NOISE)
    assert found.labels.shape == (4, 3)


def test_arguments_are_checked():
    with pytest.raises(ShapeError, match="floating-point image"):
        find_depth_planes(np.ones(SHAPE, np.uint16), PINHOLE)
    with pytest.raises(ShapeError, match="fx, fy, cx, cy"):
        find_depth_planes(np.ones(SHAPE), [1.0, 2.0])
    with pytest.raises(InputError, match="step"):
        PlaneSearchOptions(step=0)
    with pytest.raises(InputError, match="correlation"):
        DepthNoise(correlation=0.5)


@pytest.mark.shared
@pytest.mark.parametrize(("name", "few", "many"), [("rgbd_tum_fr3_cabinet", 3, 9), ("rgbd_7scenes_redkitchen", 6, 16)])
def test_real_images_consist_of_few_planes(shared_data, name, few, many):
    sequence = open_sequence(shared_data / name, stride=20)
    for frame in sequence:
        found = find_depth_planes(frame.depth, sequence.camera.params)
        assert few <= len(found) <= many
        assert (found.labels >= 0).sum() > 0.65 * (frame.depth[1::2, 1::2] > 0).sum()
