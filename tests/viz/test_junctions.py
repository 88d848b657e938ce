# SPDX-License-Identifier: BSD-3-Clause
"""Places where lines meet, as viewer and report have them."""

import base64
from dataclasses import replace

import numpy as np
import pytest
from _pages import data_of, write_page
from _scene import exact_scene

from groma.scene import Lines
from groma.viz.drawable import junctions
from groma.viz.viewer.content import view_content
from groma.viz.viewer.messages import describe_line
from groma.viz.viewer.scene import serving


@pytest.fixture(scope="module")
def scene():
    """Lines 1 and 2 pass each other at a distance of 0.1, lines 2 and 3 meet."""
    exact = exact_scene()
    ends = exact.lines.segments.copy()
    ends[1] = [[-1.0, 0.0, 0.0], [0.5, 0.0, 0.0]]
    ends[2] = [[0.3, -1.0, 0.1], [0.3, 0.4, 0.1]]
    ends[3] = [[0.3, 0.4, 0.1], [0.9, 0.4, 0.5]]
    relations = replace(exact.relations, lines_meeting=np.array([[1, 2], [2, 3]]))
    return exact.replace(lines=Lines.through(ends, exact.lines.ids), relations=relations)


TRUE = np.array([[0.3, 0.0, 0.05], [0.3, 0.4, 0.1]])


def test_a_junction_is_half_way_between_its_lines(scene):
    np.testing.assert_allclose(junctions(scene.lines.segments, scene.relations.lines_meeting), TRUE, atol=1e-12)
    assert junctions(scene.lines.segments, np.zeros((0, 2), np.int64)).shape == (0, 3)


def test_the_viewer_draws_them_and_marks_the_lines_that_a_line_meets(scene):
    content = view_content(scene)
    np.testing.assert_allclose(content.view_from_world.inverse().points(content.junctions), TRUE, atol=1e-9)
    assert [content.lines_met(line).tolist() for line in range(4)] == [[], [2], [1, 3], [2]]
    ids = scene.lines.ids
    assert f"meets line {ids[1]}, {ids[3]}" in describe_line(content, 2)
    assert "meets" not in describe_line(content, 0)
    with serving(scene, port=0) as view:
        find = view.server.scene.get_handle_by_name
        assert find("/junctions") is not None and find("/junctions").visible is False
        view.shown["junctions"].value = True
        assert find("/junctions").visible is True
        view.select(2)
        assert find("/selection/met") is not None
        view.select(0)
        assert find("/selection/met") is None
    with serving(exact_scene(), port=0) as view:
        assert view.server.scene.get_handle_by_name("/junctions") is None


def test_the_page_has_them_in_both_states(tmp_path, scene, monkeypatch):
    moved = scene.replace(lines=Lines.through(scene.lines.segments + np.array([0.0, 0.0, 0.2]), scene.lines.ids))
    data = data_of(write_page(tmp_path, moved, scene))
    places = [unpacked(state["junctions"], np.float32).reshape(-1, 3) + data["offset"] for state in data["states"]]
    np.testing.assert_allclose(places, [TRUE + np.array([0.0, 0.0, 0.2]), TRUE], atol=1e-6)
    assert unpacked(data["junctions"], np.int32).tolist() == [1, 2, 2, 3]
    # Where lines are left out, junctions have both of theirs.
    monkeypatch.setattr("groma.viz.report.kept.MAX_LINES", 2)
    fewer = data_of(write_page(tmp_path, None, scene))
    kept = unpacked(fewer["lines"]["ids"], np.int32).tolist()
    assert len(kept) == 2
    pairs = unpacked(fewer["junctions"], np.int32).reshape(-1, 2)
    whole = [pair for pair in scene.lines.ids[scene.relations.lines_meeting].tolist() if set(pair) <= set(kept)]
    assert [[kept[one] for one in pair] for pair in pairs] == whole


def unpacked(text, dtype):
    return np.frombuffer(base64.b64decode(text), dtype)
