# SPDX-License-Identifier: BSD-3-Clause
"""The page of a report in a real browser: what is clicked lights up everywhere, search, measuring, a phone, no WebGL.

Needs Chromium and Playwright (its Python package; the browser is that of the system).
"""

import shutil
from dataclasses import replace

import numpy as np
import pytest
from _scene import exact_scene, localized_photograph, random_covariances

from groma.localization.result import card_of
from groma.viz.report.page import PageContents, write_report

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), "")
playwright = pytest.importorskip("playwright.sync_api", reason="needs Playwright: pip install playwright")
pytestmark = pytest.mark.skipif(not CHROMIUM, reason="needs Chromium")

ORANGE = """name => {
  const one = document.getElementById(name), flat = document.createElement("canvas");
  flat.width = one.width; flat.height = one.height;
  const c = flat.getContext("2d"); c.drawImage(one, 0, 0);
  const d = c.getImageData(0, 0, flat.width, flat.height).data;
  let count = 0;
  for (let i = 0; i < d.length; i += 4)
    if (Math.abs(d[i] - 240) < 15 && Math.abs(d[i + 1] - 138) < 15 && d[i + 2] < 25 && d[i + 3] > 128) count++;
  return count;
}"""
#: The pixel of the window where a place of the scene is drawn.
WHERE = """([x, y, z]) => {
  paint(); const p = view.project(x, y, z), box = canvas.getBoundingClientRect();
  return [box.left + p[0] / ratio, box.top + p[1] / ratio];
}"""

#: The fragment of a page without WebGL, which takes seconds without a graphics card.
FLAT = "#canvas"


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as program:
        found = program.chromium.launch(
            executable_path=CHROMIUM,
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
        )
        yield found
        found.close()


@pytest.fixture(scope="module")
def scene():
    """Two of its lines are said to meet."""
    exact = exact_scene()
    return exact.replace(relations=replace(exact.relations, lines_meeting=np.array([[1, 3]])))


@pytest.fixture(scope="module")
def covariances(scene):
    return random_covariances()


@pytest.fixture(scope="module")
def report(tmp_path_factory, scene, covariances):
    import cv2

    folder = tmp_path_factory.mktemp("report")
    for name in scene.images.names:
        cv2.imwrite(str(folder / name), np.full((480, 640, 3), 120, np.uint8))
    contents = PageContents(cards=card_of([localized_photograph()]), covariances=covariances)
    write_report(folder / "page.html", None, scene, images=folder, contents=contents)
    return (folder / "page.html").as_uri()


@pytest.fixture
def opened(browser, report):
    """Open the page; its complaints fail the test."""
    complaints, contexts = [], []

    def open_page(fragment: str = "", **options):
        contexts.append(browser.new_context(**({"viewport": {"width": 1300, "height": 1000}} | options)))
        page = contexts[-1].new_page()
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda message: complaints.append(message.text) if message.type == "error" else None)
        page.goto(report + fragment)
        page.wait_for_function("blend === target")
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert complaints == []


def _middle(scene, line: int) -> np.ndarray:
    return scene.lines.segments[line].mean(axis=0)


def _in_page(page, place) -> list[float]:
    """A place of the world in the coordinates of the page."""
    return (np.asarray(place) - page.evaluate("data.offset")).tolist()


def _only(page, kind: str) -> None:
    page.evaluate("kind => { for (const name in shown) shown[name] = name === kind; draw(); }", kind)


def _click(page, place) -> None:
    page.mouse.click(*page.evaluate(WHERE, _in_page(page, place)))


def test_the_page_lists_the_photographs(opened, scene):
    """Its script has run."""
    found = opened(FLAT).locator("#image option").all_text_contents()
    assert [name for name in scene.images.names if any(name in text for text in found)] == list(scene.images.names)


def test_a_line_clicked_in_the_scene_lights_up_in_every_photograph(opened, scene):
    page = opened()
    assert page.evaluate(ORANGE, "photo") == page.evaluate(ORANGE, "scene") == 0
    _only(page, "lines")
    _click(page, _middle(scene, 2))
    assert page.inner_text("#about h3").startswith(f"Line {scene.lines.ids[2]}")
    said = page.inner_text("#about")
    length = np.linalg.norm(scene.lines.segments[2, 1] - scene.lines.segments[2, 0])
    for words in (f"{length:.4g}", "first.jpg", "second.jpg", "Images\n2"):
        assert words in said, words
    page.wait_for_function("document.querySelectorAll('#strip .lit').length === 2")
    page.wait_for_function("thumbs.every(t => t.bitmap)")
    assert page.evaluate(ORANGE, "photo") > 50 and page.evaluate(ORANGE, "scene") > 50
    for number in (0, 1):
        page.evaluate("i => { thumbs[i].one.firstChild.id = 'thumb' + i; }", number)
        assert page.evaluate(ORANGE, f"thumb{number}") > 20
    page.mouse.move(5, 5)  # what the mouse points at is marked, too
    page.keyboard.press("Escape")
    assert page.evaluate("chosen") is None
    page.evaluate("() => { paint(); drawImage(); }")
    assert page.evaluate(ORANGE, "photo") == page.evaluate(ORANGE, "scene") == 0


