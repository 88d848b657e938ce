# SPDX-License-Identifier: BSD-3-Clause
"""Mapping many lines: near pairs and lines seen side by side against comparisons of all; unused landmarks; words."""

import inspect
import itertools
import re
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from _comparison import equal

from groma.cli.commands.map import map_
from groma.features.segments import SEGMENTS
from groma.mapping.groups import distinct_pairs, num_distinct
from groma.mapping.lines.bins import in_bins
from groma.mapping.lines.hypotheses.known_points import lines_through_points
from groma.mapping.lines.line_map import LineMap, explain
from groma.mapping.lines.linking import merge as _line_merge
from groma.mapping.lines.linking.fit import find_on_lines, near_together
from groma.mapping.lines.linking.merge import MergeGates
from groma.mapping.lines.outcomes import REMEDIES, WORDS, Outcome
from groma.mapping.unused import without_unused
from groma.scene import Directions, Relations
from groma.scene.synthetic.scenes import corridor


def bundle(rng, count, size):
    """Lines (L, 2, 3) in all directions in a flat box; every second one is a moved copy of the one before."""
    middle = rng.uniform(-1, 1, (count, 3)) * [size, size, 1.0]
    direction = rng.normal(size=(count, 3))
    direction *= rng.lognormal(0.0, 1.0, (count, 1)) / np.linalg.norm(direction, axis=1, keepdims=True)
    X = middle[:, None] + np.array([-0.5, 0.5])[:, None] * direction[:, None]
    X[1::2] = X[::2] + rng.normal(0, 0.05, (count // 2, 2, 3))
    return X


def all_pairs(X, reach):
    """The pairs that lie near each other, by comparing all with all; the rule in plain words."""
    found = set()
    for a in range(len(X)):
        for b in range(len(X)):
            d, e = X[a, 1] - X[a, 0], X[b, 1] - X[b, 0]
            if a == b or abs(d @ e) <= np.cos(MergeGates().max_angle) * np.linalg.norm(d) * np.linalg.norm(e):
                continue
            t = (X[b] - X[a, 0]) @ d / (d @ d)
            low, high = max(0.0, t.min()), min(1.0, t.max())
            if high - low < SEGMENTS.overlap * min(1.0, np.ptp(t)):
                continue
            places = np.array([low, high])
            on_b = X[b, 0] + ((places - t[0]) / (t[1] - t[0]))[:, None] * e
            on_a = X[a, 0] + places[:, None] * d
            if (np.linalg.norm(on_b - on_a, axis=1) <= min(reach[a], reach[b])).all():
                found.add((a, b))
    return found


@pytest.mark.kernels
@pytest.mark.parametrize("size", [2.0, 30.0])
def test_near_pairs_are_those_of_all_pairs(size):
    rng = np.random.default_rng(5)
    X = bundle(rng, 120, size)
    reach = rng.lognormal(-1.5, 0.7, len(X))
    pairs, span = _line_merge._candidates(X, reach)
    either = all_pairs(X, reach)
    assert len(pairs) == len({tuple(sorted(pair)) for pair in pairs.tolist()})  # each once
    # The rule is judged from the line that comes first along the scene.
    assert {tuple(pair) for pair in pairs.tolist()} <= either
    assert {tuple(sorted(pair)) for pair in pairs.tolist()} >= {
        pair for pair in either if pair[0] < pair[1] and pair[::-1] in either
    }
    assert len(pairs) >= 20
    assert ((span >= 0.0) & (span <= 1.0)).all()


def on_line(camera, line, ends, sigma, forward, gate):
    """Squared distance over sigma of a segment that is on a line in an image, None where it is not, in plain words."""
    start, end = (p[:2] / p[2] for p in np.column_stack([line, np.ones(2)]) @ camera.T)
    along = (end - start) / (length := np.linalg.norm(end - start))
    away = (ends - start) @ [along[1], -along[0]]
    t = (ends - start) @ along
    overlap = min(t.max(), length) - max(t.min(), 0.0)
    squared = away @ away / sigma**2
    fits = overlap >= max(0.5 * min(np.ptp(t), length), 5.0) and forward * (t[1] - t[0]) >= 0.0
    return squared if fits and squared <= gate else None


@pytest.mark.kernels
@pytest.mark.parametrize(("size", "count"), [(100.0, 0), (100.0, 3), (100.0, 40), (1000.0, 300)])
def test_segments_on_lines_are_those_of_all_pairs(size, count):
    """Some segments lie on lines, of any length, some are not to be looked at."""
    rng, gate = np.random.default_rng(count), 12.0
    lines = np.concatenate([rng.uniform(-1, 1, (60, 2, 2)), rng.uniform(1.5, 3.0, (60, 2, 1))], axis=2)
    lines[0, 0, 2] = -1.0  # begins behind the camera
    camera = np.array([[size, 0.0, size, 0.0], [0.0, size, size, 0.0], [0.0, 0.0, 1.0, 0.0]])
    pixel = lines @ camera[:, :3].T
    pixel = pixel[..., :2] / pixel[..., 2:]
    part = rng.uniform(-0.5, 1.5, (count, 2, 1))
    on = pixel[rng.integers(0, 60, count)]
    ends = (on[:, :1] + part * (on[:, 1:] - on[:, :1]) + rng.normal(0, 0.5, (count, 2, 2))).reshape(-1, 4)
    sigma, usable = rng.uniform(0.1, 0.8, count), rng.random(count) < 0.9
    forward = rng.choice([-1.0, 0.0, 1.0], 60)
    expected = {
        (n, s): squared
        for n in range(1, 60)
        for s in np.flatnonzero(usable).tolist()
        if (squared := on_line(camera, lines[n], ends[s].reshape(2, 2), sigma[s], forward[n], gate)) is not None
    }
    order = near_together(ends, usable)
    np.testing.assert_array_equal(np.sort(order), np.flatnonzero(usable))
    for room in (0, 5, 4096):
        found, squared = np.empty((room, 2), np.int64), np.empty(room)
        needed = find_on_lines(camera, lines, order, ends, sigma, forward, gate, 0.5, 5.0, found, squared)
        assert needed == len(expected)
    assert [tuple(pair) for pair in found[:needed].tolist()] == sorted(expected)
    np.testing.assert_allclose(squared[:needed], [expected[pair] for pair in sorted(expected)], rtol=1e-7, atol=1e-9)
    assert needed >= count // 10


@pytest.mark.kernels
def test_lines_through_points_are_those_of_the_first_points_on_each_segment():
    rng = np.random.default_rng(2)
    pixels, depths = rng.uniform(0, 200, (2000, 2)), rng.choice([0.2, 0.201, 0.5], 2000)
    ends = np.concatenate([rng.uniform(0, 200, (30, 4)), [[50, 10, 50, 190], [10, 80, 190, 80], [20, 20, 25, 20]]])
    along = (ends[:, 2:] - ends[:, :2]) / np.linalg.norm(ends[:, 2:] - ends[:, :2], axis=1)[:, None]
    normal = np.column_stack([along[:, 1], -along[:, 0]])
    views = SimpleNamespace(
        ends=ends, line=np.column_stack([normal, -(normal * ends[:, :2]).sum(axis=1)]), usable=np.ones(33, bool),
        range=np.tile([0.01, 1.0], (33, 1)),
    )  # fmt: skip
    ratios = np.tile([1.0, 0.1], (33, 1))
    found, values = lines_through_points(views, slice(0, 33), ratios, (pixels, depths), 7)
    for s in range(33):
        t = (pixels - ends[s, :2]) @ along[s]
        inside = (t >= -SEGMENTS.on) & (t <= np.linalg.norm(ends[s, 2:] - ends[s, :2]) + SEGMENTS.on)
        first = np.flatnonzero(inside & (np.abs((pixels - ends[s, :2]) @ normal[s]) <= SEGMENTS.on))[:16]
        alone = lines_through_points(views, slice(s, s + 1), ratios[:1], (pixels[first], depths[first]), 7)
        np.testing.assert_array_equal(found[found[:, 0] == s, 1:], alone[0][:, 1:])
        np.testing.assert_array_equal(values[found[:, 0] == s], alone[1])
    assert len(np.unique(found[:, 0])) >= 25


@pytest.mark.kernels
def test_lines_that_an_image_shows_side_by_side():
    """Line 0 beside line 1 in image 1, beside line 2 in no image, and on top of line 3."""
    ends = np.array(
        [[0, 0, 100, 0], [0, 0, 100, 0], [0, 5, 100, 5], [200, 5, 300, 5], [0, 0.5, 100, 0.5]], dtype=np.float64
    )
    image, line_of = np.array([0, 1, 1, 1, 1]), np.array([0, 0, 1, 2, 3])
    line = np.column_stack([np.zeros(5), np.ones(5), -ends[:, 1]])
    rows = np.argsort(line_of, kind="stable")
    pointers = np.searchsorted(line_of[rows], np.arange(5))
    tracks: Any = SimpleNamespace(
        views=SimpleNamespace(image_idx=image, ends=ends, line=line), table=lambda: (rows, pointers)
    )
    pairs = np.array([[0, 1], [1, 0], [0, 2], [0, 3]])
    assert _line_merge.seen_apart(tracks, pairs).tolist() == [True, True, False, False]
    assert _line_merge.seen_apart(tracks, pairs[:0]).tolist() == []


@pytest.mark.kernels
def test_intervals_are_in_all_bins_that_they_cover():
    """On a circle of five bins: inside one, across two, across the end, and more than once around."""
    members, pointers = in_bins(np.array([[0.2, 0.4], [1.5, 2.5], [4.5, 5.5], [3.0, 9.0]]), 1.0, 5)
    found = [members[a:b].tolist() for a, b in itertools.pairwise(pointers)]
    assert found == [[0, 2, 3], [1, 3], [1, 3], [3], [2, 3]]
    assert len(in_bins(np.zeros((0, 2)), 1.0, 5)[0]) == 0


def test_distinct_pairs():
    rng = np.random.default_rng(1)
    pairs = rng.integers(0, 9, (200, 2))
    found, counts = distinct_pairs(*pairs.T)
    expected, number = np.unique(pairs, axis=0, return_counts=True)
    assert np.array_equal(found, expected) and np.array_equal(counts, number)
    assert num_distinct(np.zeros(0, np.int64), np.zeros(0, np.int64), 3).tolist() == [0, 0, 0]
    assert num_distinct(np.array([2, 2, 2, 0]), np.array([7, 7, 1, 7]), 4).tolist() == [1, 0, 2, 0]


def test_landmarks_that_nothing_holds_are_left_out():
    truth = corridor("tiny", seed=0).truth
    relations = truth.relations
    few = Relations(
        point_on_plane=relations.point_on_plane[relations.point_on_plane[:, 1] == 1],
        line_on_plane=relations.line_on_plane[relations.line_on_plane[:, 1] == 1],
        line_along_direction=np.array([[0, 1], [1, 1], [2, 0]]),
    )
    directions = Directions(np.array([5, 7, 9]), np.eye(3))
    scene = truth.replace(relations=few, directions=directions)
    before = scene.replace(relations=Relations(point_on_plane=relations.point_on_plane))
    kept, also = without_unused(scene, before)
    assert kept.planes.ids.tolist() == [truth.planes.ids[1]]
    assert kept.directions.ids.tolist() == [7]
    assert kept.relations.line_along_direction.tolist() == [[0, 0], [1, 0]]
    assert kept.relations.point_on_plane[:, 0].tolist() == few.point_on_plane[:, 0].tolist()
    assert (also.num_planes, also.num_directions) == (1, 1)
    assert also.relations.point_on_plane[:, 0].tolist() == few.point_on_plane[:, 0].tolist()
    assert (kept.num_points, kept.num_lines) == (truth.num_points, truth.num_lines)
    # Points and lines without observations go, with what lies on them.
    unseen = scene.replace(line_observations=scene.line_observations.take(scene.line_observations.line_idx != 1))
    (kept,) = without_unused(unseen)
    assert kept.num_lines == truth.num_lines - 1
    assert kept.num_directions == 0
    assert without_unused(kept)[0] is kept or equal(without_unused(kept)[0], kept)


def line_map(counts, num_lines=0):
    """A map of one image with so many segments of each outcome."""
    outcomes = np.repeat(np.array(list(counts), np.int64), list(counts.values()))
    empty = {item: np.zeros(0) for item in ("segments", "image_idx", "segment_idx", "line_idx", "residual")}
    empty |= {item: np.zeros(0) for item in ("num_images", "median_residual", "uncertainty")}
    places = {"supporters": np.zeros((0, 0)), "rejection": np.zeros(0), "depth_ratios": np.zeros((0, 2))}
    return LineMap(lines=np.zeros((num_lines, 6)), **empty, outcomes=(outcomes,), neighbors=(), **places)


@pytest.mark.parametrize("outcome", list(WORDS))
def test_explanations_are_sentences_with_options_that_exist(outcome):
    text = explain(line_map({outcome: 3}))
    assert "3 (100 %) " + WORDS[outcome] in text
    flags = " ".join(str(item.annotation) for item in inspect.signature(map_).parameters.values())
    names = {"--" + name.replace("_", "-") for name in inspect.signature(map_).parameters}
    for option in re.findall(r"--[a-z-]+", REMEDIES.get(outcome, "")):
        assert option in names or option in flags
    assert "segments were" not in text and not re.search(r"[a-z]_[a-z]|Options", text)  # a command has no such names


def test_texture_is_left_out_on_purpose_so_the_remedy_is_that_of_the_next_reason():
    assert "What would help" not in explain(line_map({Outcome.TEXTURE: 9}))
    text = explain(line_map({Outcome.TEXTURE: 9, Outcome.UNCERTAIN: 2}))
    assert text.endswith("What would help most: photographs from further apart.")


def test_explanation_of_a_map_names_the_largest_groups_and_counts_the_rest():
    counts = {
        Outcome.MAPPED: 5000,
        Outcome.RECOVERED: 500,
        Outcome.NOT_LINKED: 900,
        Outcome.NO_SUPPORT: 800,
        Outcome.AMBIGUOUS: 700,
    }
    text = explain(
        line_map(counts | {Outcome.OUTLIER: 600, Outcome.UNCERTAIN: 20, Outcome.NO_MATCH: 10}, num_lines=1200)
    )
    head, rest = text.split(". ", 1)
    assert head == "1,200 lines from 5,500 of 8,530 segments in 1 image"
    assert rest.startswith("Of the segments on no line: 900 (11 %) had")
    assert "30 (under 1 %) were lost for other reasons" in text
    assert text.endswith("What would help most: more photographs of the same parts.")
    assert "empty" not in text


def test_explanation_counts_the_lines_of_the_map_first():
    mapped = line_map({Outcome.MAPPED: 50, Outcome.NO_MATCH: 30}, num_lines=12)
    assert explain(mapped).startswith("12 lines from 50 of 80 segments in 1 image. Of the segments on no line: 30")
    assert explain(mapped, 5, 0.5).startswith(
        "7 lines, of 12 from 50 of 80 segments in 1 image: 5, right with a probability below 0.5 "
        "(--min-confidence), are left out. Of the segments on no line: 30"
    )
    assert explain(mapped, 11, 0.8).startswith(
        "1 line, of 12 from 50 of 80 segments in 1 image: 11, right with a probability below 0.8 "
    )
    assert "(--min-confidence), is left out" in explain(mapped, 1, 0.8)
