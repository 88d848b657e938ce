# SPDX-License-Identifier: BSD-3-Clause
"""``groma view --live`` in a real browser: the picture, the status and the timeline appear, and switches work.

Needs Chromium and Playwright (its Python package; the browser is that of the system). Drawing without a graphics card
takes 17 seconds of a processor; ``test_live.py`` shows what the server sends.
"""

import shutil

import numpy as np
import pytest
from _scene import exact_scene

from groma.io import write_scene
from groma.viz.viewer import live

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), "")
playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install playwright")
pytestmark = [pytest.mark.slow, pytest.mark.skipif(not CHROMIUM, reason="needs Chromium")]


def test_a_running_track_in_the_browser(tmp_path):
    work = tmp_path / "out.work"
    work.mkdir()
    (work / "frames.txt").write_text("".join(f"{0.1 * k} 0.1 0 {k} 0 0 0 1 0\n" for k in range(4)))
    (work / "statuses.txt").write_text("0.0 tracked 200 30 2 1\n0.1 tracked 190 31 2 0\n0.2 weak 9 1 0 0\n")
    picture = np.full((120, 160), 90, np.uint8)
    np.savez(work / "now.npz", picture=picture, points=[[40.0, 60.0]], segments=[[10.0, 10.0, 150.0, 100.0]])
    write_scene(exact_scene(), work / "scene.npz")
    with live.following(tmp_path / "out", port=0) as view, playwright.sync_playwright() as program:
        browser = program.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        )
        page = browser.new_page(viewport={"width": 1100, "height": 900})
        page.goto(f"http://localhost:{view.server.get_port()}")
        page.get_by_text("Waiting for").wait_for()
        view.refresh()
        page.get_by_text("9 points, 1 line, 0 planes agree").wait_for()
        bars = page.locator("svg rect[fill='#1f6fb5'], svg rect[fill='#e8a33a']")
        bars.first.wait_for()
        assert bars.count() == 3
        page.wait_for_function("[...document.images].some(one => one.naturalWidth === 160)")
        assert view.shown["points"].value
        page.get_by_role("checkbox", name="Points").click()
        for _ in range(100):
            if not view._nodes["points"][0].visible:
                break
            page.wait_for_timeout(50)
        assert not view.shown["points"].value
        assert not view._nodes["points"][0].visible
        browser.close()
