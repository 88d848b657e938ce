# SPDX-License-Identifier: BSD-3-Clause
"""The HTML page: self-contained, well-formed, safe against hostile names, and it holds the numbers it was given."""

import base64
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
from _pages import data_of, write_page
from _scene import exact_scene

from groma.cli.main import run
from groma.errors import InputError, OutputError
from groma.io import write_scene
from groma.scene import Directions, Planes, Relations, Scene
from groma.scene.synthetic.scenes import holistic
from groma.viz.drawable import drawable
from groma.viz.pictures import jpeg_address
from groma.viz.report import images as _page_images
from groma.viz.report import kept as _page_kept
from groma.viz.report.page import PageContents, write_report
from groma.viz.report.saved import saved_report
from groma.viz.report.tables import number_tables

REPORT = SimpleNamespace(
    history=[
        SimpleNamespace(iteration=0, cost=100.0, accepted=True),
        SimpleNamespace(iteration=1, cost=1.0, accepted=True),
    ],
    warnings=["Two points are <far> away."],
    termination=SimpleNamespace(sentence="Converged."),
    to_dict=lambda: {
        "initial_cost": 100.0,
        "final_cost": 1.0,
        "iterations": 1,
        "seconds": {"total": 0.5, "setup": 0.2, "solve": 0.3},
    },
)


def _floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4")


def _whole(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<i4")


def _noisy(scene: Scene) -> Scene:
    return scene.with_points(scene.points.xyz + np.random.default_rng(2).normal(size=scene.points.xyz.shape) * 0.02)


def test_the_page_needs_no_network(tmp_path):
    scene = exact_scene()
    text = write_page(tmp_path, _noisy(scene), scene, REPORT)
    without_data = re.sub(r'<script type="application/json".*?</script>', "", text, flags=re.DOTALL)
    assert not re.search(r"https?:|[\"'(]//|@import|url\(", without_data)
    assert not re.search(r"https?:", text)
    assert not re.search(r"<(link|iframe|img|object|embed)|<script[^>]* src", text)


def test_data_of_both_states(tmp_path):
    scene = exact_scene()
    data = data_of(write_page(tmp_path, _noisy(scene), scene, REPORT))
    before, after = data["states"]
    points = _floats(after["points"]).reshape(-1, 3)
    steps = points - scene.points.xyz
    np.testing.assert_allclose(steps - steps[0], 0, atol=1e-6)  # one offset for all
    assert not np.allclose(_floats(before["points"]), _floats(after["points"]))
    assert len(_floats(after["lines"])) == 4 * 6
    assert len(_floats(after["planes"])) == 3 * sum(data["planes"]["corners"]) >= 9
    assert len(_floats(after["cameras"])) == 2 * 12
    assert len(_floats(after["line_errors"])) == len(data["lines"]["colours"]) * 3 // 4 // 3 == 4
    assert _whole(data["lines"]["images"]).tolist() == [2] * 4
    assert _whole(data["points"]["images"]).tolist() == [2] * 12
    assert _whole(data["relations"]["point_on_plane"]).reshape(-1, 2).tolist() == [[k, 0] for k in range(5)]
    assert len(_floats(data["rows"])) == 24 * 6
    assert [entry["points_seen"] for entry in data["images"]] == [12, 12]


def test_numbers_and_warnings_are_shown(tmp_path):
    scene = exact_scene()
    text = write_page(tmp_path, _noisy(scene), scene, REPORT, title="A <title>")
    for words in (
        "Two points are &lt;far&gt; away.",
        "Converged.",
        "A &lt;title&gt;",
        "12 points",
        "4 lines",
        "1 plane,",
        "steps of the cameras",
    ):
        assert words in text


def test_a_single_scene(tmp_path):
    data = data_of(write_page(tmp_path, None, exact_scene()))
    assert len(data["states"]) == 1


def test_an_empty_scene(tmp_path):
    assert data_of(write_page(tmp_path, None, Scene()))["images"] == []


def test_large_scenes_are_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(_page_kept, "MAX_POINTS", 5)
    data = data_of(write_page(tmp_path, None, exact_scene()))
    assert len(_floats(data["states"][0]["points"])) == 5 * 3
    assert len(_floats(data["states"][0]["errors"])) == 5
    assert sorted(_whole(data["row_points"])) == sorted([*range(5)] * 2)  # of those that are left, all observations
    kept = _whole(data["points"]["ids"]).tolist()
    on_plane = _whole(data["relations"]["point_on_plane"]).reshape(-1, 2)[:, 0]
    assert [kept[row] for row in on_plane] == [number for number in exact_scene().points.ids[:5] if number in kept]


def test_different_scenes_are_refused(tmp_path):
    scene = exact_scene()
    with pytest.raises(InputError, match="scene_before and scene_after"):
        write_report(tmp_path / "page.html", scene.points_only(), scene)


def test_images_are_embedded(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "first.png"), np.full((480, 640, 3), 128, np.uint8))
    images = {"first.jpg": tmp_path / "first.png", "second.jpg": tmp_path / "missing.png"}
    entries = data_of(write_page(tmp_path, None, exact_scene(), images=images))["images"]
    assert entries[0]["photo"].startswith("data:image/jpeg;base64,")
    assert entries[1]["photo"] == ""


