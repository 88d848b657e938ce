# SPDX-License-Identifier: BSD-3-Clause
"""The directive ``drawn``: a figure of the mathematics, drawn when the pages are built, by groma's own functions.

``drawn NAME`` draws the function NAME of this module or of ``_guide_figures``; its docstring is the caption. Nothing
is drawn by hand: charts are moved by ``retract``, pixels come from the camera models, weights from the losses.
"""

from collections.abc import Callable
from pathlib import Path

import _guide_figures
import matplotlib as mpl
import numpy as np
from docutils import nodes
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.docutils import SphinxDirective

import groma
from groma import cameras
from groma.factors.losses import LOSSES
from groma.factors.losses import loss as loss_of
from groma.geometry import line3, plane3, projection, quaternion, se3
from groma.geometry.charts.registry import charts_of
from groma.scene import synthetic

_BLUE, _GREEN, _RED, _GREY = "#2a6fb0", "#2f8f46", "#c8372d", "#8a8a8a"
mpl.rcParams |= {"svg.hashsalt": "groma", "font.size": 10, "axes.spines.top": False, "axes.spines.right": False}


# ------------------------------------------------------------------------------------------------------------ geometry


def line(figure: Figure) -> None:
    """A line by its direction d and its moment m, which stands on the plane through the line and the origin. The
    foot point p is the closest to the origin; the length of m is that of p where d has length one.
    """
    axes = _space(figure)
    along = line3.normalize(line3.from_points(np.array([1.6, -0.8, 0.3]), np.array([0.9, 1.5, 0.9])))
    foot, m, d = line3.foot_point(along), line3.moment(along), line3.direction(along)
    ends = np.stack([foot - 1.3 * d, foot + 1.5 * d])
    axes.plot(*ends.T, color=_BLUE, linewidth=2.5)
    _surface(axes, np.stack([np.zeros(3), *ends]), _GREY)
    for start, end, text, colour in (
        (np.zeros(3), foot, "p", _GREY), (foot, foot + d, "d", _BLUE), (np.zeros(3), m, "m", _RED)
    ):  # fmt: skip
        _arrow(axes, start, end, text, colour)
    _corners(axes, ends, np.zeros(3), m)


def interpretation_plane(figure: Figure) -> None:
    """The camera sees a line by the plane through it and the camera centre. The moment m is the normal of that
    plane in the camera, so it alone decides where the line is in the image; how far away the line is, one image
    cannot tell.
    """
    axes = _space(figure)
    ends = np.array([[-0.9, -0.6, 3.0], [1.2, 0.3, 2.4]])
    image = ends / ends[:, 2:] * 1.2
    screen = np.array([[-0.8, -0.6, 1.2], [0.8, -0.6, 1.2], [0.8, 0.6, 1.2], [-0.8, 0.6, 1.2]])
    _surface(axes, screen, _GREEN)
    _surface(axes, np.stack([np.zeros(3), *(1.15 * ends)]), _GREY)
    axes.plot(*ends.T, color=_BLUE, linewidth=2.5)
    axes.plot(*image.T, color=_RED, linewidth=2.5)
    for factor in (0.75, 1.15):
        axes.plot(*(factor * ends).T, color=_BLUE, linewidth=1, linestyle=":")
    m = line3.moment(line3.from_points(*ends))
    _arrow(axes, np.zeros(3), 0.8 * m / np.linalg.norm(m), "m", _RED)
    axes.text(0.05, 0, -0.15, "camera", color=_GREY)
    _corners(axes, ends, screen, np.zeros(3))
    axes.view_init(elev=-60, azim=-70)


