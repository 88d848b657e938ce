# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a camera that was held on its side: the page shows them, and the scene, upright."""

import shutil

import cv2
import numpy as np
import pytest
from _pages import data_of, write_page
from _scene import exact_scene

from groma.geometry import se3
from groma.viz.report.page import write_report

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), "")


def write_on_its_side(path, picture) -> None:
    """Write a JPEG file whose EXIF says that a quarter turn to the right shows it upright."""
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    content = cv2.imencode(".jpg", picture)[1].tobytes()
    path.write_bytes(content[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + content[2:])


def test_photographs_taken_on_their_side_are_shown_upright(tmp_path):
    """What is up in the scene follows: the left of the photographs, as they are stored."""
    scene = exact_scene()
    for name in scene.images.names:
        write_on_its_side(tmp_path / name, np.full((480, 640, 3), 128, np.uint8))
    data = data_of(write_page(tmp_path, None, scene, images=tmp_path))
    assert [entry["turn"] for entry in data["images"]] == [1, 1]
    left = -se3.to_matrix(scene.cam_from_world)[:, 0, :3].sum(axis=0)
    np.testing.assert_allclose(data["view"]["up"], left / np.linalg.norm(left), atol=1e-12)
    assert [entry["turn"] for entry in data_of(write_page(tmp_path, None, scene))["images"]] == [0, 0]


@pytest.mark.skipif(not CHROMIUM, reason="needs Chromium")
def test_in_a_browser(tmp_path):
    """Its left, dark half is on top, in the strip too, and its segments are clicked where they are shown."""
    playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install playwright")
    scene, picture = exact_scene(), np.full((480, 640, 3), 255, np.uint8)
    picture[:, :320] = 0
    for name in scene.images.names:
        write_on_its_side(tmp_path / name, picture)
    write_report(tmp_path / "page.html", None, scene, images=tmp_path)
    with (
        playwright.sync_playwright() as program,
        program.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"]) as browser,
    ):
        page = browser.new_page(viewport={"width": 1300, "height": 1600})
        page.goto((tmp_path / "page.html").as_uri())
        page.wait_for_function("() => blend === target && pictureOf(0) && thumbs.every(t => t.bitmap)")
        page.select_option("#image", "0")
        page.evaluate(
            "() => { for (const name of ['segments', 'projected', 'points']) layers[name] = false; drawImage(); }"
        )
        for one in ("sheet", "thumbs[0].one.firstChild"):
            grey = f"v => {one}.getContext('2d').getImageData({one}.width / 2, v * {one}.height, 1, 1).data[0]"
            assert page.evaluate(grey, 0.2) < 60 and page.evaluate(grey, 0.8) > 200
        page.evaluate("() => { layers.segments = true; drawImage(); }")
        line, (u, v) = (
            int(scene.line_observations.line_idx[1]),
            scene.line_observations.segment[1].reshape(2, 2).mean(axis=0),
        )
        box = page.locator("#photo").bounding_box()
        scale = box["height"] / 640
        x, y = box["width"] / 2 - (v - 240) * scale, u * scale
        page.mouse.click(box["x"] + x, box["y"] + y)
        assert page.evaluate("[chosen.kind, chosen.index]") == ["line", line]
