# SPDX-License-Identifier: BSD-3-Clause
"""Points, landmarks and lines that match: against the same searches written without any shortcut."""

import numpy as np
import pytest
from worlds import CAMERA, make_world, project

from groma.features.matching.wide_baseline import WideBaselineOptions
from groma.features.segments import SEGMENTS, Segments
from groma.localization.features import DescribedPoints, unit
from groma.localization.landmarks import GATES, DescribedLandmarks, coarsest, counted_in, seen_in
from groma.localization.line_matching import SeenLines, lines_near
from groma.localization.map_index import MapIndex
from groma.localization.matching import MATCHES, alike_elsewhere, lengths_of, match_descriptors, pairs_near
from groma.localization.pose.matches import nearest_claims

pytestmark = pytest.mark.kernels


def _vectors(rng, count, size=32):
    values = rng.normal(size=(count, size)).astype(np.float32)
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def test_vectors_are_descriptors_over_their_lengths():
    descriptors = np.random.default_rng(4).integers(0, 256, (300, 128), dtype=np.uint8)
    descriptors[0] = 0
    lengths = np.maximum(np.linalg.norm(descriptors.astype(np.float32), axis=1, keepdims=True), np.float32(1e-6))
    np.testing.assert_array_equal(unit(descriptors), descriptors / lengths)


def test_of_equal_claims_the_first_of_the_nearest_stays():
    claim, distance = np.array([2, 0, 2, 0, 2, 5]), np.array([1.0, 3.0, 1.0, 2.0, 0.5, np.inf])
    agrees = np.array([True, True, True, True, False, False])
    assert nearest_claims(claim, distance, agrees).tolist() == [True, False, False, True, False, False]
    assert not len(nearest_claims(claim[:0], distance[:0], agrees[:0]))


@pytest.mark.parametrize(("rows", "columns"), [(300, 5000), (1100, 300), (70, 30), (1, 50)])
def test_matches_are_the_best_of_both_and_clear(rows, columns):
    rng = np.random.default_rng(rows)
    first, second = _vectors(rng, rows), _vectors(rng, columns)
    for k in range(0, min(rows, columns), 2):
        second[(7 * k) % columns] = unit(first[k : k + 1] + 0.05 * rng.normal(size=(1, 32)).astype(np.float32))[0]
    found = match_descriptors(first, second)
    away = np.linalg.norm(first[:, None].astype(float) - second[None], axis=2)
    best, other = away.argmin(axis=1), away.argmin(axis=0)
    two = np.partition(away, 1, axis=1)[:, 1] if columns > 1 else np.full(rows, np.inf)
    expected = [
        (i, j) for i, j in enumerate(best)
        if rows > 1 and other[j] == i and away[i, j] <= MATCHES.distance and away[i, j] <= MATCHES.ratio * two[i]
    ]  # fmt: skip
    assert [tuple(pair) for pair in found] == expected
    assert rows == 1 or len(expected) > 10


def test_points_near_where_they_are_expected():
    rng = np.random.default_rng(2)
    places, pixels = rng.uniform(-10, 210, (200, 2)), rng.uniform(0, 200, (300, 2))
    pixels[:100] = places[:100] + rng.normal(0, 3, (100, 2))
    places[196:] = [[-1e4, 100], [1e4, 100], [100, -1e4], [1e4, 1e4]]  # far beyond any pixel
    first, second = (rng.integers(0, 256, (count, 128), dtype=np.uint8) for count in (200, 300))
    second[:100] = first[:100]
    shuffled = rng.permutation(200)  # rows of the descriptors that places have
    stored = np.empty_like(first)
    stored[shuffled] = first
    rows, columns, far = pairs_near(places, shuffled, (stored, lengths_of(stored)), pixels, second, 6.0)
    distance = np.linalg.norm(unit(first)[:, None] - unit(second)[None], axis=2)
    near = np.linalg.norm(places[:, None] - pixels[None], axis=2) <= 6.0
    expected = np.argwhere(near & (distance <= MATCHES.distance))
    order = np.lexsort((columns, rows))
    np.testing.assert_array_equal(np.column_stack([rows, columns])[order], expected)
    np.testing.assert_allclose(far[order], distance[tuple(expected.T)], atol=2e-3)
    assert len(expected) > 80