def plane(figure: Figure) -> None:
    """A plane by its unit normal n and offset w. Its point closest to the origin is -w n; planes through the origin
    have no such chart.
    """
    axes = _space(figure)
    hesse = plane3.hesse(np.array([0.5, 0.3, 1.0, -1.2]))
    closest = plane3.to_closest_point(hesse)
    n = hesse[:3]
    first = np.cross(n, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(n, first)
    corners = closest + np.array([-first - second, first - second, first + second, -first + second])
    _surface(axes, corners, _GREEN)
    _arrow(axes, np.zeros(3), closest, "-w n", _GREY)
    _arrow(axes, closest, closest + 0.7 * n, "n", _RED)
    _corners(axes, corners, np.zeros(3), closest + 0.7 * n)


def line_charts(figure: Figure) -> None:
    """The four increments of three charts, from -0.6 to 0.6, each applied to the same line (blue). Two of each
    chart turn the line, and two shift it or, in the orthonormal and the free chart, mix the two.
    """
    charts = charts_of("line")
    chosen = [name for name in ("cartesian", "orthonormal_right", "free_right") if name in charts] or list(charts)[:3]
    start = line3.from_point_and_direction(np.array([0.7, 0.2, 0.4]), np.array([0.1, 0.5, 1.0]))
    for row, name in enumerate(chosen):
        chart = charts[name]
        for k in range(4):
            axes = figure.add_subplot(len(chosen), 4, 4 * row + k + 1, projection="3d")
            for step in np.linspace(-0.6, 0.6, 7):
                delta = np.zeros((1, 4))
                delta[0, k] = step
                moved = chart.ambient(chart.retract(chart.from_ambient(start[None]), delta))[0]
                foot, d = line3.foot_point(moved), line3.direction(line3.normalize(moved))
                ends = np.stack([foot - d, foot + d])
                still = abs(step) < 1e-12
                axes.plot(*ends.T, color=_BLUE if still else _RED, alpha=1 if still else 0.45, linewidth=1 + still)
            axes.scatter(0, 0, 0, color="k", s=6)
            axes.set(xlim=(-1, 1), ylim=(-1, 1), zlim=(-1, 1))
            axes.set_axis_off()
            axes.set_title(f"{name.replace('_', ' ')}, {k + 1}", fontsize=9)
    figure.set_size_inches(8, 2 * len(chosen))


def camera_models(figure: Figure) -> None:
    """How far from the centre a ray appears, by its angle with the optical axis, for one focal length. Perspective
    cameras end before 90 degrees, and where the distortion stops growing; fisheyes see behind them.
    """
    axes = figure.add_subplot()
    angle = np.deg2rad(np.linspace(0.5, 140, 280))
    rays = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=1)
    shown = {
        "PINHOLE": [1, 1, 0, 0], "SIMPLE_RADIAL": [1, 0, 0, -0.12], "FOV": [1, 1, 0, 0, 0.9],
        "SIMPLE_FISHEYE": [1, 0, 0], "OPENCV_FISHEYE": [1, 1, 0, 0, -0.03, 0, 0, 0], "EUCM": [1, 1, 0, 0, 0.6, 1.1],
    }  # fmt: skip
    for name, params in shown.items():
        with np.errstate(all="ignore"):
            pixels = cameras.model(name).project(np.array(params, float), rays)[:, 0]
        seen = np.isfinite(pixels) & (cameras.model(name).sees_behind | (angle < np.deg2rad(85)))
        seen &= np.gradient(pixels) > 0
        axes.plot(np.rad2deg(angle[seen]), pixels[seen], label=name)
    axes.set(xlabel="angle with the optical axis, degrees", ylabel="radius / focal length", ylim=(0, 4))
    axes.legend()


# ------------------------------------------------------------------------------------------------------------- factors


def point_factor(figure: Figure) -> None:
    """The residual of a point: from the measured pixel (cross) to where the point should be seen."""
    axes = _image(figure)
    pose = se3.exp(np.array([0.1, -0.05, 0.1, 0.02, -0.03, 0.02]))
    points = np.random.default_rng(2).uniform([-1.4, -1, 3], [1.4, 1, 5], (12, 3))
    measured = _pixels(points)
    predicted = _pixels(quaternion.rotate(pose[None, :4], points) + pose[4:])
    axes.plot(*measured.T, "x", color=_BLUE, label="measured")
    axes.plot(*predicted.T, "o", color=_RED, markersize=4, label="projected")
    for one, other in zip(measured, predicted, strict=True):
        axes.annotate("", other, one, arrowprops={"arrowstyle": "->", "color": _GREY})
    axes.legend(loc="upper right")


def line_factor(figure: Figure) -> None:
    """The residual of a line: the signed distances of the ends of the measured segment (blue) from the projected
    line. Where along the line the segment ends is not compared; ends are where something hid the line.
    """
    axes = _image(figure)
    camera = np.column_stack([_K, np.zeros(3)])
    seen = projection.project_lines(camera, line3.from_points(np.array([-1.2, -0.7, 4.0]), np.array([1.3, 0.6, 3.4])))
    u = np.array([20.0, 620.0])
    axes.plot(u, -(seen[0] * u + seen[2]) / seen[1], color=_RED, label="projected line")
    ends = np.array([[150.0, 130.0], [470.0, 345.0]])
    axes.plot(*ends.T, color=_BLUE, linewidth=3, label="measured segment")
    normal = seen[:2] / np.linalg.norm(seen[:2])
    for end, name in zip(ends, ("r_1", "r_2"), strict=True):
        foot = end - (end @ seen[:2] + seen[2]) / np.linalg.norm(seen[:2]) * normal
        axes.plot(*np.stack([end, foot]).T, color=_GREY, linewidth=1.5)
        axes.annotate(f"${name}$", 0.5 * (end + foot), (8, 4), textcoords="offset points")
    axes.legend(loc="upper right")


