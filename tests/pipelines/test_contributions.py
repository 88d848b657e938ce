# SPDX-License-Identifier: BSD-3-Clause
"""What each kind contributes: the kinds that are there, in order, and better poses with more of them."""

import json
from itertools import pairwise

import numpy as np
import pytest

import groma
from groma.cli.main import run
from groma.pipelines.contributions import KINDS, contributions
from groma.scene import Relations, synthetic
from groma.viz._page_tables import contributions_card

pytestmark = pytest.mark.kernels

OPTIONS = groma.AdjustOptions(loss="none", threads=1)


@pytest.fixture(scope="module")
def scenes():
    return synthetic.holistic(20, noise_px=1.0, seed=3)


@pytest.fixture(scope="module")
def found(scenes):
    return contributions(scenes.start, OPTIONS, scenes.truth)


def test_every_kind_adds_something(found, scenes):
    assert tuple(entry.added for entry in found) == KINDS
    relations = scenes.start.relations
    assert [entry.num_relations for entry in found] == [
        0,
        0,
        len(relations) - len(relations.point_on_line),
        len(relations),
    ]
    assert found[0].moved == 0.0
    assert all(entry.moved > 1e-5 for entry in found[1:])
    assert list(found[0].rmse_px) == ["points"]
    assert list(found[1].rmse_px) == ["points", "lines"]


def test_more_is_more_certain_and_nearer_to_the_truth(found):
    sigmas = [entry.center_sigma for entry in found]
    assert all(b < a for a, b in pairwise(sigmas))
    assert found[-1].center_error < found[0].center_error
    for entry in found:  # one is seen from the first camera and a median, the other from all of them and an rms
        assert 0.2 < entry.center_error / entry.center_sigma < 2.0


def test_each_entry_is_the_adjustment_itself(scenes, found):
    plain = groma.adjust(
        scenes.start.replace(relations=Relations()), groma.AdjustOptions(loss="none", planes=False, threads=1)
    )
    assert found[1].rmse_px == {name: values["after"] for name, values in plain.report.rmse_px.items()}
    assert found[1].iterations == plain.report.solve.iterations


def test_kinds_that_are_not_there_are_left_out(scenes):
    bare = scenes.start.points_only()
    assert [entry.added for entry in contributions(bare, OPTIONS)] == ["points"]
    with pytest.raises(groma.InputError, match="points alone"):
        contributions(scenes.start, groma.AdjustOptions(points=False))


def test_command_says_shows_and_writes_them(tmp_path, scenes, capsys):
    start, page, numbers = tmp_path / "start.npz", tmp_path / "page.html", tmp_path / "numbers.json"
    groma.write_scene(scenes.start, start)
    groma.write_scene(scenes.truth, tmp_path / "truth.npz")
    words = ["adjust", str(start), "--loss", "none", "--no-diagnosis", "--threads", "1"]
    assert run([*words, "--truth", str(tmp_path / "truth.npz")]) == 1
    assert "--contributions" in capsys.readouterr().err
    words += ["--contributions", "--truth", str(tmp_path / "truth.npz"), "--report", str(page), "--json", str(numbers)]
    assert run(words) == 0
    said = capsys.readouterr()
    assert "With and without" in said.out + said.err
    entries = json.loads(numbers.read_text())["contributions"]
    assert [entry["added"] for entry in entries] == list(KINDS)
    text = page.read_text()
    assert "With and without" in text and "and points on lines" in text
    assert f"{entries[-1]['center_error']:.3f}" in text


def test_card_leaves_out_what_is_not_known():
    entry = {
        "added": "points", "num_landmarks": 10, "num_relations": 0, "num_dropped": 0, "rmse_px": {"points": 0.5},
        "moved": 0.0, "center_sigma": None, "center_error": None, "rotation_error_deg": None, "iterations": 3,
    }  # fmt: skip
    text = contributions_card([entry, {**entry, "added": "lines", "rmse_px": {"points": 0.5, "lines": np.pi}}])
    assert "predicted</th>" not in text and "centre error" not in text
    assert "3.142" in text and "–" in text
    assert contributions_card([]) == contributions_card(None) == ""