def test_segments_in_the_images(tmp_path):
    """What is drawn in a photograph: measured ends, ways to the image of the line, images of the 3D segments."""
    scene = exact_scene()
    data = data_of(write_page(tmp_path, None, scene))
    seen = scene.line_observations
    rows = _floats(data["segments"]).reshape(-1, 8)
    np.testing.assert_allclose(rows[:, :4], seen.segment, rtol=1e-6)
    np.testing.assert_allclose(rows[:, 4:], 0, atol=1e-6)
    projected = _floats(data["projected"]).reshape(len(rows), data["samples"], 2)
    assert data["samples"] > 2  # one of the cameras bends lines
    np.testing.assert_allclose(projected[:, [0, -1]].reshape(-1, 4), seen.segment, rtol=1e-5)
    assert (
        _whole(data["lines"]["ids"])[_whole(data["segment_lines"])].tolist() == scene.lines.ids[seen.line_idx].tolist()
    )
    first, second = data["images"]
    assert (first["segments"], second["segments"]) == ([0, 4], [4, 8])
    assert first["lines_seen"] == second["lines_seen"] == 4


def test_photographs_stand_in_the_order_of_their_names(tmp_path):
    """Whatever that of a model; what was measured in each goes with it."""
    scene = exact_scene()
    data = data_of(write_page(tmp_path, None, scene.replace(images=scene.images.replace(names=("10.jpg", "9.jpg")))))
    assert [(entry["name"], entry["camera"]) for entry in data["images"]] == [("9.jpg", 1), ("10.jpg", 0)]
    begin, end = data["images"][0]["segments"]
    seen = scene.line_observations.segment[scene.line_observations.image_idx == 1]
    np.testing.assert_allclose(_floats(data["segments"]).reshape(-1, 8)[begin:end, :4], seen, rtol=1e-6)


def test_lines_keep_all_their_segments_when_there_are_too_many(tmp_path, monkeypatch):
    monkeypatch.setattr(_page_kept, "MAX_SEGMENT_ROWS", 5)
    data = data_of(write_page(tmp_path, None, exact_scene()))
    owners = _whole(data["segment_lines"])
    assert len(owners) == 4 and sorted(np.bincount(owners).tolist())[-2:] == [2, 2]  # two lines with both segments
    assert len(_floats(data["projected"])) == 4 * 2 * data["samples"]
    assert [entry["lines_seen"] for entry in data["images"]] == [4, 4]


def test_planes_before_lie_on_the_planes_before(tmp_path):
    scene = exact_scene()
    tilt = np.array([[0.0, 0.6, 0.8, -0.1]])
    data = data_of(write_page(tmp_path, scene.replace(planes=scene.planes.replace(hesse=tilt)), scene))
    before, after = (_floats(state["planes"]).reshape(-1, 3).astype(float) for state in data["states"])
    assert np.ptp(before @ tilt[0, :3]) < 1e-6 and np.ptp(after[:, 2]) < 1e-6
    assert before.shape == after.shape


