# SPDX-License-Identifier: BSD-3-Clause
"""What each kind contributes: the kinds that are there, in order, and better poses with more of them."""

import json
import re
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import groma
from groma.adjustment.contributions import KINDS, contributions
from groma.cli.main import run
from groma.cli.shared.console import Console
from groma.cli.shared.sentences import say_contributions
from groma.scene import Planes, Relations, Similarity, synthetic
from groma.viz.report.charts import spreads
from groma.viz.report.tables import contributions_card

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
    assert all(not entry.center_sigma_missing and not entry.num_undetermined for entry in found)
    assert found[0].moved_percentiles == (0.0,) * 5
    for entry in found[1:]:
        assert entry.moved_percentiles[2] == pytest.approx(entry.moved)
    for entry in found:
        assert all(a <= b for a, b in pairwise(entry.center_error_percentiles))
        assert entry.center_error_percentiles[1] < entry.center_error < entry.center_error_percentiles[4]


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
    assert found[1].rmse_px == {name: told["rmse_px"]["after"] for name, told in plain.report.inliers.items()}
    assert found[1].iterations == plain.report.solve.iterations


def test_kinds_that_are_not_there_are_left_out(scenes):
    bare = scenes.start.points_only()
    assert [entry.added for entry in contributions(bare, OPTIONS)] == ["points"]
    with pytest.raises(groma.InputError, match="point-only"):
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
    assert "By kind of landmark" in said.out and "and points on lines" in said.out
    entries = json.loads(numbers.read_text())["contributions"]
    assert [entry["added"] for entry in entries] == list(KINDS)
    text = page.read_text()
    assert "With and without" in text and "+ points on lines" in text
    assert f"{entries[-1]['center_error']:.3f}" in text


def test_lengths_are_in_units_of_the_reference(scenes, found):
    tenfold = scenes.truth.transformed(Similarity(10.0, translation=np.array([1.0, 2.0, 3.0])))
    for entry, before in zip(contributions(scenes.start, OPTIONS, tenfold), found, strict=True):
        for name in ("moved", "moved_percentiles", "center_sigma", "center_error", "center_error_percentiles"):
            np.testing.assert_allclose(getattr(entry, name), 10 * np.array(getattr(before, name)), rtol=1e-6)
        assert entry.rotation_error_deg == pytest.approx(before.rotation_error_deg)


def test_open_landmarks_are_counted_and_do_no_harm(scenes, found):
    """Thirty planes through two points each: they can turn, and the centres are known as without them."""
    start, rng = scenes.start, np.random.default_rng(4)
    first, second = rng.permutation(start.num_points)[:60].reshape(2, 30)
    a, b = start.points.xyz[first], start.points.xyz[second]
    normal = np.cross(a - b, rng.normal(size=(30, 3)))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    hesse = np.column_stack([normal, -np.einsum("ni,ni->n", normal, a)])
    old, count = start.planes, start.num_planes
    planes = Planes(np.append(old.ids, old.ids.max() + 1 + np.arange(30)), np.vstack([old.hesse, hesse]))
    on = np.column_stack([np.concatenate([first, second]), np.tile(count + np.arange(30), 2)])
    relations = replace(start.relations, point_on_plane=np.vstack([start.relations.point_on_plane, on]))
    entries = contributions(start.replace(planes=planes, relations=relations), OPTIONS)
    assert [entry.num_undetermined for entry in entries] == [{}, {}, {"planes": 30}, {"planes": 30}]
    for entry, before in zip(entries, found, strict=True):
        assert entry.center_sigma == pytest.approx(before.center_sigma, rel=0.02)


def test_what_is_not_predicted_is_explained(scenes, capsys):
    (entry,) = contributions(scenes.start.points_only(), replace(OPTIONS, refine_poses=False))
    assert entry.center_sigma is None and "held" in entry.center_sigma_missing
    assert "Not predicted: " in contributions_card([entry.to_dict()])
    say_contributions(Console(False, False, None), [entry.to_dict()])
    assert f"Centres not predicted with points: {entry.center_sigma_missing}" in capsys.readouterr().out


def test_card_leaves_out_what_is_not_known():
    entry = {
        "added": "points", "num_landmarks": 10, "num_relations": 0, "num_dropped": 0, "rmse_px": {"points": 0.5},
        "moved": 0.0, "moved_percentiles": (0.0,) * 5, "center_sigma": None, "center_sigma_missing": "",
        "center_error": None, "center_error_percentiles": None, "rotation_error_deg": None, "iterations": 3,
    }  # fmt: skip
    moved = {**entry, "added": "lines", "moved": 0.03, "moved_percentiles": (0.01, 0.02, 0.03, 0.04, 0.05)}
    text = contributions_card([entry, {**moved, "rmse_px": {"points": 0.5, "lines": np.pi}}])
    assert "<td>predicted" not in text and "<td>error" not in text
    assert "3.142" in text and "–" in text
    assert text.count("<svg") == 1 and "from the point-only result" in text
    assert contributions_card([]) == contributions_card(None) == ""


def test_picture_holds_what_it_shows():
    rows = [("points", (0.1, 0.2, 0.3, 0.4, 0.7), 0.9), ("+ lines", (0.0, 0.0, 0.0, 0.0, 0.0), None)]
    picture = spreads(rows, "distance")
    places = [float(number) for number in re.findall(r' (?:x|x1|x2|cx)="([-0-9.]+)"', picture)]
    assert 0 <= min(places) and max(places) <= 560
    assert picture.count("<circle") == 1 and "predicted 0.9" in picture
    ticks = [float(number) for number in re.findall(r">([0-9.]+)</text>", picture)]
    assert ticks[0] == 0.0 and ticks[-1] >= 0.9 and 4 <= len(ticks) <= 7
    assert "nan" not in spreads([("points", (0.0,) * 5, None)], "distance")
