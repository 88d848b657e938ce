# SPDX-License-Identifier: BSD-3-Clause
"""Planes: fit and covariance, search among clutter and in large scenes, connectedness, segments, membership."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from groma.errors import InputError, ShapeError
from groma.estimators import plane_search
from groma.estimators._plane_candidates import features_of, from_planes
from groma.estimators.association import inlier_probability
from groma.estimators.plane_fit import fit_plane, tilt_sigma
from groma.estimators.plane_search import PlaneOptions, PlaneSearch, find_planes
from groma.execution import work_with

SIGMA = 0.01


def wall(rng, count, normal_axis, offset, size=4.0, shift=(0.0, 0.0)):
    """Points with noise SIGMA on a square wall across an axis."""
    points = np.insert(rng.uniform(0, size, (count, 2)) + shift, normal_axis, offset, axis=1)
    return points + rng.normal(0, SIGMA, points.shape)


def noise_of(points):
    return np.broadcast_to(SIGMA**2 * np.eye(3), (len(points), 3, 3))


@pytest.mark.kernels
def test_fit_and_its_covariance():
    """Errors of the fit in its three degrees of freedom, whitened by its covariance, have mean square 3."""
    truth = np.array([2.0, -1.0, 2.0, 0.6]) / 3.0
    basis = np.linalg.svd(truth[None, :3])[2][1:]
    squared, chi = [], []
    for seed in range(80):
        rng = np.random.default_rng([1, seed])
        exact = rng.uniform(-2, 2, (30, 2)) @ basis - truth[3] * truth[:3] + 3.0 * basis[0]
        spread = rng.uniform(0.5, 3.0, (30, 3)) * SIGMA
        noise = np.einsum("ni,ij->nij", spread**2, np.eye(3))
        fit = fit_plane(exact + spread * rng.normal(size=(30, 3)), noise)
        plane = fit.plane * np.sign(fit.plane[:3] @ truth[:3])
        squared.append((plane - truth) @ np.linalg.pinv(fit.covariance, rcond=1e-9) @ (plane - truth))
        chi.append(fit.reduced_chi_square)
    # Standard deviation of the mean of 80: sqrt(6 / 80) = 0.27.
    assert np.mean(squared) == pytest.approx(3.0, abs=0.8)
    assert np.mean(chi) == pytest.approx(1.0, abs=0.1)


@pytest.mark.kernels
def test_fit_of_points_on_a_line_leaves_a_tilt_open():
    points = np.outer(np.linspace(0, 1, 20), [1.0, 2.0, 0.5])
    assert tilt_sigma(fit_plane(points, noise_of(points)).covariance) > 1.0


@pytest.mark.kernels
def test_points_at_one_place_leave_both_tilts_open_and_certain_ones_are_refused():
    """Of both numbers come out, or one line that says what to do."""
    points = np.ones((5, 3))
    covariance = fit_plane(points, noise_of(points)).covariance
    assert np.isfinite(covariance).all() and tilt_sigma(covariance) > 1.0
    with pytest.raises(InputError, match="positive trace"):
        fit_plane(np.eye(3), np.zeros((3, 3, 3)))


def test_walls_among_clutter():
    rng = np.random.default_rng(2)
    walls = [wall(rng, 300, 0, 0.0), wall(rng, 300, 1, 0.0), wall(rng, 200, 2, 0.0)]
    clutter = rng.uniform(0.5, 4, (300, 3))
    points = np.concatenate([*walls, clutter])
    found = find_planes(points, noise_of(points))
    assert len(found) == 3
    assert sorted(np.abs(found.planes[:, :3]).argmax(axis=1)) == [0, 1, 2]
    # The walls go through the origin: offsets within four standard deviations, which are below 0.3 noises.
    offset_sigma = np.sqrt(found.covariance[:, 3, 3])
    assert (np.abs(found.planes[:, 3]) < 4 * offset_sigma).all()
    assert offset_sigma.max() < 0.3 * SIGMA
    assert tilt_sigma(found.covariance).max() < 1e-3
    assert found.share.min() > 0.7
    label = found.point_label
    assert all(np.bincount(label[300 * k : 300 * k + 200] + 1).max() > 190 for k in range(2))
    assert (label[800:] >= 0).mean() < 0.15


def test_others_are_found_beside_planes_that_are_known():
    rng = np.random.default_rng(2)
    points = np.concatenate([wall(rng, 300, 0, 0.0), wall(rng, 300, 1, 0.0), wall(rng, 200, 2, 0.0)])
    found = find_planes(points, noise_of(points))
    known = found.take(np.array([1]), np.array([-1, 0, -1]))
    again = find_planes(points, noise_of(points), known=known)
    assert len(found) == len(again) == 3
    np.testing.assert_array_equal(again.planes[0], found.planes[1])
    assert (again.point_label == 0)[known.point_label == 0].all()
    assert sorted(np.abs(again.planes[:, :3]).argmax(axis=1)) == [0, 1, 2]


def test_planes_are_searched_again_only_where_features_have_become_free():
    rng = np.random.default_rng(2)
    walls = [wall(rng, 300, 0, 0.0), wall(rng, 300, 1, 0.0), wall(rng, 200, 2, 0.0)]
    points, tried = np.concatenate([*walls, rng.uniform(0.5, 4, (300, 3))]), []
    search = PlaneSearch(points, noise_of(points))

    def candidates(known=None):
        tried.append(0)
        return search.planes(known, lambda done, total: tried.__setitem__(-1, total))

    found = candidates()
    same = candidates(found)
    np.testing.assert_array_equal(same.planes, found.planes)
    np.testing.assert_array_equal(same.point_label, found.point_label)
    again = candidates(found.take(np.array([0, 1]), np.array([0, 1, -1])))
    assert len(again) == 3
    np.testing.assert_allclose(again.planes[2], found.planes[2], atol=SIGMA)
    first, second, third = tried
    assert second == 0 and 0 < third < 0.5 * first  # 200 features in 1,100 are free again


def test_no_plane_in_clutter_and_none_in_a_blob():
    rng = np.random.default_rng(3)
    cloud = rng.uniform(0, 4, (600, 3))
    assert len(find_planes(cloud, noise_of(cloud))) == 0
    blob = rng.normal(0, 10 * SIGMA, (400, 3))
    assert len(find_planes(blob, noise_of(blob))) == 0


def test_a_layer_filled_evenly_has_no_plane():
    """Relief of 16 sigma, as of gravel: one plane or two were found in each, of a third of it, by its own chance."""
    found = 0
    for seed in range(16):
        rng = np.random.default_rng([6, seed])
        relief = rng.uniform([0.0, 0.0, -8.0 * SIGMA], [4.0, 4.0, 8.0 * SIGMA], (40 + 20 * (seed % 4), 3))
        relief += rng.normal(0.0, SIGMA, relief.shape)
        found += len(find_planes(relief, noise_of(relief)))
    # One in 10,000 of the hundreds of planes that are tried in each: some 5 % of 16.
    assert found <= 2


def body(seed):
    """Points of an ellipsoid with radii of 200 to 500 sigma."""
    rng = np.random.default_rng([7, seed])
    u = rng.normal(size=(1500 + 500 * (seed % 4), 3))
    points = u / np.linalg.norm(u, axis=1, keepdims=True) * [5.0, 2.0 + seed // 2, 5.0]
    return points + rng.normal(0.0, SIGMA, points.shape)


@pytest.mark.parametrize("rough", [4.5, 7.0, 10.0])
def test_a_rough_wall_has_one_plane(rough):
    """One that is as rough as ten times the noise; its normal is right to four deviations of its fit."""
    rng = np.random.default_rng(12)
    points = wall(rng, 800, 2, 1.0, size=40.0)
    points[:, 2] += rough * SIGMA * rng.standard_normal(800)
    found = find_planes(points, noise_of(points))
    assert len(found) == 1 and (found.point_label == 0).mean() > 0.9
    # The spread of an even square is its side over root twelve.
    assert abs(found.planes[0, 2]) > np.cos(4.0 * rough * SIGMA * np.sqrt(12.0 / 800.0) / 40.0)


def test_no_rough_plane_through_steps():
    """Each tread has its plane; the slope through all of them has none of its own."""
    rng = np.random.default_rng(14)
    points = np.concatenate([wall(rng, 150, 2, 0.15 * k, 1.0, (0.0, 1.0 * k)) for k in range(6)])
    found = find_planes(points, noise_of(points))
    assert len(found) == 6 and (np.abs(found.planes[:, 2]) > np.cos(0.05)).all()


def stairs(seed, num=8, points=15):
    """Points on treads and risers, few on each, and the edges between them; and their covariance."""
    rng, faces, edges = np.random.default_rng(seed), [], []
    for k in range(num):
        for start, along in (([0.0, 0.28 * k, 0.17 * k], [0.28, 0.0]), ([0.0, 0.28 * k, 0.17 * (k - 1)], [0.0, 0.17])):
            faces.append(start + np.column_stack([rng.uniform(0, 2, points), rng.uniform(0, 1, (points, 1)) * along]))
        edges.append([[0.0, 0.28 * k, 0.17 * k], [2.0, 0.28 * k, 0.17 * k]])
    found = np.concatenate(faces), np.array(edges)
    return *(each + rng.normal(0, 0.1 * SIGMA, each.shape) for each in found), (0.1 * SIGMA) ** 2 * np.eye(3)


def test_narrow_faces_beside_each_other():
    """Of these 96 faces 52 are found by planes that are drawn there, 57 with those parallel to others, 62 by edges."""
    number = 0
    for seed in range(6):
        points, edges, noise = stairs(seed)
        each, of_ends = np.broadcast_to(noise, (len(points), 3, 3)), np.broadcast_to(noise, (len(edges), 2, 3, 3))
        found = find_planes(points, each, edges, of_ends)
        assert (np.abs(found.planes[:, 1:3]).max(axis=1) > np.cos(0.1)).all()  # no slope through all of them
        number += len(found)
    assert number >= 60


@pytest.mark.kernels
def test_parallels_are_drawn_again_only_beside_planes_that_are_new(monkeypatch):
    calls = []

    def recorded(features, planes, labels, fresh, rng):
        calls.append((features, len(planes), labels.copy(), fresh))
        return from_planes(features, planes, labels, fresh, rng)

    monkeypatch.setattr(plane_search, "from_planes", recorded)
    points, edges, noise = stairs(0)
    noises = (np.broadcast_to(noise, (len(points), 3, 3)), np.broadcast_to(noise, (len(edges), 2, 3, 3)))
    find_planes(points, noises[0], edges, noises[1])
    calls = [call for call in calls if not call[0].rough]
    assert len(calls) > 1 and calls[0][3].all()
    for (_, before, _, _), (features, _, labels, fresh) in pairwise(calls):
        np.testing.assert_array_equal(fresh, (labels >= before)[features.neighbours].any(axis=1))
        assert fresh.mean() < 0.9


@pytest.mark.kernels
def test_candidates_are_parallel_to_planes_beside_them_and_at_right_angles_to_two():
    rng = np.random.default_rng(3)
    points = np.concatenate(
        [wall(rng, 60, axis, 0.0) for axis in range(3)] + [wall(rng, 60, 2, 0.0, shift=(90.0, 0.0))]
    )
    features = features_of(points, np.array(noise_of(points)), np.arange(240), np.full(240, -1))
    wall_of = np.repeat(np.arange(4), 60)[features.given]
    labels, planes = np.where(wall_of < 2, wall_of, -1), np.array([[1.0, 0, 0, 0], [0.0, 1, 0, 0]])
    everywhere = np.full(240, True)
    found, homes = from_planes(features, planes, labels, everywhere, rng)
    assert np.abs(np.einsum("ni,ni->n", found[:, :3], features.places[homes]) + found[:, 3]).max() < 1e-12
    assert set(wall_of[homes]) == {2}  # nothing is known beside the wall far away
    assert {tuple(np.abs(normal)) for normal in found[:, :3].round(12)} == {(1, 0, 0), (0, 1, 0), (0, 0, 1)}
    near = features.neighbours[homes]
    for axis in range(2):
        assert (labels[near[np.abs(found[:, axis]) == 1.0]] == axis).any(axis=1).all()
    assert len(from_planes(features, planes, np.full(240, -1), everywhere, rng)[0]) == 0
    assert len(from_planes(features, planes, np.zeros(240, int), everywhere, rng)[0]) == 0


def test_a_round_body_has_no_plane():
    """It fills one side of the layer of planes that touch it: with chances as of both sides 22 are found on these."""
    bodies = [body(seed) for seed in range(8)]
    assert sum(len(find_planes(points, noise_of(points))) for points in bodies) <= 2


def test_each_face_of_a_box_has_its_plane():
    """A box, too, is on one side of its faces, but little of it is in their layers."""
    rng, faces = np.random.default_rng(8), []
    for axis in range(3):
        faces += [wall(rng, 100, axis, offset) for offset in (0.0, 4.0)]
    points = np.concatenate(faces)
    assert len(find_planes(points, noise_of(points))) == 6


def test_chance_is_told_apart_where_it_is_below_all_numbers():
    """Ten times the points make a plane of the same kind far less accidental, and the logarithm stays finite."""
    rng = np.random.default_rng(5)
    alarms = []
    for count in (300, 3000):
        points = np.concatenate([wall(rng, count, 2, 0.0), rng.uniform(0, 4, (count // 3, 3))])
        alarms.append(float(find_planes(points, noise_of(points)).log10_false_alarms[0]))
    assert np.isfinite(alarms).all()
    assert alarms[1] < 5 * alarms[0] < -300


def test_coplanar_walls_far_apart_are_two_planes():
    rng = np.random.default_rng(4)
    points = np.concatenate([wall(rng, 200, 0, 0.0), wall(rng, 200, 0, 0.0, shift=(40.0, 0.0))])
    found = find_planes(points, noise_of(points))
    assert len(found) == 2
    assert sorted(found.support) == pytest.approx([190, 190], abs=12)


def room(rng):
    """Points and segments of three large walls, of sixteen small faces, and of clutter."""
    points = [wall(rng, 3000, axis, 0.0, size=8.0) for axis in range(3)]
    for corner in np.ndindex(4, 4):
        low = 1.2 + 1.6 * np.array(corner)
        points.append(wall(rng, 60, 2, rng.uniform(0.6, 5.0), size=1.4, shift=low))
    ends = [np.insert(rng.uniform(0, 8, (8, 2, 2)), axis, 0.0, axis=2) for axis in range(3)]
    segments = np.concatenate([*ends, rng.uniform(1, 7, (20, 2, 3))])
    return np.concatenate([*points, rng.uniform(0.5, 8, (400, 3))]), segments + rng.normal(0, SIGMA, segments.shape)


def test_the_same_planes_alone_and_beside_copies():
    """A scene has the planes it has: what else there is far away takes none, and adds none."""
    points, segments = room(np.random.default_rng(9))
    alone = np.zeros(0)
    for copies in (1, 4):
        # Copies are coplanar with each other: what is on one wall must not be taken for a part of another.
        shifts = np.array([[k % 2, k // 2, 0] for k in range(copies)]) * 400.0
        many = np.concatenate([points + shift for shift in shifts])
        lines = np.concatenate([segments + shift for shift in shifts])
        noise = np.broadcast_to(SIGMA**2 * np.eye(3), (len(lines), 2, 3, 3))
        found = find_planes(many, noise_of(many), lines, noise)
        middle = np.array([np.median(place, axis=0)[:2] for place in found.places])
        of_copy = (middle > 200.0) @ [1, 2]
        for k in range(copies):
            support = np.sort(found.support[of_copy == k])
            alone = support if copies == 1 else alone
            assert 16 <= len(support) <= 19  # of 19; a face may be hidden in clutter
            assert support[-3:] == pytest.approx(alone[-3:], abs=30)


def test_many_planes_are_found():
    """No number is too large: eleven by eleven patches at heights of their own."""
    rng = np.random.default_rng(9)
    patches = [wall(rng, 40, 2, rng.uniform(0, 30), size=2.0, shift=(4.0 * i, 4.0 * j)) for i, j in np.ndindex(11, 11)]
    points = np.concatenate(patches)
    assert 118 <= len(find_planes(points, noise_of(points))) <= 121


@pytest.mark.kernels
@pytest.mark.compiled
def test_the_same_planes_with_any_number_of_threads():
    """Bit by bit: candidates are scored in pieces."""
    points, segments = room(np.random.default_rng(11))
    noise = np.broadcast_to(SIGMA**2 * np.eye(3), (len(segments), 2, 3, 3))
    alone = find_planes(points, noise_of(points), segments, noise)
    assert len(alone) > 10
    for threads in (2, 5):
        with work_with(threads):
            found = find_planes(points, noise_of(points), segments, noise)
        for name in ("planes", "covariance", "support", "point_label", "segment_label"):
            np.testing.assert_array_equal(getattr(found, name), getattr(alone, name))


def test_segments_make_planes_too():
    rng = np.random.default_rng(5)
    ends = rng.uniform(0, 4, (40, 2, 2))
    segments = np.concatenate([np.insert(ends, 2, 1.0, axis=2), rng.uniform(0, 4, (30, 2, 3))])
    segments = segments + rng.normal(0, SIGMA, segments.shape)
    noise = np.broadcast_to(SIGMA**2 * np.eye(3), (70, 2, 3, 3))
    found = find_planes(np.zeros((0, 3)), np.zeros((0, 3, 3)), segments, noise)
    assert len(found) == 1
    assert np.abs(np.abs(found.planes[0]) - [0, 0, 1, 1]).max() < 0.01
    assert (found.segment_label[:40] == 0).mean() > 0.8
    assert (found.segment_label[40:] == 0).mean() < 0.1


def test_points_on_segments_are_no_evidence_of_their_own():
    """Two crossing segments are coplanar; the points on them make it no plane."""
    rng = np.random.default_rng(6)
    segments = np.array([[[0, 0, 0], [2, 0, 0.0]], [[0, 0, 0], [0, 2, 0.0]]])
    share = rng.uniform(0, 1, (40, 1))
    owner = np.arange(40) % 2
    points = segments[owner, 0] + share * (segments[owner, 1] - segments[owner, 0])
    noise = np.broadcast_to(SIGMA**2 * np.eye(3), (2, 2, 3, 3))
    assert len(find_planes(points, noise_of(points), segments, noise, carriers=owner)) == 0


@pytest.mark.kernels
def test_mixture_separates_members_from_clutter():
    rng = np.random.default_rng(7)
    members, clutter = np.abs(rng.normal(0, 0.01, 200)), rng.uniform(0, 0.1, 100)
    distance, owner = np.concatenate([members, clutter]), np.zeros(300, int)
    probability, share = inlier_probability(distance, np.full(300, 0.01), owner, np.array([0.1]))
    assert share[0] == pytest.approx(2 / 3, abs=0.08)
    assert (probability[:200] > 0.7).mean() > 0.9
    assert (probability[200:] > 0.7).mean() < 0.3
    # A landmark as uncertain as the band is wide tells nothing: it keeps about the share of the structure.
    vague, _ = inlier_probability(
        np.append(distance, 0.0), np.append(np.full(300, 0.01), 0.1), np.zeros(301, int), np.array([0.1])
    )
    assert vague[-1] < 0.7


def test_bad_input_and_empty():
    assert len(find_planes(np.zeros((0, 3)), np.zeros((0, 3, 3)))) == 0
    assert len(find_planes(np.zeros((3, 3)), np.broadcast_to(np.eye(3), (3, 3, 3)))) == 0
    same = np.zeros((50, 3))
    assert len(find_planes(same, noise_of(same), options=replace(PlaneOptions(), seed=1))) == 0
    with pytest.raises(ShapeError, match="covariances"):
        find_planes(np.zeros((5, 3)), np.zeros((4, 3, 3)))
    with pytest.raises(InputError, match="finite"):
        find_planes(np.full((5, 3), np.nan), np.zeros((5, 3, 3)))
    with pytest.raises(InputError, match="at least 3"):
        fit_plane(np.zeros((2, 3)), np.zeros((2, 3, 3)))
    with pytest.raises(ShapeError, match="carriers"):
        find_planes(np.zeros((5, 3)), np.zeros((5, 3, 3)), carriers=np.zeros(4, int))