def test_a_segment_clicked_in_a_photograph_lights_up_in_the_scene(opened, scene):
    page = opened()
    line = int(scene.line_observations.line_idx[1])
    page.select_option("#image", "0")
    ends = scene.line_observations.segment[1].reshape(2, 2)
    box, (x, y) = page.locator("#photo").bounding_box(), ends.mean(axis=0) / [640, 480]
    page.mouse.move(box["x"] + x * box["width"], box["y"] + y * box["height"])
    assert page.inner_text("#tip").startswith(f"line {scene.lines.ids[line]}: 0.00 px")
    page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
    assert page.evaluate("[chosen.kind, chosen.index]") == ["line", line]
    page.evaluate("() => { paint(); drawImage(); }")
    assert page.evaluate(ORANGE, "scene") > 50
    assert page.evaluate("pieceEnds(piecesOf(chosen.index)[0])") == [
        pytest.approx(_in_page(page, end), abs=1e-5) for end in scene.lines.segments[line]
    ]


def test_points_planes_and_cameras_can_be_clicked(opened, scene):
    page = opened()
    _only(page, "points")
    _click(page, scene.points.xyz[7])
    assert page.evaluate("[chosen.kind, chosen.index]") == ["point", 7]
    _only(page, "planes")
    inside = page.evaluate("planeOf(0).at") + np.array(page.evaluate("data.offset"))
    _click(page, inside)
    assert page.inner_text("#about h3").startswith("Plane 1")
    assert page.evaluate("[lit.lines, lit.points]") == [[0], [0, 1, 2, 3, 4]]
    _only(page, "cameras")
    page.evaluate("eye.pivot = cameraCenter(1), draw()")
    _click(page, scene.cam_centers_in_world[1])
    assert page.inner_text("#about h3").startswith("second.jpg") and page.input_value("#image") == "1"
    page.click("#about h3 button")
    assert page.evaluate("chosen") is None


def test_links_lead_from_a_line_to_its_plane_and_back(opened, scene):
    page = opened(f"#line {scene.lines.ids[0]}")
    page.click("#about dl >> text=plane 1")
    assert page.evaluate("chosen.kind") == "plane"
    page.click(f"#about dl >> text=line {scene.lines.ids[0]}")
    assert page.evaluate("[chosen.kind, chosen.index]") == ["line", 0]


def test_a_junction_lights_up_both_lines(opened, scene):
    page = opened()
    assert page.evaluate("shown.junctions") is False
    assert page.locator("#layers >> text=Junctions").count() == 1
    place = page.evaluate("place('junctions', 0)") + np.array(page.evaluate("data.offset"))
    lines = scene.lines.plucker[[1, 3]]
    far = np.linalg.norm(np.cross(place, lines[:, 3:]) - lines[:, :3], axis=1)
    assert far[0] == pytest.approx(far[1], abs=1e-5)
    _only(page, "junctions")
    page.evaluate("place => { eye.pivot = place; draw(); }", _in_page(page, place))
    _click(page, place)
    ids = scene.lines.ids
    assert page.inner_text("#about h3").startswith(f"Junction of lines {ids[1]} and {ids[3]}")
    assert page.evaluate("[lit.lines, lit.entries]") == [[1, 3], [0, 1]]
    assert float(_measured(page)["Distance between them"]) == pytest.approx(far.sum(), rel=1e-3)
    page.evaluate("() => { paint(); drawImage(); }")
    assert page.evaluate(ORANGE, "scene") > 50
    page.click(f"#about dl >> text=line {ids[3]}")
    assert _measured(page)["Meets"] == f"line {ids[1]}"


