# SPDX-License-Identifier: BSD-3-Clause
"""Tracks are values, filters name what they reject, and work per image keeps its order and can be ended."""

from dataclasses import fields, replace

import numpy as np
import pytest
from _wireframe import arc, random_lines, wireframe

from groma.mapping.lines.filtering.filters import FILTERS, Evidence, filtered, long_enough, seen_by_enough_images
from groma.mapping.lines.linking.tracks import Tracks
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.lines.outcomes import Outcome
from groma.mapping.lines.views import build_views


@pytest.fixture(scope="module")
def world():
    rng = np.random.default_rng(4)
    return wireframe(arc(5), random_lines(12, rng), rng)


@pytest.fixture(scope="module")
def tracks(world):
    views, line_of = build_views(world.scene, world.segments, 5.0, 0.1, 2.0), np.concatenate(world.truth)
    none = Tracks.none(views, np.full(len(line_of), Outcome.NOT_LINKED))
    zero = np.zeros(len(world.lines))
    stale = np.zeros(len(zero), bool)
    return replace(none, lines=world.lines, line_of=line_of, uncertainty=zero, unchecked=zero, stale=stale)


def evidence(tracks, **options):
    size = np.zeros((len(tracks.views.camera), 2), int)
    neighbors: list[np.ndarray] = [np.delete(np.arange(5), i) for i in range(5)]
    strength = np.ones(len(tracks.line_of))
    return Evidence(MapLinesOptions(min_repeatability=0.0, **options), neighbors, strength, size, tracks)


def arrays(tracks):
    return {
        item.name: getattr(tracks, item.name).copy() for item in fields(tracks) if item.name not in ("views", "gates")
    }


def test_filters_say_what_they_reject_and_why(tracks):
    lost = tracks.line_of == 3
    short = float(tracks.views.length[lost].max()) + 1e-6
    few = replace(tracks, line_of=np.where(lost & (tracks.views.image_idx > 1), -1, tracks.line_of))
    kept, reason = seen_by_enough_images(few, evidence(few))
    assert reason is Outcome.FEW_IMAGES and np.flatnonzero(~kept).tolist() == [3]
    after = few.keep(kept, reason)
    assert after.num_lines == few.num_lines - 1
    assert (after.outcomes()[few.line_of == 3] == Outcome.FEW_IMAGES).all()
    assert (after.outcomes()[few.line_of < 0] == Outcome.NOT_LINKED).all()
    kept, reason = long_enough(tracks, evidence(tracks, min_longest=short))
    assert reason is Outcome.SHORT_LINE and not kept[3]
    assert len({passes.__name__ for passes in FILTERS}) == 5


def test_every_segment_of_a_filtered_line_has_one_outcome(tracks):
    found = filtered(tracks, evidence(tracks, min_longest=60.0))
    outcomes = found.outcomes()
    assert ((outcomes == Outcome.RECOVERED) == (found.line_of >= 0)).all()  # none was linked by its own place
    assert 0 < found.num_lines < tracks.num_lines
    assert (outcomes[(tracks.line_of >= 0) & (found.line_of < 0)] != Outcome.NOT_LINKED).all()


def test_nothing_changes_tracks(tracks):
    before = arrays(tracks)
    again = tracks.refined()
    again.joined(np.zeros(again.num_lines, np.int64), np.full(again.num_lines, 0.1))
    again.keep(np.zeros(again.num_lines, bool), Outcome.UNCERTAIN)
    filtered(tracks, evidence(tracks))
    for name, array in arrays(tracks).items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)
