# SPDX-License-Identifier: BSD-3-Clause
"""A page shows what it is given and runs nothing of it: names, photographs outside the folder, damaged summaries."""

import base64
import hashlib
import json
import re

import pytest
from _pages import data_of, write_page, write_pictures
from _scene import exact_scene

from groma.scene.synthetic.scenes import holistic
from groma.viz.report.page import write_report
from groma.viz.report.saved import saved_report


@pytest.mark.parametrize("name", ["</script><script>alert(1)</script>", "<img src=x onerror=alert(1)>", "a&b\"c'.jpg"])
def test_hostile_names_stay_text(tmp_path, name):
    text = write_page(tmp_path, None, exact_scene(names=(name, "b.jpg")), title=name)
    assert name not in text
    assert text.count("<script") == 2
    assert data_of(text)["images"][0]["name"] == name


def test_names_like_placeholders_stay_text(tmp_path):
    text = tmp_path / "page.html"
    write_report(text, None, exact_scene(), title="{{DATA}}")
    assert "<h1>{{DATA}}</h1>" in text.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["../secret.jpg", "a/../../secret.jpg", "ABSOLUTE", "in/../../secret.jpg"])
def test_photographs_outside_the_folder_are_not_embedded(tmp_path, name):
    write_pictures(tmp_path, "secret.jpg", "photos/second.jpg")
    name = str(tmp_path / "secret.jpg") if name == "ABSOLUTE" else name
    scene = exact_scene((name, "second.jpg"))
    with pytest.warns(UserWarning, match=r"1 image of the scene not shown.*secret\.jpg"):
        write_report(tmp_path / "page.html", None, scene, images=tmp_path / "photos")
    shown = {entry["name"]: entry["photo"] for entry in data_of((tmp_path / "page.html").read_text())["images"]}
    assert shown[name] == "" and shown["second.jpg"].startswith("data:image/jpeg")


def test_the_page_may_run_its_own_script_and_nothing_else(tmp_path):
    write_report(tmp_path / "page.html", None, exact_scene())
    text = (tmp_path / "page.html").read_text()
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)[1]
    script = re.search(r"<script>(.*?)</script>", text, re.DOTALL)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy.startswith(f"default-src 'none'; script-src 'sha256-{digest}'; ")
    assert "http" not in policy and "unsafe-eval" not in policy
    assert not re.search(r"<[^>]* on[a-z]+=", text.partition("<script>")[0])  # the policy would not let them run


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: "[" * 100_000,
        lambda text: text[: len(text) // 2],
        lambda text: text.replace('"iterations": ', '"iterations": "<script>", "x": '),
        lambda text: text.replace('"held": ', '"held": NaN, "x": '),
        lambda text: text.replace('"history": ', '"history": 5, "x": '),
        lambda text: text.replace('"initial_cost": ', '"initial_cost": 1e-300, "x": '),
    ],
)
def test_a_damaged_summary_is_left_out_and_told(tmp_path, damage):
    from groma.adjustment.adjust import AdjustOptions, adjust

    good = json.dumps(adjust(holistic(4, seed=1).start, AdjustOptions(max_iterations=1)).summary())
    (tmp_path / "summary.json").write_text(good)
    assert saved_report(tmp_path) is not None
    (tmp_path / "summary.json").write_text(damage(good))
    with pytest.warns(UserWarning, match="summary.json is damaged"):
        assert saved_report(tmp_path) is None