def test_search_by_name(opened, scene):
    page = opened(FLAT)
    # A few of the names that go on after what is typed, and first.jpg, second.jpg.
    assert page.evaluate("search('p').map(found => found.kind)") == ["plane", *["point"] * 7, "camera", "camera"]
    size = page.locator("#scene").bounding_box()
    page.evaluate("pointAt({ kind: 'line', index: 2 })")
    page.fill("#search", f"line {scene.lines.ids[3]}")
    page.press("#search", "Enter")
    assert page.evaluate("[chosen.kind, chosen.index, pointed]") == ["line", 3, None]  # the view has moved
    assert page.evaluate("eye.distance / lines.lengths[3]") < 5.001  # from near
    assert page.locator("#scene").bounding_box() == size  # the panel scrolls
    page.fill("#search", "second")
    page.click("#found button")
    assert page.evaluate("[chosen.kind, chosen.index, current]") == ["camera", 1, 1]
    page.fill("#search", "line 99999")
    assert page.inner_text("#found") == "Nothing has this name."
    name = f"00{scene.lines.ids[3]}"  # the beginning of a file name, not the number of a line
    assert page.evaluate("n => { cameras.names[0] = n; return search(n)[0].kind; }", name) == "camera"
    assert "point" in page.evaluate("id => search(id).map(found => found.kind)", str(scene.points.ids[5]))


def _measured(page) -> dict[str, str]:
    return dict(
        zip(page.locator("#about dt").all_inner_texts(), page.locator("#about dd").all_inner_texts(), strict=True)
    )


def test_distance_of_two_points_with_its_standard_deviation(opened, scene, covariances):
    page = opened(FLAT)
    page.click("#measure")
    _only(page, "points")
    for point in (3, 9):
        _click(page, scene.points.xyz[point])
    way = scene.points.xyz[9] - scene.points.xyz[3]
    sigma = np.sqrt(way @ (covariances.points[3] + covariances.points[9]) @ way) / np.linalg.norm(way)
    value, spread = _measured(page)["Distance of the picks"].split(" ± ")
    assert len(value.partition(".")[2]) == len(spread.partition(".")[2])  # both end at the second digit of the spread
    assert float(value) == pytest.approx(np.linalg.norm(way), abs=0.051 * sigma)
    assert float(spread) == pytest.approx(sigma, rel=0.06)
    page.evaluate("() => { paint(); drawImage(); }")
    assert page.evaluate(ORANGE, "marks") > 50


def test_angle_of_two_lines_with_its_standard_deviation(opened, scene, covariances):
    """Against the derivative of the angle by the directions, taken numerically."""
    page = opened(FLAT)
    page.click("#measure")
    _only(page, "lines")
    for line in (1, 3):
        _click(page, _middle(scene, line))
    first, second = (scene.lines.segments[line, 1] - scene.lines.segments[line, 0] for line in (1, 3))
    first, second = first / np.linalg.norm(first), second / np.linalg.norm(second)

    def angle(change: np.ndarray) -> float:
        a, b = first + change[:3], second + change[3:]
        return np.rad2deg(np.arccos(abs(a @ b) / np.linalg.norm(a) / np.linalg.norm(b)))

    slope = np.array([(angle(1e-5 * axis) - angle(-1e-5 * axis)) / 2e-5 for axis in np.eye(6)])
    variance = sum(
        slope[k : k + 3] @ covariances.lines[line, 3:, 3:] @ slope[k : k + 3] for k, line in ((0, 1), (3, 3))
    )
    value, spread = (float(text.removesuffix("°")) for text in _measured(page)["Angle"].split(" ± "))
    assert value == pytest.approx(angle(np.zeros(6)), abs=0.02)
    assert spread == pytest.approx(np.sqrt(variance), rel=0.06)


def test_distance_of_a_line_from_a_point_uses_moments_about_the_offset(opened, scene, covariances):
    """The page works in coordinates less an offset; the spread across a line comes out as from the world's moments."""
    page = opened(FLAT)
    page.click("#measure")
    line, point = 2, 6
    at = _middle(scene, line)
    page.evaluate(
        """([line, point, at]) => {
          pick({ kind: "line", index: line }, at);
          pick({ kind: "point", index: point }, place("points", point));
        }""",
        [line, point, _in_page(page, at)],
    )
    d = scene.lines.segments[line, 1] - scene.lines.segments[line, 0]
    d /= np.linalg.norm(d)
    m = np.cross(at, d)
    off = scene.points.xyz[point] - at
    off -= (off @ d) * d
    unit, foot = off / np.linalg.norm(off), scene.points.xyz[point] - off

    def place(change: np.ndarray) -> np.ndarray:
        moment, along = m + change[:3], d + change[3:]
        return np.cross(along, moment) / (along @ along) + (foot @ d) * along

    slope = np.array([unit @ (place(1e-6 * axis) - place(-1e-6 * axis)) / 2e-6 for axis in np.eye(6)])
    variance = slope @ covariances.lines[line] @ slope + unit @ covariances.points[point] @ unit
    told = next(text for name, text in _measured(page).items() if "perpendicular" in name)
    value, spread = map(float, told.split(" ± "))
    assert value == pytest.approx(np.linalg.norm(off), abs=0.051 * spread)
    # |d| = 1 is kept by the page and not by the differences; that part runs along the line.
    assert spread == pytest.approx(np.sqrt(variance), rel=0.15)