def test_tables_of_planes_and_directions(tmp_path):
    text = write_page(tmp_path, None, holistic(10, seed=2).truth)
    assert "<h2>Planes</h2>" in text and "<h2>Directions</h2>" not in text
    scene = exact_scene()
    along = scene.replace(
        directions=Directions([7, 9], [[1.0, 0, 0], [0.6, 0.8, 0]]),
        relations=Relations(line_along_direction=[[0, 0], [1, 0], [2, 1]]),
    )
    text = write_page(tmp_path, None, along)
    assert "<h2>Directions</h2>" in text and "53.1°" in text and ">to 7<" in text


def test_a_table_of_relations(tmp_path):
    """Of every kind that there is, rejected by the adjustment or not; and kinds that were all given up.

    A map leaves improbable lines out after its last adjustment, with relations that this kept.
    """
    scene = exact_scene().replace(relations=Relations(point_on_plane=[[0, 0]], lines_meeting=[[0, 1], [1, 2]]))
    outcomes = {"point_on_plane": {"held": 2, "dropped": 4}, "line_on_plane": {"held": 0, "dropped": 3}}
    text = number_tables(scene, None, drawable(scene), REPORT.to_dict() | {"relations": outcomes})
    rows = re.findall(r"<tr><td>([a-z ]+)</td><td>(\d*)</td><td>(\d*)</td></tr>", text)
    assert rows == [("point on plane", "1", "4"), ("line on plane", "0", "3"), ("lines meeting", "2", "")]
    bare = exact_scene().replace(relations=Relations())
    assert "<h2>Relations</h2>" not in number_tables(bare, None, drawable(bare), None)


def test_what_became_of_the_segments(tmp_path):
    outcomes = {"mapped": 60, "few_images": 40, "of_a_kind_to_come": 1, "outlier": 0}
    text = write_page(tmp_path, None, exact_scene(), contents=PageContents(outcomes, "4 lines from <60> segments."))
    assert "4 lines from &lt;60&gt; segments." in text
    for words in ("observes a line", "line in too few images", "of a kind to come", "59 %"):
        assert words in text
    assert "outlier of its line" not in text
    assert "What became" not in write_page(tmp_path, None, exact_scene())


def test_photographs_keep_to_their_budget(tmp_path):
    import cv2

    noise = np.random.default_rng(0).integers(0, 255, (900, 1200, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "first.jpg"), noise)
    cv2.imwrite(str(tmp_path / "second.jpg"), noise)
    photos = _page_images._photographs(["first.jpg", "missing.jpg", "second.jpg"], tmp_path).addresses()
    assert photos[1] == "" and all(photo.startswith("data:image/jpeg;base64,") for photo in photos[::2])
    assert all(len(jpeg_address(noise, budget)) <= 1.1 * budget for budget in (30_000, 100_000, 10_000_000))


