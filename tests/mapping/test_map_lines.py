# SPDX-License-Identifier: BSD-3-Clause
"""Lines mapped from segments: wireframes with exact truth, degenerate motion, matches, distortion, empty maps."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from _wireframe import Wireframe, arc, distance_to_truth, random_lines, true_lines, wireframe

from groma.errors import InputError
from groma.features import ExternalMatches, LsdDetector
from groma.features.matches import LineMatches
from groma.features.segments import Segments
from groma.geometry import quaternion
from groma.mapping.lines.build import map_lines
from groma.mapping.lines.filtering.filters import is_certain
from groma.mapping.lines.hypotheses.directions import depth_ratios
from groma.mapping.lines.hypotheses.proposals import Proposer, Questions, angles_about_baseline
from groma.mapping.lines.line_map import LineMap, explain
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.matches import given_matches, segment_matches
from groma.mapping.lines.neighbors import covisible_neighbors
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import Outcome
from groma.mapping.lines.views import build_views
from groma.scene import Cameras, Scene
from groma.scene.similarity import Similarity

pytestmark = pytest.mark.kernels


@pytest.fixture(scope="module")
def world() -> Wireframe:
    rng = np.random.default_rng(1)
    return wireframe(arc(6), random_lines(25, rng), rng, num_clutter=15)


@pytest.fixture(scope="module")
def mapped(world: Wireframe) -> LineMap:
    return map_lines(world.scene, world.segments)


@pytest.mark.compiled
def test_wireframe_is_found(world, mapped):
    owner = true_lines(world, mapped)
    num_seen = sum(np.bincount(t[t >= 0], minlength=len(world.lines)) for t in world.truth)
    visible = np.flatnonzero(num_seen >= 4)
    assert len(visible) >= 20
    assert len(np.intersect1d(owner, visible)) >= 0.9 * len(visible)
    # Clutter agrees by chance at times: 90 random segments in six images may make a line or two.
    assert (owner < 0).sum() <= 2
    # One line each: nothing is found twice.
    found = owner[owner >= 0]
    assert len(found) <= 1.05 * len(np.unique(found))


def test_lines_are_as_good_as_they_say(world, mapped):
    owner = true_lines(world, mapped)
    good = np.flatnonzero(owner >= 0)
    error = np.array([distance_to_truth(world, mapped, n, owner[n]) for n in good])
    # Uncertainty is the largest of four deviations; an error beyond four of them has a chance below 1e-3 each.
    assert (error < 4.0 * mapped.uncertainty[good]).mean() >= 0.95
    assert np.median(error) < 0.01
    assert np.median(mapped.residual) < 0.3


def test_result_is_consistent(world, mapped):
    assert mapped.lines.shape == (mapped.num_lines, 6)
    assert sum(mapped.outcome_counts().values()) == sum(len(s) for s in world.segments)
    assert all((outcomes >= 0).all() for outcomes in mapped.outcomes)
    counts = mapped.outcome_counts()
    assert counts[Outcome.MAPPED] + counts[Outcome.RECOVERED] == len(mapped.line_idx)
    for i, outcomes in enumerate(mapped.outcomes):
        on_lines = np.sort(mapped.segment_idx[mapped.image_idx == i])
        assert np.array_equal(on_lines, np.flatnonzero(outcomes <= Outcome.RECOVERED))
    assert (mapped.num_images >= 3).all()
    assert (np.diff(mapped.line_idx) >= 0).all()
    scene = mapped.add_to(world.scene, world.segments)
    assert scene.num_lines == mapped.num_lines
    assert scene.num_line_observations == len(mapped.line_idx)
    np.testing.assert_allclose(scene.lines.plucker, mapped.lines)
    assert "lines from" in explain(mapped)


def test_lines_run_like_their_segments(world, mapped):
    owner = true_lines(world, mapped)
    for n in np.flatnonzero(owner >= 0):
        true = world.lines[owner[n], 1] - world.lines[owner[n], 0]
        assert (mapped.segments[n, 1] - mapped.segments[n, 0]) @ true > 0


@pytest.mark.compiled
def test_another_world_frame_changes_nothing(world, mapped):
    turn = np.array([0.3, -0.2, 0.4, 0.0])
    turn[3] = np.sqrt(1 - turn @ turn)
    moved = map_lines(
        world.scene.transformed(Similarity(7.0, quaternion.to_matrix(turn), np.array([30.0, -50.0, 4.0]))),
        world.segments,
    )
    assert abs(moved.num_lines - mapped.num_lines) <= 1
    assert abs(len(moved.line_idx) - len(mapped.line_idx)) <= 5


@pytest.mark.parametrize("form", ["callable", "mapping", "turned"])
def test_matches(world, form):
    images = range(len(world.segments))
    given = {(i, j): world.matches(i, j) for i in images for j in images if (i < j if form == "mapping" else i > j)}
    result = map_lines(world.scene, world.segments, world.matches if form == "callable" else given)
    owner = true_lines(world, result)
    assert (owner >= 0).all()
    assert len(owner) >= 20
    # What is not matched with anything says so.
    clutter = np.concatenate([f[t < 0] for f, t in zip(result.outcomes, world.truth, strict=True)])
    assert (clutter == Outcome.NO_MATCH).all()


def test_matches_of_a_file(world, mapped):
    names = world.scene.images.names
    images = range(len(names))
    pairs = {(names[i], names[j]): world.matches(i, j) for i in images for j in images if i < j}
    result = map_lines(world.scene, world.segments, given_matches(names, ExternalMatches({}, pairs)))
    owner = true_lines(world, result)
    assert (owner >= 0).all()
    assert len(owner) >= 20


@pytest.mark.compiled
@pytest.mark.parametrize("matcher", ["wide_baseline", "flow"])
def test_matches_from_images(matcher):
    """A tiled floor seen from a camera that moves sideways: the matches are the same edges."""
    rng = np.random.default_rng(9)
    image = np.full((300, 420), 110.0, np.float32)
    for _ in range(14):
        x, y, w, h = *rng.integers(20, 260, 2), *rng.integers(30, 90, 2)
        image[y : y + h, x : x + w] = rng.uniform(20, 240)
    image = cv2.GaussianBlur(image, (0, 0), 0.7)
    images = [np.ascontiguousarray(image[:, 12 * k : 12 * k + 360]).astype(np.uint8) for k in range(4)]
    # Depth 4 and focal length 400: 12 pixels are 0.12 units.
    centers = np.column_stack([0.12 * np.arange(4), np.zeros(4), np.zeros(4)])
    poses = np.column_stack([np.zeros((4, 3)), np.ones(4), -centers])
    cameras = Cameras(np.array([1]), ("PINHOLE",), np.array([[400.0, 400, 180, 150]]), np.array([360]), np.array([300]))
    scene = Scene.from_images(cameras, [f"{k}.png" for k in range(4)], np.zeros(4, int), poses)
    detector = LsdDetector(min_length=20)
    segments = [detector.detect(picture) for picture in images]
    found = segment_matches(scene, segments, lambda k: images[k], matcher)(0, 2)
    assert len(found) >= 0.5 * min(len(segments[0]), len(segments[2]))
    shift = segments[0].midpoint[found.pairs[:, 0]] - segments[2].midpoint[found.pairs[:, 1]]
    along = segments[0].direction[found.pairs[:, 0]]
    across = np.abs((shift[:, 0] - 24.0) * along[:, 1] - shift[:, 1] * along[:, 0])
    assert (across < 1.0).mean() >= 0.95
    with pytest.raises(InputError, match="one set per image"):
        segment_matches(scene, segments[:2], lambda k: images[k], matcher)


@pytest.mark.compiled
def test_lines_that_only_short_segments_show(world):
    short = map_lines(world.scene, world.segments, options=MapLinesOptions(min_longest=1e4))
    assert short.num_lines == 0
    assert short.outcome_counts()[Outcome.SHORT_LINE] > 0
    assert "larger images" in explain(short)


def test_vanishing_points_tell_how_depth_changes():
    rng = np.random.default_rng(10)
    middle, along = rng.uniform(-1.0, 1.0, (24, 3)), np.array([0.5, 0.3, 0.0])
    parallel = wireframe(arc(4), np.stack([middle - along, middle + along], 1), rng, sigma=0.05)
    views = build_views(parallel.scene, parallel.segments, 12.0, 0.1, 2.0)
    ratios = depth_ratios(parallel.scene, parallel.segments, views)
    known = ratios[:, 0] > 0
    assert known.mean() >= 0.8
    # The true ratio, from where the rays of the ends meet the true line.
    truth = np.concatenate(parallel.truth)
    depth = np.zeros((len(truth), 2))
    for s, (n, i) in enumerate(zip(truth, views.image_idx, strict=True)):
        for k in range(2):
            table = np.column_stack([views.ray[s, k], parallel.lines[n, 0] - parallel.lines[n, 1]])
            depth[s, k] = np.linalg.lstsq(table, parallel.lines[n, 0] - views.center[i], rcond=None)[0][0]
    error = np.abs(ratios[:, 0] - depth[:, 0] / depth[:, 1])[known]
    assert np.median(error) < 2e-3
    assert (error < 4.0 * ratios[known, 1] + 2e-3).mean() >= 0.95


def test_directions_place_what_two_views_cannot():
    """All neighbours lie in the epipolar planes of lines along x; a direction and a point place them from one image."""
    rng = np.random.default_rng(11)
    lines = np.array([[[-0.6, 0.1 * k, z], [0.6, 0.1 * k, z]] for k, z in enumerate(np.linspace(-0.8, 0.8, 12))])
    flat = wireframe(arc(5), lines, rng)
    xyz = lines.mean(1)
    views = build_views(flat.scene, flat.segments, 12.0, 0.1, 2.0)
    ratios = depth_ratios(flat.scene, flat.segments, views)
    P = views.camera[0]
    x = xyz @ P[:, :3].T + P[:, 3]
    proposer = Proposer(views, ratios, MapLinesOptions())
    no_match = np.empty((0, 2), np.int64), np.empty(0)
    found = proposer.propose(Questions(0, np.array([1]), [no_match], (x[:, :2] / x[:, 2:], 1 / x[:, 2])))
    assert (found.neighbor == 2).all()  # slot of a point with a direction: no other proposal is possible
    assert len(np.unique(found.segment)) >= 8
    for s, q in zip(found.segment, found.values[:, :2], strict=True):
        ends = views.center[0] + views.ray[s] / q[:, None]
        a, b = lines[flat.truth[0][s]]
        d = (b - a) / np.linalg.norm(b - a)
        assert np.linalg.norm(np.cross(ends - a, d), axis=1).max() < 0.05


@pytest.mark.compiled
def test_distorted_camera():
    rng = np.random.default_rng(3)
    params = (700.0, 700.0, 400.0, 300.0, -0.12, 0.03, 0.001, -0.001)
    bent = wireframe(arc(6), random_lines(20, rng), rng, model="OPENCV", params=params)
    result = map_lines(bent.scene, bent.segments)
    owner = true_lines(bent, result)
    assert len(np.unique(owner)) >= 15
    errors = [distance_to_truth(bent, result, n, owner[n]) for n in np.flatnonzero(owner >= 0)]
    assert np.median(errors) < 0.01


def test_scene_without_points():
    rng = np.random.default_rng(4)
    bare = wireframe(arc(5), random_lines(15, rng), rng, num_points=0)
    result = map_lines(bare.scene, bare.segments, bare.matches)
    assert len(np.unique(true_lines(bare, result))) >= 11


def test_lines_along_the_motion_need_another_view():
    """A camera moves along x and looks along y; lines along x lie in epipolar planes of all pairs."""
    lines = np.array([[[-0.6, 0.1 * k, z], [0.6, 0.1 * k, z]] for k, z in enumerate((-0.6, -0.3, 0.2, 0.5))])
    centers = np.column_stack([np.linspace(-0.9, 0.9, 5), np.full(5, -4.0), np.zeros(5)])
    ahead = centers + np.array([0.0, 4.0, 0.0])
    rng = np.random.default_rng(5)
    flat = wireframe(centers, lines, rng, targets=ahead)
    result = map_lines(flat.scene, flat.segments)
    assert result.num_lines == 0
    assert result.outcome_counts()[Outcome.DEGENERATE] >= 15
    assert "epipolar" in explain(result)
    assert "The map is empty" in explain(result)
    above = np.array([[0.3, -4.0, 1.0], [-0.4, -4.0, -1.1]])
    raised = wireframe(
        np.vstack([centers, above]),
        lines,
        np.random.default_rng(5),
        targets=np.vstack([ahead, above + np.array([0, 4.0, 0])]),
    )
    result = map_lines(raised.scene, raised.segments)
    assert sorted(true_lines(raised, result)) == [0, 1, 2, 3]
    assert (result.num_images == 7).all()


def test_two_groups_of_images_stay_apart():
    rng = np.random.default_rng(6)
    world = wireframe(arc(8), random_lines(5, rng), rng)
    neighbors = covisible_neighbors(world.scene, 3)
    assert all(len(n) == 3 for n in neighbors)
    assert all(i not in n for i, n in enumerate(neighbors))
    keep = world.scene.point_observations
    keep = keep.take(np.flatnonzero((keep.point_idx % 2 == 0) == (keep.image_idx < 4)))
    halves = covisible_neighbors(world.scene.replace(point_observations=keep), 10)
    assert all((n < 4).all() == (i < 4) for i, n in enumerate(halves))


def test_angle_about_the_baseline_is_that_of_the_epipolar_plane():
    rng = np.random.default_rng(7)
    first, second = np.zeros(3), np.array([0.4, -0.1, 0.2])
    X = rng.uniform(-1, 1, (50, 2, 3)) + np.array([0, 0, 4.0])
    one = angles_about_baseline(X - first, second - first)
    two = angles_about_baseline(X - second, second - first)
    np.testing.assert_allclose(one, two, atol=1e-12)
    assert (one[:, 1] >= one[:, 0]).all()
    np.testing.assert_allclose(angles_about_baseline(X[:, ::-1] - first, second - first), one * [1, 1, -1], atol=1e-12)
    assert (np.abs(one[:, 2]) == 1.0).all()
    along = X[:1, :1] + np.array([0.0, 0.1])[:, None] * (X[0, 0] - first)  # of the same epipolar plane
    assert angles_about_baseline(along - first, second - first)[0, 2] == 0.0


def test_empty_maps_say_why(world):
    none = [Segments.empty() for _ in world.segments]
    assert "No segments" in explain(map_lines(world.scene, none))
    assert "no images" in explain(map_lines(Scene(), []))
    alone = map_lines(world.scene.subset([0]), world.segments[:1])
    assert alone.outcome_counts()[Outcome.NO_NEIGHBOR] == len(world.segments[0])
    assert "share too few points" in explain(alone)
    short = map_lines(world.scene, world.segments, options=MapLinesOptions(min_length=1e4))
    assert "--min-length" in explain(short)


def test_inputs_are_checked(world):
    with pytest.raises(InputError, match="one set per image"):
        map_lines(world.scene, world.segments[:-1])
    wrong = LineMatches(np.array([[0, 10_000]]), np.ones(1))
    with pytest.raises(InputError, match="indices up to"):
        map_lines(world.scene, world.segments, lambda i, j: wrong)


@pytest.mark.compiled
def test_nothing_is_changed(world):
    before = [s.ends.copy() for s in world.segments]
    map_lines(world.scene, world.segments)
    assert all(np.array_equal(a, s.ends) for a, s in zip(before, world.segments, strict=True))


@pytest.mark.compiled
def test_lines_of_texture():
    rng = np.random.default_rng(21)
    world = wireframe(arc(6), random_lines(30, rng), rng, num_clutter=80)
    weak = [np.where((truth >= 0) & (truth < 22), 20.0, 4.0) for truth in world.truth]
    segments = [Segments(s.ends, s.sigma, w) for s, w in zip(world.segments, weak, strict=True)]
    found = map_lines(world.scene, segments)
    every = map_lines(world.scene, segments, options=MapLinesOptions(min_repeatability=0.0))
    assert found.outcome_counts()[Outcome.TEXTURE] > 0
    assert every.outcome_counts()[Outcome.TEXTURE] == 0
    strong = {n for n in true_lines(world, every) if 0 <= n < 22}
    assert {n for n in true_lines(world, found) if n >= 0} == strong
    assert any(n >= 22 for n in true_lines(world, every))


def test_far_lines_must_be_known_as_well_as_usual_ones(world):
    views, line_of = build_views(world.scene, world.segments, 12.0, 0.15, 2.0), np.concatenate(world.truth)
    lines, zero = world.lines.copy(), np.zeros(len(world.lines))
    lines[0] *= 1e3 / np.linalg.norm(lines[0].mean(0))
    seen = np.bincount(line_of[line_of >= 0], minlength=len(lines)) > 0
    assert seen[0]
    tracks = replace(Tracks.none(views, np.zeros(len(line_of))), lines=lines, line_of=line_of, unchecked=zero)
    distance = np.linalg.norm(lines.mean(1)[:, None] - views.center, axis=2)
    usual = float(np.median(distance.mean(1)[seen]))
    for relative, known in ((0.009, True), (0.02, False)):
        uncertain = replace(tracks, uncertainty=zero + relative * usual)
        assert is_certain(uncertain, MapLinesOptions())[0] == known