def test_a_phone(opened, scene):
    """Nothing wider than the screen, the scene without scrolling past numbers, taps that choose."""
    page = opened(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True, device_scale_factor=2)
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    cells = [cell.bounding_box() for cell in page.locator(".card.wide td").all()]
    assert len(cells) == 7 and all(cell["x"] + cell["width"] <= 390 for cell in cells)
    box = page.locator("#scene").bounding_box()
    assert box["width"] > 300 and box["height"] >= 300 and box["y"] + box["height"] < 844
    _only(page, "lines")
    page.touchscreen.tap(*page.evaluate(WHERE, _in_page(page, _middle(scene, 1))))
    assert page.evaluate("[chosen.kind, chosen.index]") == ["line", 1]
    assert page.inner_text(".hint").startswith("Tap") and not page.is_visible(".by-mouse")
    photo = page.locator("#photo").bounding_box()
    assert photo["y"] > box["y"] + box["height"] and photo["width"] > 300


def test_without_webgl_the_scene_is_drawn_on_a_canvas(opened, scene):
    page = opened("#canvas")
    assert page.evaluate("renderer.name") == "canvas"
    _only(page, "lines")
    _click(page, _middle(scene, 2))
    assert page.evaluate("[chosen.kind, chosen.index]") == ["line", 2]
    page.evaluate("() => { paint(); drawImage(); }")
    assert page.evaluate(ORANGE, "scene") > 50
    assert opened().evaluate("renderer.name") == "webgl"


def test_hands_turn_move_and_bring_the_view_back(opened):
    page = opened()
    box = page.locator("#scene").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    before = page.evaluate("({ ...eye, pivot: [...eye.pivot] })")
    page.mouse.move(x, y)
    page.mouse.down()
    page.mouse.move(x + 80, y + 30, steps=4)
    page.mouse.up()
    turned = page.evaluate("eye")
    assert turned["azimuth"] == pytest.approx(before["azimuth"] - 0.56) and turned["pivot"] == before["pivot"]
    assert page.evaluate("chosen") is None  # a drag is no click
    page.mouse.wheel(0, 300)
    page.wait_for_function("eye.distance > data.view.distance")
    page.click("#home")
    assert page.evaluate("eye") == before


#: Frames of a scene that takes so many milliseconds when all of it is drawn, on a screen of 60 Hz: which share of the
#: frames is late, and how much of the scene they show.
FRAMES = """cost => {
  const tick = 1000 / 60;
  let now = 0, late = 0, drawn = 0;
  awaited = lastFrame = 0; clearTimeout(rest);
  for (let i = 0; i < 360; i++) {
    frame(now);
    const ticks = Math.max(1, Math.ceil(cost * share / tick));
    now += ticks * tick;
    if (i >= 60) { late += (ticks > 1) / 300; drawn += share / 300; }
  }
  return [late, drawn];
}"""


def test_frames_come_in_time_and_show_what_there_is_time_for(opened):
    page = opened()
    assert page.evaluate(FRAMES, 10) == [0, pytest.approx(1)]
    for cost in (25, 60, 200):
        late, drawn = page.evaluate(FRAMES, cost)
        assert late < 0.15
        assert drawn > 0.65 * 16.7 / cost


def test_what_makes_single_frames_wait_hides_nothing(opened):
    """Loading, resting and one frame that is late: all of the scene stays in view."""
    page = opened()
    assert page.evaluate("""async () => {
      const shares = [], wait = took => new Promise(done => setTimeout(done, took));
      for (const pause of [30, 120, 400, 30]) {
        await wait(pause);
        draw();
        await new Promise(requestAnimationFrame);
        shares.push(share);
      }
      return shares;
    }""") == [1, 1, 1, 1]  # fmt: skip
    late = "([first, ...more]) => { awaited = lastFrame = first; for (const time of more) frame(time); return share; }"
    assert page.evaluate(late, [1000, 1016, 1100, 1116]) == 1
    assert page.evaluate(late, [2000, 2016, 2100, 2184]) < 1


def test_the_glide_follows_the_clock(opened):
    """However few frames there are."""
    page = opened(FLAT)
    glides = "took => { [blend, target, glided] = [0, 1, 0]; for (const time of took) glide(time); return blend; }"
    many, few = (page.evaluate(glides, list(range(10, 101, step))) for step in (10, 90))
    assert many == pytest.approx(few, abs=1e-9)
    assert many == pytest.approx(1 - np.exp(-100 / 67))