def test_the_summary_of_a_map_stands_in_the_page(tmp_path):
    """A folder with a summary: `groma report` tells of the run; with photographs, they are embedded."""
    import cv2

    write_scene(exact_scene(), tmp_path / "map")
    (tmp_path / "photos").mkdir()
    cv2.imwrite(str(tmp_path / "photos" / "first.jpg"), np.full((480, 640, 3), 128, np.uint8))
    numbers = {
        **REPORT.to_dict(),
        "history": [{"iteration": 1, "cost": 1.0, "accepted": True, "stage": 1}],
        "termination_sentence": "It went well.",
        "warnings": ["Mind the gap."],
        "segments": {"mapped": 3},
        "explanation": "Three of three.",
    }
    (tmp_path / "map" / "summary.json").write_text(json.dumps(numbers))
    page = tmp_path / "page.html"
    assert run(["report", str(tmp_path / "map"), "-o", str(page), "--images", str(tmp_path / "photos")]) == 0
    text = page.read_text(encoding="utf-8")
    for words in ("It went well.", "Mind the gap.", "Three of three.", "Convergence"):
        assert words in text
    assert [bool(entry["photo"]) for entry in data_of(text)["images"]] == [True, False]
    assert _floats(data_of(text)["lines"]["confidence"]).tolist() == [-1] * 4  # a COLMAP model does not know it
    sure = exact_scene()
    write_scene(sure.replace(lines=sure.lines.replace(confidence=np.full(4, 0.5))), tmp_path / "map" / "scene.npz")
    assert run(["report", str(tmp_path / "map"), "-o", str(page), "-f"]) == 0
    assert _floats(data_of(page.read_text(encoding="utf-8"))["lines"]["confidence"]).tolist() == [0.5] * 4
    assert run(["report", str(tmp_path / "map"), "-o", str(page), "-f", "--images", str(tmp_path / "none")]) != 0
    for content in ("no json", "[]"):
        (tmp_path / "map" / "summary.json").write_text(content)
        with pytest.warns(UserWarning, match="summary.json is damaged"):
            assert saved_report(tmp_path / "map") is None
    (tmp_path / "map" / "summary.json").write_text('{"history": []}')
    assert saved_report(tmp_path / "map") is None


def test_a_place_that_cannot_be_written(tmp_path):
    (tmp_path / "no").touch()
    with pytest.raises(OutputError, match="Cannot write"):
        write_report(tmp_path / "no" / "page.html", None, exact_scene())


def test_what_the_data_determine(tmp_path):
    """Findings and counts of a diagnosis, given or among the numbers of a saved report; relations are a table."""
    found = {
        "findings": [
            {"severity": "problem", "sentence": "Line <7> is open."},
            {"severity": "note", "sentence": "All else holds."},
        ],
        "observability": {"lines": {"determined": 1234, "weak": 5, "undetermined": 1}},
    }
    text = write_page(tmp_path, None, exact_scene(), contents=PageContents(diagnosis=found))
    for words in ("What the data determine", 'class="is-problem">Line &lt;7&gt; is open.', 'class="is-note">', "1,234"):
        assert words in text
    assert text.index("is-problem") < text.index('class="is-note"')
    numbers = REPORT.to_dict() | {
        "history": [], "termination_sentence": "", "diagnosis": found,
        "relations": {"point_on_plane": {"held": 12, "dropped": 5678}},
    }  # fmt: skip
    (tmp_path / "summary.json").write_text(json.dumps(numbers))
    text = write_page(tmp_path, None, exact_scene(), saved_report(tmp_path))
    assert "is-problem" in text and "point on plane" in text and "5,678" in text
    text = write_page(tmp_path, None, exact_scene(), REPORT)
    assert "What the data determine" not in text and "5,678" not in text


def test_the_first_image_is_the_one_with_most_lines(tmp_path):
    scene = exact_scene()
    seen = scene.line_observations
    scene = scene.replace(line_observations=seen.take(np.flatnonzero((seen.image_idx == 1) | (seen.line_idx == 0))))
    assert data_of(write_page(tmp_path, None, scene))["first"] == 1
    assert data_of(write_page(tmp_path, None, scene.points_only()))["first"] == 0
    assert _page_images._first([]) == 0
    # one with a photograph comes before one without
    entries = [
        {"photo": photo, "lines_seen": n, "points_seen": 0} for photo, n in (("", 9), ("data:", 2), ("data:", 3))
    ]
    assert _page_images._first(entries) == 2


def test_planes_with_nothing_on_them_are_counted_not_listed(tmp_path):
    scene = exact_scene()
    both = scene.replace(planes=Planes([1, 77], np.concatenate([scene.planes.hesse, [[1.0, 0.0, 0.0, 2.0]]])))
    text = write_page(tmp_path, None, both)
    assert "Not listed: 1 plane with nothing of this scene on them." in text and "</i>77</td>" not in text
    nothing = scene.replace(relations=Relations())
    assert "<h2>Planes</h2>" not in write_page(tmp_path, None, nothing)