def plane_factor(figure: Figure) -> None:
    """The metric residual of a plane: the angle between the measured normal (blue) and the predicted one (red),
    about two axes, and the difference of the distances from the camera. It does not depend on where the world has
    its origin.
    """
    axes = figure.add_subplot()
    for angle, offset, colour, name in ((0.0, 2.0, _BLUE, "measured"), (0.18, 2.35, _RED, "predicted")):
        normal = np.array([np.sin(angle), np.cos(angle)])
        across = np.array([normal[1], -normal[0]])
        foot = offset * normal
        axes.plot(*np.stack([foot - 1.4 * across, foot + 1.4 * across]).T, color=colour, linewidth=2.5, label=name)
        axes.annotate("", foot, (0, 0), arrowprops={"arrowstyle": "-", "linestyle": "--", "color": colour})
        axes.annotate("", foot + 0.5 * normal, foot, arrowprops={"arrowstyle": "->", "color": colour})
    axes.plot(0, 0, "^", color=_GREY, markersize=12)
    axes.annotate("camera", (0.1, -0.05))
    axes.set(aspect="equal", xlim=(-2, 2.4), ylim=(-0.3, 3.1))
    axes.set_axis_off()
    axes.legend(loc="upper left")


def losses(figure: Figure) -> None:
    """What robust losses make of a residual r, in standard deviations, at scale 1: cost (left) and weight (right)."""
    left, right = figure.subplots(1, 2)
    r = np.linspace(0, 5, 200)
    for name in LOSSES:
        if name in ("barron",):
            continue
        value, weight, _ = (loss_of("none") if name == "trivial" else loss_of(name, 1.0)).evaluate(r * r)
        left.plot(r, 0.5 * value, label="none" if name == "trivial" else name.replace("_", " "))
        right.plot(r, weight)
    left.set(xlabel="residual", ylabel="cost", ylim=(0, 5))
    right.set(xlabel="residual", ylabel="weight", ylim=(0, 1.05))
    left.legend(fontsize=8)
    figure.set_size_inches(8, 3)


# -------------------------------------------------------------------------------------------------------------- solver


def normal_equations(figure: Figure) -> None:
    """Which variables the normal equations couple, in a scene of 12 cameras, 40 points, 12 lines and 2 planes.
    Points and lines are coupled with cameras only, so they are eliminated block by block; planes stay with the
    cameras.
    """
    axes = figure.add_subplot()
    scene = synthetic.holistic(12, seed=1).start.keep(points=np.arange(0, 120, 3))
    sizes = {"cameras": scene.num_images, "planes": scene.num_planes}
    sizes |= {"points": scene.num_points, "lines": scene.num_lines}
    first = dict(zip(sizes, np.concatenate([[0], np.cumsum(list(sizes.values()))[:-1]]), strict=True))
    total = sum(sizes.values())
    coupled = np.eye(total, dtype=bool)
    tables = ((scene.point_observations, "point_idx", "points"), (scene.line_observations, "line_idx", "lines"))
    for table, column, kind in tables:
        one, two = first["cameras"] + table.image_idx, first[kind] + getattr(table, column)
        coupled[one, two] = coupled[two, one] = True
    for pairs, kind in ((scene.relations.point_on_plane, "points"), (scene.relations.line_on_plane, "lines")):
        if len(pairs):
            one, two = first[kind] + pairs[:, 0], first["planes"] + pairs[:, 1]
            coupled[one, two] = coupled[two, one] = True
    axes.imshow(coupled, cmap="Blues", interpolation="nearest")
    for name, begin in first.items():
        axes.axhline(begin - 0.5, color=_GREY, linewidth=0.8)
        axes.axvline(begin - 0.5, color=_GREY, linewidth=0.8)
        axes.annotate(name, (-1.5, begin + sizes[name] / 2), ha="right", va="center", annotation_clip=False)
    axes.set(xticks=[], yticks=[])
    figure.set_size_inches(4.5, 4)


def ellipses(figure: Figure) -> None:
    """Camera centres of twelve photographs with their ellipses of three standard deviations, enlarged thirty times,
    relative to the first camera and the scale (left), and with inner constraints (right). The measurements are the
    same; what the covariances refer to is not.
    """
    made = synthetic.holistic(12, noise_px=1.0, seed=4)
    result = groma.adjust(made.start.points_only(), groma.AdjustOptions(loss="none"))
    around = np.linspace(0, 2 * np.pi, 60)
    for axes, gauge in zip(figure.subplots(1, 2), ("held", "inner"), strict=True):
        found = groma.uncertainty(result.scene, problem=result.problem, gauge=gauge)
        for center, covariance in zip(result.scene.cam_centers_in_world, found.centers, strict=True):
            value, vector = np.linalg.eigh(covariance[:2, :2])
            ring = vector @ (np.sqrt(np.maximum(value, 0))[:, None] * [np.cos(around), np.sin(around)])
            axes.plot(*(center[:2, None] + 90 * ring), color=_RED, linewidth=1)
        axes.plot(*result.scene.cam_centers_in_world[:, :2].T, ".", color=_BLUE)
        axes.set(aspect="equal", title=gauge)
        axes.set_axis_off()
    figure.set_size_inches(8, 4)


