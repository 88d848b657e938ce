# SPDX-License-Identifier: BSD-3-Clause
"""The HTML page: self-contained, well-formed, safe against hostile names, and it holds the numbers it was given."""

import base64
import json
import re
from html.parser import HTMLParser
from types import SimpleNamespace

import numpy as np
import pytest
from _scene import exact_scene

from groma.errors import InputError, OutputError
from groma.scene import Scene
from groma.viz import report as report_module
from groma.viz.report import write_report

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


class Balance(HTMLParser):
    """Checks that elements are closed in the order in which they were opened."""

    VOID = frozenset({"meta", "input", "br", "link", "line", "rect", "circle", "path"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        if tag in self.VOID:
            return
        # These may be left open in HTML.
        while self.open and self.open[-1] != tag and self.open[-1] in ("option", "p", "rect"):
            self.open.pop()
        assert self.open.pop() == tag


def _write(tmp_path, *args, **kwargs) -> str:
    write_report(tmp_path / "page.html", *args, **kwargs)
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    parser = Balance()
    parser.feed(text)
    assert parser.open == []
    assert "{{" not in text
    return text


def _data(text: str) -> dict:
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[1])


def _floats(text: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4")


def _noisy(scene: Scene) -> Scene:
    return scene.with_points(scene.points.xyz + np.random.default_rng(2).normal(size=scene.points.xyz.shape) * 0.02)


def test_the_page_needs_no_network(tmp_path):
    scene = exact_scene()
    text = _write(tmp_path, _noisy(scene), scene, REPORT)
    without_data = re.sub(r'<script type="application/json".*?</script>', "", text, flags=re.DOTALL)
    assert not re.search(r"https?:|[\"'(]//|@import|url\(", without_data)
    assert not re.search(r"https?:", text)
    assert not re.search(r"<(link|iframe|img|object|embed)|<script[^>]* src", text)


def test_data_of_both_states(tmp_path):
    scene = exact_scene()
    data = _data(_write(tmp_path, _noisy(scene), scene, REPORT))
    before, after = data["states"]
    points = _floats(after["points"]).reshape(-1, 3)
    steps = points - scene.points.xyz
    np.testing.assert_allclose(steps - steps[0], 0, atol=1e-6)  # one offset for all
    assert not np.allclose(_floats(before["points"]), _floats(after["points"]))
    assert len(_floats(after["lines"])) == 4 * 6
    assert len(_floats(after["planes"])) == 12
    assert len(_floats(after["cameras"])) == 2 * 12
    assert len(_floats(data["residuals"])) == 40 * 6
    assert [entry["count"] for entry in data["images"]] == [20, 20]


def test_numbers_and_warnings_are_shown(tmp_path):
    scene = exact_scene()
    text = _write(tmp_path, _noisy(scene), scene, REPORT, title="A <title>")
    for words in (
        "Two points are &lt;far&gt; away.",
        "Converged.",
        "A &lt;title&gt;",
        "12 points",
        "4 lines",
        "1 plane,",
    ):
        assert words in text


def test_a_single_scene(tmp_path):
    data = _data(_write(tmp_path, None, exact_scene()))
    assert len(data["states"]) == 1


@pytest.mark.parametrize("name", ["</script><script>alert(1)</script>", "<img src=x onerror=alert(1)>", "a&b\"c'.jpg"])
def test_hostile_names_stay_text(tmp_path, name):
    text = _write(tmp_path, None, exact_scene(names=(name, "b.jpg")), title=name)
    assert name not in text
    assert text.count("<script") == 2
    assert _data(text)["images"][0]["name"] == name


def test_names_like_placeholders_stay_text(tmp_path):
    text = tmp_path / "page.html"
    write_report(text, None, exact_scene(), title="{{DATA}}")
    assert "<h1>{{DATA}}</h1>" in text.read_text(encoding="utf-8")


def test_an_empty_scene(tmp_path):
    assert _data(_write(tmp_path, None, Scene()))["images"] == []


def test_large_scenes_are_thinned(tmp_path, monkeypatch):
    monkeypatch.setattr(report_module, "MAX_POINTS", 5)
    data = _data(_write(tmp_path, None, exact_scene()))
    assert len(_floats(data["states"][0]["points"])) == 5 * 3
    assert len(_floats(data["states"][0]["errors"])) == 5


def test_different_scenes_are_refused(tmp_path):
    scene = exact_scene()
    with pytest.raises(InputError, match="scene_before and scene_after"):
        write_report(tmp_path / "page.html", scene.points_only(), scene)


def test_images_are_embedded(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "first.png"), np.full((480, 640, 3), 128, np.uint8))
    images = {"first.jpg": tmp_path / "first.png", "second.jpg": tmp_path / "missing.png"}
    entries = _data(_write(tmp_path, None, exact_scene(), images=images))["images"]
    assert entries[0]["picture"].startswith("data:image/jpeg;base64,")
    assert entries[1]["picture"] == ""


def test_a_place_that_cannot_be_written(tmp_path):
    with pytest.raises(OutputError, match="Cannot write"):
        write_report(tmp_path / "no" / "page.html", None, exact_scene())
