# SPDX-License-Identifier: BSD-3-Clause
"""Covers line triangulation: exact recovery by every estimator, invariance to origin, unit and scale, ragged batches
and their statuses, the optimality and the covariance of the maximum likelihood estimate."""

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.estimators import line_triangulation as lt
from groma.estimators.line_refinement import refine_lines
from groma.estimators.line_triangulation import TriangulationStatus
from groma.geometry import line3, projection, segment2

K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])


def look_at_origin(center):
    forward = -center / np.linalg.norm(center)
    right = np.cross([0.1, 1.0, 0.2], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return K @ np.hstack([rotation, -(rotation @ center)[:, None]])


def scene(seed, num_lines=60, num_cameras=8, fewest=2, noise=0.0):
    """Cameras around the origin, lines near it, two to all views of each."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(size=(num_cameras, 3))
    centers *= 6.0 / np.linalg.norm(centers, axis=1, keepdims=True)
    cameras = np.stack([look_at_origin(center) for center in centers])
    ends = rng.uniform(-1.5, 1.5, (num_lines, 2, 3))
    ends[:, 1] = ends[:, 0] + 2.0 * (ends[:, 1] - ends[:, 0]) / np.linalg.norm(
        ends[:, 1] - ends[:, 0], axis=1, keepdims=True
    )
    count = rng.integers(fewest, num_cameras + 1, num_lines)
    image_idx = np.concatenate([rng.choice(num_cameras, c, replace=False) for c in count])
    pointers = np.concatenate([[0], np.cumsum(count)])
    owner = np.repeat(np.arange(num_lines), count)
    homogeneous = np.concatenate([ends, np.ones((num_lines, 2, 1))], axis=2)
    image = np.einsum("mij,mej->mei", cameras[image_idx], homogeneous[owner])
    segments = (image[..., :2] / image[..., 2:]).reshape(-1, 4)
    segments = segments + noise * rng.normal(size=segments.shape)
    return cameras, centers, image_idx, segments, pointers, line3.from_points(ends[:, 0], ends[:, 1])


def planes_of(cameras, image_idx, segments):
    return projection.back_project_lines(cameras[image_idx], segment2.to_line(segments))


def test_two_planes():
    cameras, _, image_idx, segments, pointers, line = scene(1)
    planes = planes_of(cameras, image_idx, segments)
    result = lt.triangulate_two_planes(7.0 * planes[pointers[:-1]], -planes[pointers[:-1] + 1])
    good = result.status == TriangulationStatus.OK
    assert good.mean() > 0.85
    assert line3.same_line(result.line[good], line[good], 1e-9).all()
    normals = [
        planes[pointers[:-1] + i, :3] / np.linalg.norm(planes[pointers[:-1] + i, :3], axis=1)[:, None] for i in (0, 1)
    ]
    np.testing.assert_allclose(result.sine, np.linalg.norm(np.cross(*normals), axis=1), atol=1e-12)


@pytest.mark.parametrize("estimate", ["planes", "points", "plucker"])
@pytest.mark.parametrize(("offset", "unit"), [(0.0, 1.0), (1000.0, 1.0), (0.0, 1e4)])
def test_linear_estimators_recover_exact_lines(estimate, offset, unit):
    """Tolerance: rounding 1e-16 over the squared sine (0.1) and times the offset in units of the scene (1000)."""
    cameras, centers, image_idx, segments, pointers, line = scene(2)
    move = np.eye(4)
    move[:3, :3] *= 1.0 / unit
    move[:3, 3] = -offset / unit
    cameras = cameras @ move
    centers = unit * centers + offset
    line = np.hstack([unit * line[:, :3] + np.cross(np.full(3, offset), line[:, 3:]), line[:, 3:]])
    planes, centers = planes_of(cameras, image_idx, segments), centers[image_idx]
    if estimate == "plucker":
        result = lt.triangulate_plucker(planes, pointers, centers, min_sine=0.1)
    else:
        result = lt.triangulate_planes(planes, pointers, centers, pair=estimate, min_sine=0.1)
    good = result.status == TriangulationStatus.OK
    assert good.mean() > 0.85
    assert line3.same_line(result.line[good], line[good], 1e-7).all()
    assert (result.residual[good] < 1e-7).all()


def test_both_singular_pairs_are_one_line_under_noise():
    cameras, centers, image_idx, segments, pointers, _ = scene(3, noise=1.0)
    planes, centers = planes_of(cameras, image_idx, segments), centers[image_idx]
    weights = segment2.length(segments)
    first, second = (lt.triangulate_planes(planes, pointers, centers, weights, pair=p) for p in ("planes", "points"))
    good = first.status == TriangulationStatus.OK
    assert line3.same_line(first.line[good], second.line[good], 1e-8).all()


def test_stacking_image_forms_leaves_a_pencil_in_two_views():
    """The form of Bartoli and Sturm has rank 4 for two views, 5 from three on; L pi = 0 has rank 5 from two on."""
    cameras, _, image_idx, segments, pointers, line = scene(4, fewest=3)
    start = pointers[0]
    lines = segment2.to_line(segments)
    blocks, incidence_blocks = [], []
    for i in range(start, start + 3):
        P = cameras[image_idx[i]]
        a, b, c = lines[i]
        hat = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        blocks.append(hat @ projection.line_projection_matrix(P))
        plane = P.T @ lines[i]
        incidence_blocks.append((line3.primal_matrix(np.eye(6)) @ plane).T)
    for count, expected in ((2, 4), (3, 5)):
        values = np.linalg.svd(np.concatenate([b / np.abs(b).max() for b in blocks[:count]]), compute_uv=False)
        assert np.sum(values > 1e-9 * values[0]) == expected
    two = np.concatenate([b / np.abs(b).max() for b in incidence_blocks[:2]])
    values, vectors = np.linalg.svd(two)[1:]
    assert np.sum(values > 1e-9 * values[0]) == 5
    assert line3.same_line(vectors[-1], line[0], 1e-7)


def test_refinement_reaches_the_minimum_of_the_pixel_distances():
    cameras, _, image_idx, segments, pointers, line = scene(5, fewest=4, noise=0.7)
    result = refine_lines(line, cameras, image_idx, segments, pointers)
    assert (result.status == TriangulationStatus.OK).all()
    assert (result.iterations <= 12).all()
    owner = np.repeat(np.arange(len(line)), np.diff(pointers))

    def cost(lines):
        image = projection.normalize_image_lines(projection.project_lines(cameras[image_idx], lines[owner]))
        ends = np.concatenate([segments.reshape(-1, 2, 2), np.ones((len(segments), 2, 1))], axis=2)
        return np.bincount(owner, np.sum(np.einsum("mej,mj->me", ends, image) ** 2, axis=1))

    lowest = cost(result.line)
    np.testing.assert_allclose(result.residual, np.sqrt(lowest / (2 * np.diff(pointers))), rtol=1e-8)
    rng = np.random.default_rng(0)
    for size in (1e-2, 1e-4):
        for _ in range(20):
            moved = line3.closest_line(result.line + size * rng.normal(size=line.shape))
            # rounding of the cost, and the gradient left when a step lowers it by less than 1e-10
            assert (cost(moved) >= lowest * (1 - 1e-9)).all()


def test_refinement_converges_from_a_poor_start_and_does_not_depend_on_the_frame():
    cameras, _, image_idx, segments, pointers, line = scene(6, fewest=4, noise=0.3)
    rng = np.random.default_rng(1)
    best = refine_lines(line, cameras, image_idx, segments, pointers)
    start = line3.closest_line(line3.normalize(line) + 0.1 * rng.normal(size=line.shape))
    found = refine_lines(start, cameras, image_idx, segments, pointers)
    assert line3.same_line(found.line, best.line, 1e-5).mean() > 0.95
    move = np.eye(4)
    move[:3, 3] = -500.0
    shifted = np.hstack([line[:, :3] + np.cross(np.full(3, 500.0), line[:, 3:]), line[:, 3:]])
    far = refine_lines(shifted, cameras @ move, image_idx, segments, pointers)
    np.testing.assert_allclose(far.residual, best.residual, rtol=1e-6)


def test_covariance_predicts_the_spread():
    """300 noisy copies of each of 5 lines. The mean of chi squared, 4 degrees of freedom, has standard deviation
    sqrt(8 / 1500) = 0.073; five of them are allowed, and the second order of the noise is far below."""
    copies, noise = 300, 0.5
    cameras, _, image_idx, segments, pointers, line = scene(7, num_lines=5, fewest=5)
    rng = np.random.default_rng(2)
    counts = np.tile(np.diff(pointers), copies)
    noisy = np.tile(segments, (copies, 1))
    # only the offset across the line matters: the distance of the end points has this standard deviation
    noisy = noisy + noise * rng.normal(size=noisy.shape)
    truth = line3.normalize(np.tile(line, (copies, 1)))
    result = refine_lines(
        truth,
        cameras,
        np.tile(image_idx, copies),
        noisy,
        np.concatenate([[0], np.cumsum(counts)]),
        weights=np.full(len(noisy), 1.0 / noise),
        with_covariance=True,
    )
    covariance = result.covariance
    assert covariance.shape == (5 * copies, 6, 6)
    values = np.linalg.eigvalsh(covariance)
    assert (values[:, 1] < 1e-9 * values[:, 5]).all() and (values[:, 2] > 0).all()
    error = result.line - truth * np.sign(np.sum(result.line[:, 3:] * truth[:, 3:], axis=1))[:, None]
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.pinv(covariance, rcond=1e-9, hermitian=True), error)
    assert abs(chi2.mean() - 4.0) < 5 * np.sqrt(8 / len(chi2))


def test_chain_on_noisy_segments():
    cameras, _, image_idx, segments, pointers, line = scene(8, num_lines=200, fewest=3, noise=0.3)
    result = lt.triangulate_lines(cameras, image_idx, segments, pointers, with_covariance=True)
    good = result.status == TriangulationStatus.OK
    assert good.mean() > 0.9
    # 4 of 2n numbers are spent on the line: the expected mean square is (1 - 2/n) 0.3^2
    expected = 0.3**2 * np.mean(1 - 2 / np.diff(pointers)[good])
    assert np.mean(result.residual[good] ** 2) == pytest.approx(expected, rel=0.1)
    cosine = np.abs(np.sum(result.line[:, 3:] * line3.normalize(line)[:, 3:], axis=1))[good]
    # 0.3 px over a segment of about 150 px is 3 mrad; over the sine of the planes, a few times that
    assert np.median(np.arccos(np.clip(cosine, 0, 1))) < 0.01


def test_statuses_in_one_ragged_batch():
    cameras, _, image_idx, segments, _, line = scene(9, num_lines=1, num_cameras=6, fewest=6)
    nan = np.full((2, 4), np.nan)
    parts = [  # (image indices, segments)
        (image_idx, segments),  # OK
        (image_idx[:0], segments[:0]),  # no observation
        (image_idx[:1], segments[:1]),  # one
        (image_idx[:3], np.vstack([segments[:1], nan])),  # one that is finite
        (image_idx[[0, 0]], segments[[0, 0]]),  # the same view twice
        (image_idx, np.vstack([segments[:4], nan])),  # four that are finite
    ]
    images, measured = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    pointers = np.concatenate([[0], np.cumsum([len(part[0]) for part in parts])])
    result = lt.triangulate_lines(cameras, images, measured, pointers)
    expected = [
        TriangulationStatus.OK,
        TriangulationStatus.TOO_FEW_VIEWS,
        TriangulationStatus.TOO_FEW_VIEWS,
        TriangulationStatus.TOO_FEW_VIEWS,
        TriangulationStatus.DEGENERATE_BASELINE,
        TriangulationStatus.OK,
    ]
    np.testing.assert_array_equal(result.status, expected)
    assert line3.same_line(result.line[[0, 5]], line, 1e-8).all()
    np.testing.assert_array_equal(result.line[1:4], 0.0)
    assert np.isfinite(result.line).all() and np.isfinite(result.residual).all()


def test_lines_behind_the_cameras_are_marked():
    """Cameras turned to look the other way have the same planes: only the depths differ."""
    cameras, _, image_idx, segments, pointers, _ = scene(10, num_lines=20, num_cameras=4, fewest=4)
    flipped = K @ np.stack([np.hstack([_flip(P[:, :3]), _flip(P[:, 3:])]) for P in np.linalg.inv(K) @ cameras])
    result = lt.triangulate_lines(flipped, image_idx, _mirror(segments), pointers)
    seen = result.status != TriangulationStatus.DEGENERATE_BASELINE
    assert seen.mean() > 0.7
    assert (result.status[seen] == TriangulationStatus.BEHIND_CAMERA).all()


def _flip(columns):
    """Turn the camera by pi about its y axis: x and z change sign."""
    return np.diag([-1.0, 1.0, -1.0]) @ columns


def _mirror(segments):
    """Pixels of the same points in the turned camera: x/z keeps its sign, y/z changes it (fx = fy)."""
    return np.column_stack([segments[:, 0], 480 - segments[:, 1], segments[:, 2], 480 - segments[:, 3]])


def test_empty_batches_and_unchanged_arguments():
    cameras, _, image_idx, segments, pointers, _ = scene(11)
    before = segments.copy()
    lt.triangulate_lines(cameras, image_idx, segments, pointers)
    np.testing.assert_array_equal(segments, before)
    empty = lt.triangulate_lines(cameras, np.zeros(0, dtype=int), np.zeros((0, 4)), np.array([0]), with_covariance=True)
    assert empty.line.shape == (0, 6) and empty.covariance.shape == (0, 6, 6)
    assert lt.triangulate_two_planes(np.zeros((0, 4)), np.zeros((0, 4))).line.shape == (0, 6)


def test_errors_say_what_to_do():
    cameras, centers, image_idx, segments, pointers, line = scene(12)
    planes, centers = planes_of(cameras, image_idx, segments), centers[image_idx]
    with pytest.raises(InputError, match="Sort the observations"):
        lt.triangulate_planes(planes, pointers[:-1], centers)
    with pytest.raises(InputError, match="pair must be"):
        lt.triangulate_planes(planes, pointers, centers, pair="lines")
    with pytest.raises(ShapeError, match="weights"):
        lt.triangulate_planes(planes, pointers, centers, np.ones(3))
    with pytest.raises(InputError, match="image_idx must lie in 0 to 7"):
        lt.triangulate_lines(cameras, image_idx + 5, segments, pointers)
    with pytest.raises(ShapeError, match="one row per pointer pair"):
        refine_lines(line[:-1], cameras, image_idx, segments, pointers)