def test_what_is_alike_elsewhere_in_an_image():
    """The nearest descriptor of a place that is not beside; none where there is no such place."""
    rng = np.random.default_rng(5)
    pixels, vectors = rng.uniform(0, 300, (400, 2)), _vectors(rng, 400, 8)
    away = np.linalg.norm(vectors[:, None] - vectors[None], axis=2)
    far = np.linalg.norm(pixels[:, None] - pixels[None], axis=2) > 60.0
    expected = np.where(far, away, np.inf).min(axis=1)
    np.testing.assert_allclose(alike_elsewhere(vectors, pixels, vectors, pixels, 60.0), expected, atol=1e-3)
    assert (expected > np.sort(away, axis=1)[:, 1] + 1e-3).any()
    assert (alike_elsewhere(vectors[:3], pixels[:3], vectors[:3], pixels[:3], 1000.0) == 2.0).all()
    # Where the image would not see the place at all, every other is elsewhere.
    unseen = np.full((3, 2), np.inf)
    assert (alike_elsewhere(vectors[:3], unseen, vectors[:3], pixels[:3], 1000.0) < 1e-3).all()


def test_lines_near_where_they_are_expected():
    rng = np.random.default_rng(3)
    world = make_world(rng, lines=150)
    ends = project(CAMERA, world.pose, world.segments3d)
    shift = rng.normal(0.0, 4.0, (150, 1, 2))
    segments = Segments.from_ends((world.segments2d + shift).reshape(-1, 4))
    described, own = _vectors(rng, 300, 72), _vectors(rng, 150, 72)
    owner = np.concatenate([np.arange(150), rng.integers(0, 150, 150)])
    described[:100] = own[:100]  # the others show something else
    found = lines_near(CAMERA, world.pose, SeenLines(owner, described, world.segments3d), segments, own, 8.0)
    expected = set()
    for i, (start, end) in enumerate(ends):
        length = np.linalg.norm(end - start)
        along = (end - start) / length
        normal = np.array([-along[1], along[0]])
        for k, pair in enumerate(segments.ends.reshape(-1, 2, 2)):
            place, across, way = (pair - start) @ along, (pair - start) @ normal, np.linalg.norm(pair[1] - pair[0])
            common = min(place.max(), length) - max(place.min(), 0.0)
            near = np.abs(across).max() <= 8.0 and abs(across[1] - across[0]) <= SEGMENTS.angle * way
            alike = min(np.linalg.norm(described[j] - own[k]) for j in np.flatnonzero(owner == i))
            if near and common >= SEGMENTS.overlap * way and alike <= WideBaselineOptions.max_descriptor_distance:
                expected.add((i, k))
    assert set(map(tuple, found.tolist())) == expected
    assert 20 < len(expected) <= 100


def _index(rng):
    """Three images that see points 0 to 199, 100 to 299 and 300 to 399, the last hundred described upright."""
    point = np.concatenate([np.arange(200), np.arange(100, 300), np.arange(300, 400)])
    kind = rng.integers(0, 256, (400, 128))
    octets = np.clip(kind[point] + rng.normal(0, 12, (500, 128)), 0, 255).astype(np.uint8)
    none = np.zeros((0, 6))
    return MapIndex(
        rng.normal(size=(400, 3)), np.zeros((400, 3, 3)), np.array([0, 200, 400, 500]), point, np.zeros((500, 2)),
        octets, none, np.zeros(4, int), np.zeros(0, int), none, none, none,
    ), kind  # fmt: skip


def test_landmarks_are_matched_once_and_by_their_kind():
    rng = np.random.default_rng(4)
    index, kind = _index(rng)
    described = DescribedLandmarks.of(index, np.arange(400) >= 300)
    assert described.descriptor.shape == (400, GATES.dimensions)
    shown = np.array([5, 150, 250, 350, 351, 20])
    octets = np.clip(kind[shown] + rng.normal(0, 12, (6, 128)), 0, 255).astype(np.uint8)
    upright = np.array([False, False, False, True, True, True])  # the last one is not of its kind
    points = DescribedPoints(np.zeros((6, 2)), np.ones(6), octets, upright)
    found = described.match(points, seen_in(index, np.array([0, 1, 2])))
    assert set(map(tuple, found.tolist())) == {(0, 5), (1, 150), (2, 250), (3, 350), (4, 351)}
    np.testing.assert_array_equal(seen_in(index, np.array([1])), np.arange(100, 300))
    # Points 100 to 199 by two of the images, then those of the first image.
    np.testing.assert_array_equal(seen_in(index, np.array([1, 0])), np.r_[100:300, 0:100])
    np.testing.assert_array_equal(counted_in(index, np.array([2, 0, 1]), shown), [2, 3, 2])


def test_the_coarsest_points_and_the_first_corners_go_first():
    sigma = np.concatenate([np.linspace(0.5, 9.0, 1000), np.ones(500)])
    upright = np.arange(1500) >= 1000
    points = DescribedPoints(np.zeros((1500, 2)), sigma, np.zeros((1500, 128), np.uint8), upright)
    chosen = coarsest(points)
    assert set(chosen.tolist()) == {*range(1000 - GATES.points, 1000), *range(1000, 1000 + GATES.corners)}
