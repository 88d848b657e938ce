# SPDX-License-Identifier: BSD-3-Clause
"""How fast the page of a report draws a large scene: milliseconds a frame, and for finding what a click hits.

    python benchmarks/report_frames.py [--points 100000] [--lines 20000] [--windows 1400x1000 ...] [--canvas]

For each size of the window: what a frame takes, how many draw calls and vertices it has, and what one triangle over the
same number of pixels takes, which no page is faster than.

Needs Playwright and Chromium. Without a graphics card, Chromium draws by the processor (SwiftShader), which this says:
times of one machine cannot be compared with those of another.
"""

import argparse
import json
import statistics
import sys
import tempfile
from pathlib import Path

import numpy as np

from groma.scene import Cameras, Lines, Points, Scene
from groma.viz.report.page import write_report

#: Turns the scene and waits each time until all is drawn.
FRAMES = """count => {
  const times = [];
  for (let i = 0; i < count; i++) {
    const begin = performance.now();
    turnEye(0.02, 0); paint(); renderer.finish();
    times.push(performance.now() - begin);
  }
  return times;
}"""
#: The same without waiting: what the page itself has to do.
OWN = """count => {
  const times = [];
  for (let i = 0; i < count; i++) {
    turnEye(0.02, 0);
    const begin = performance.now();
    paint();
    times.push(performance.now() - begin);
    renderer.finish();
  }
  return times;
}"""
#: Turns the scene as a hand does: how many milliseconds lie between frames, and which share of the scene they show.
MOTION = """async count => {
  const times = [], shares = [];
  for (let i = 0, before = 0; i < count; i++) {
    turnEye(0.02, 0); draw();
    const now = await new Promise(requestAnimationFrame);
    if (i) times.push(now - before);
    shares.push(share); before = now;
  }
  return [times, shares];
}"""
#: Draw calls of a whole frame and their vertices.
CALLS = """() => {
  const gl = canvas.getContext("webgl2"), found = { calls: 0, vertices: 0 };
  const arrays = gl.drawArrays, elements = gl.drawElements;
  const count = vertices => { found.calls++; found.vertices += vertices; };
  gl.drawArrays = (...given) => { count(given[2]); arrays.apply(gl, given); };
  gl.drawElements = (...given) => { count(given[1]); elements.apply(gl, given); };
  paint(); renderer.finish();
  delete gl.drawArrays; delete gl.drawElements;
  return found;
}"""
#: One triangle over a whole canvas, drawn and waited for.
TRIANGLE = """([width, height, count]) => {
  const canvas = document.createElement("canvas");
  canvas.width = width; canvas.height = height; document.body.append(canvas);
  const gl = canvas.getContext("webgl2"), program = gl.createProgram(), pixel = new Uint8Array(4), times = [];
  const vertex = `#version 300 es
    void main() { gl_Position = vec4(gl_VertexID == 1 ? 3 : -1, gl_VertexID == 2 ? 3 : -1, 0, 1); }`;
  const colour = `#version 300 es
    precision mediump float; out vec4 c; void main() { c = vec4(0.2, 0.4, 0.6, 1); }`;
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, colour]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
  }
  gl.linkProgram(program); gl.useProgram(program); gl.viewport(0, 0, width, height);
  for (let i = 0; i < count; i++) {
    const begin = performance.now();
    gl.clear(gl.COLOR_BUFFER_BIT); gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
    times.push(performance.now() - begin);
  }
  return [times, [...pixel], gl.getError()];
}"""
HITS = """count => {
  const times = [];
  for (let i = 0; i < count; i++) {
    const begin = performance.now();
    hit(canvas.width * (i % 7) / 7, canvas.height * (i % 5) / 5, 8);
    times.push(performance.now() - begin);
  }
  return times;
}"""
CARD = """() => {
  const gl = canvas.getContext("webgl2"), more = gl && gl.getExtension("WEBGL_debug_renderer_info");
  return more ? gl.getParameter(more.UNMASKED_RENDERER_WEBGL) : "none";
}"""


def city(num_points: int, num_lines: int) -> Scene:
    """Points on the walls of a hundred boxes, and lines along their three directions."""
    rng = np.random.default_rng(0)
    corner = rng.uniform(-50, 50, (100, 3)) * [1, 1, 0]
    xyz = corner[rng.integers(0, 100, num_points)] + rng.uniform(0, 8, (num_points, 3))
    start = corner[rng.integers(0, 100, num_lines)] + rng.uniform(0, 8, (num_lines, 3))
    way = np.eye(3)[rng.integers(0, 3, num_lines)] * rng.uniform(0.3, 4, (num_lines, 1))
    poses = np.tile([0, 0, 0, 1, 0, 0, 0.0], (200, 1))
    poses[:, 4:] = rng.uniform(-60, 60, (200, 3)) * [1, 1, 0.1]
    cameras = Cameras(np.array([1]), ("PINHOLE",), np.array([[500.0, 500, 320, 240]]), np.array([640]), np.array([480]))
    return Scene.from_images(
        cameras, [f"{k}.jpg" for k in range(200)], np.zeros(200, int), poses,
        points=Points.at(xyz), lines=Lines.through(np.stack([start, start + way], axis=1)),
    )  # fmt: skip


def measure(page: Path, canvas: bool, size: tuple[int, int]) -> dict[str, object]:
    """Return medians, milliseconds, and who drew."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as program:
        browser = program.chromium.launch(
            executable_path="/usr/bin/chromium",
            args=["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"],
        )
        view = browser.new_page(viewport={"width": size[0], "height": size[1]})
        view.goto(page.as_uri() + ("#canvas" if canvas else ""))
        view.wait_for_function("blend === target")
        times, shares = view.evaluate(MOTION, 90)
        frames, own, hits = view.evaluate(FRAMES, 20), view.evaluate(OWN, 40), view.evaluate(HITS, 30)
        pixels = view.evaluate("[canvas.width, canvas.height]")
        found = {"drawn_by": view.evaluate("renderer.name"), "graphics": view.evaluate(CARD) if not canvas else "none"}
        if not canvas:
            found.update(view.evaluate(CALLS))
            triangle, colour, error = browser.new_page().evaluate(TRIANGLE, [*pixels, 20])
            if error or colour != [51, 102, 153, 255]:
                raise RuntimeError(f"The triangle was not drawn: pixel {colour}, error {error}.")
            found["triangle_ms"] = statistics.median(triangle)
        browser.close()
    moving = {"moving_ms": statistics.median(times[30:]), "moving_share": statistics.median(shares[30:])}
    return {
        **found,
        "pixels": pixels,
        **moving,
        "whole_frame_ms": statistics.median(frames),
        "least_frame_ms": min(frames),
        "own_ms": statistics.median(own),
        "hit_ms": statistics.median(hits),
    }


def main() -> None:
    """Write the page, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--lines", type=int, default=20_000)
    parser.add_argument("--canvas", action="store_true", help="without WebGL")
    parser.add_argument("--windows", nargs="+", default=["1400x1000"], metavar="WxH", help="pixels of the window")
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        write_report(page, None, city(wanted.points, wanted.lines), title="A synthetic city")
        sizes = [tuple(map(int, size.split("x"))) for size in wanted.windows]
        rows = [measure(page, wanted.canvas, (width, height)) for width, height in sizes]
        found = {"bytes": page.stat().st_size, "windows": rows}
    text = json.dumps(found, indent=1)
    sys.stdout.write(text + "\n")
    if wanted.json is not None:
        wanted.json.write_text(text)


if __name__ == "__main__":
    main()
