# SPDX-License-Identifier: BSD-3-Clause
"""Photographs of a camera that was held on its side: page and viewer show them, and the scene, upright."""

import re
import shutil

import cv2
import numpy as np
import pytest
from _pages import data_of, write_page
from _scene import exact_scene

from groma.geometry import quaternion, se3
from groma.viz.report.page import write_report
from groma.viz.viewer.content import view_content
from groma.viz.viewer.messages import describe_line

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


def test_the_viewer_shows_them_upright_too(tmp_path):
    scene = exact_scene()
    for name in scene.images.names:
        write_on_its_side(tmp_path / name, np.full((480, 640, 3), 128, np.uint8))
    plain, turned = view_content(scene), view_content(scene, tmp_path)
    left = -quaternion.to_matrix(turned.camera_wxyz[:, [1, 2, 3, 0]])[..., 0]
    mean = left.sum(axis=0)
    np.testing.assert_allclose(mean / np.linalg.norm(mean), [0, 0, 1], atol=1e-12)
    for image in (0, 1):  # a view from a camera has the left of its photograph on top, and its width as height
        wxyz, opening = turned.upright_from(image)
        axes = quaternion.to_matrix(wxyz[None, [1, 2, 3, 0]])[0]
        np.testing.assert_allclose(-axes[:, 1], left[image], atol=1e-12)
        assert np.isclose(np.tan(opening / 2), turned.camera_aspects[image] * np.tan(turned.camera_openings[image] / 2))
        assert np.array_equal(plain.upright_from(image)[0], plain.camera_wxyz[image])
    # So have the pieces of photographs around the segments of a line; white are the images of the line itself.
    (tmp_path / "lying").mkdir()
    for name in scene.images.names:
        cv2.imwrite(str(tmp_path / "lying" / name), np.full((480, 640, 3), 128, np.uint8))
    lying, upright = (
        np.array(re.findall(r'd="M(\S+) (\S+) (\S+) (\S+)"', describe_line(content, 1, tmp_path / folder)), float)
        for content, folder in ((plain, "lying"), (turned, ""))
    )
    assert len(lying) == 4  # in two photographs
    expected = np.stack([480 - lying[:, 1], lying[:, 0], 480 - lying[:, 3], lying[:, 2]], axis=1)
    np.testing.assert_allclose(upright, expected, atol=0.11)  # written to 0.1


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