def axes_of_images(figure: Figure) -> None:
    """Pixels count from the corner of the image: the centre of the first one is (0.5, 0.5). The camera looks along
    z, with x to the right and y down.
    """
    axes = figure.add_subplot()
    for k in range(6):
        axes.plot([k, k], [0, 4], color=_GREY, linewidth=0.8)
    for k in range(5):
        axes.plot([0, 5], [k, k], color=_GREY, linewidth=0.8)
    axes.plot(0.5, 0.5, "o", color=_RED)
    axes.annotate("(0.5, 0.5)", (0.5, 0.5), (6, -14), textcoords="offset points")
    axes.plot(0, 0, "s", color=_BLUE, clip_on=False)
    axes.annotate("(0, 0)", (0, 0), (-8, 8), textcoords="offset points", ha="right")
    for end, text in (((5.8, 0), "u, x"), ((0, 4.8), "v, y")):
        axes.annotate("", end, (0, 0), arrowprops={"arrowstyle": "->", "color": _BLUE})
        axes.annotate(text, end, (4, 0), textcoords="offset points")
    axes.set(aspect="equal", xlim=(-1.5, 6.6), ylim=(5.2, -0.8))
    axes.set_axis_off()


# --------------------------------------------------------------------------------------------------------------- pages

_K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])


def _pixels(points: np.ndarray) -> np.ndarray:
    return cameras.model("PINHOLE").project(np.array([500.0, 500.0, 320.0, 240.0]), points)


def _space(figure: Figure) -> Axes:
    axes = figure.add_subplot(projection="3d")
    axes.scatter(0, 0, 0, color="k", s=12)
    axes.set_axis_off()
    return axes


def _image(figure: Figure) -> Axes:
    axes = figure.add_subplot()
    axes.set(xlim=(0, 640), ylim=(480, 0), aspect="equal", xticks=[], yticks=[])
    for side in axes.spines.values():
        side.set_visible(True)
    return axes


def _arrow(axes: Axes, start: np.ndarray, end: np.ndarray, text: str, colour: str) -> None:
    axes.quiver(*start, *(end - start), color=colour, arrow_length_ratio=0.12, linewidth=1.8)
    axes.text(*(0.5 * (start + end) + 0.06), f"${text}$", color=colour, fontsize=13)


def _surface(axes: Axes, corners: np.ndarray, colour: str) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axes.add_collection3d(Poly3DCollection([corners], facecolor=colour, alpha=0.15))


def _corners(axes: Axes, *places: np.ndarray) -> None:
    every = np.concatenate([np.atleast_2d(place) for place in places])
    middle, reach = 0.5 * (every.min(0) + every.max(0)), 0.5 * np.ptp(every, axis=0).max()
    limits = np.stack([middle - reach, middle + reach])
    axes.set(xlim=limits[:, 0], ylim=limits[:, 1], zlim=limits[:, 2])
    axes.set_box_aspect((1, 1, 1), zoom=1.25)


class Drawn(SphinxDirective):
    """A figure of this module, and its caption."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Draw the figure into the folder of the build."""
        name = self.arguments[0]
        figures = {**vars(_guide_figures), **globals()}
        draw: Callable[[Figure], None] | None = figures.get(name) if not name.startswith("_") else None
        if draw is None or getattr(draw, "__module__", "") not in (__name__, _guide_figures.__name__):
            raise ExtensionError(f"drawn: there is no figure {name!r} in _figures.py and _guide_figures.py.")
        figure = Figure(figsize=(5, 3.6), layout="constrained")
        draw(figure)
        words = " ".join((draw.__doc__ or "").split())
        folder = Path(self.env.app.doctreedir) / "drawn"
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / f"{name}.svg"
        figure.savefig(path, format="svg", bbox_inches="tight", metadata={"Date": None})
        svg = path.read_text(encoding="utf-8")
        svg = svg[svg.index("<svg") :].replace(
            "<svg", f'<svg role="img" aria-label="{name}" style="max-width:100%;height:auto"', 1
        )
        picture = nodes.raw("", f'<div style="text-align:center">{svg}</div>', format="html")
        return [picture, nodes.paragraph("", words)]


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directive."""
    app.add_directive("drawn", Drawn)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
