# SPDX-License-Identifier: BSD-3-Clause
"""The directive ``segment-figure``: two segments, what a distance of them measures, and its value from the library.

The segments of a picture lie in the plane of the page, so that lengths are drawn as they are. What is measured is
constructed here from its definition, and what the library returns is written beside; the build fails if they differ.
"""

from dataclasses import dataclass, field

import numpy as np
from docutils import nodes
from sphinx.application import Sphinx
from sphinx.errors import ExtensionError
from sphinx.util.docutils import SphinxDirective

from groma.geometry import segment3

_FIRST, _SECOND = np.array([[1.0, 0.6], [3.6, 1.5]]), np.array([[2.2, 2.6], [6.6, 2.9]])
_CAMERA = np.array([3.4, -1.1])
_SCALE, _MARGIN = 52.0, 14.0
_COLOURS = {"first": "#2a6fb0", "second": "#2f8f46", "measured": "#c8372d", "help": "#8a8a8a"}


@dataclass
class _Drawing:
    """Strokes (from, to, kind, dashed) of a picture, and the number that they stand for."""

    value: float
    strokes: list[tuple[np.ndarray, np.ndarray, str, bool]] = field(default_factory=list)
    arcs: list[str] = field(default_factory=list)

    def stroke(self, start: np.ndarray, end: np.ndarray, kind: str, dashed: bool = False) -> float:
        """Draw a straight stroke and return its length."""
        self.strokes.append((start, end, kind, dashed))
        return float(np.linalg.norm(end - start))


def _foot(point: np.ndarray, segment: np.ndarray) -> np.ndarray:
    along = (segment[1] - segment[0]) / np.linalg.norm(segment[1] - segment[0])
    return segment[0] + (point - segment[0]) @ along * along


def _drop(drawing: _Drawing, point: np.ndarray, segment: np.ndarray) -> float:
    """Draw a perpendicular, and the line to its foot where that lies beyond the segment."""
    foot = _foot(point, segment)
    drawing.stroke(min(segment, key=lambda end: np.linalg.norm(end - foot)), foot, "help", dashed=True)
    return drawing.stroke(point, foot, "measured")


def _angle(drawing: _Drawing) -> float:
    along, other = _FIRST[1] - _FIRST[0], _SECOND[1] - _SECOND[0]
    corner = _FIRST[0]
    ends = [corner + 1.9 * d / np.linalg.norm(d) for d in (other, along)]
    drawing.stroke(corner, corner + 2.3 * other / np.linalg.norm(other), "help", dashed=True)
    (x0, y0), (x1, y1) = (_page(end) for end in ends)
    drawing.arcs.append(f"M{x0:.1f},{y0:.1f} A{1.9 * _SCALE:.1f},{1.9 * _SCALE:.1f} 0 0 0 {x1:.1f},{y1:.1f}")
    return float(np.arccos(along @ other / np.linalg.norm(along) / np.linalg.norm(other)))


def _overlap(drawing: _Drawing) -> float:
    feet = [_foot(end, _SECOND) for end in _FIRST]
    for end, foot in zip(_FIRST, feet, strict=True):
        drawing.stroke(end, foot, "help", dashed=True)
    return drawing.stroke(_SECOND[0], feet[1], "measured") / float(np.linalg.norm(_SECOND[1] - _SECOND[0]))


def _inner(drawing: _Drawing) -> float:
    parts = [segment3.inner_segment(_in_space(a), _in_space(b))[0][:, :2] for a, b in _both_ways()]
    for (first, _), part in zip(_both_ways(), parts, strict=True):
        across = np.array([[0, -1], [1, 0]]) @ (first[1] - first[0]) / np.linalg.norm(first[1] - first[0])
        for end in first:
            reach = [t for t in ((place - end) @ across for place in part) if abs(t) > 0]
            far = max(reach, key=abs)
            drawing.stroke(end, end + 1.15 * far * across, "help", dashed=True)
    drawing.stroke(*parts[0], "inner")
    drawing.stroke(*parts[1], "inner")
    one, two = parts
    drops = [(end, two) for end in one] + [(end, one) for end in two]
    longest = max(drops, key=lambda drop: np.linalg.norm(drop[0] - _foot(*drop)))
    return _drop(drawing, *longest)


def _both_ways() -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    return (_FIRST, _SECOND), (_SECOND, _FIRST)


def _perpendicular(drawing: _Drawing) -> float:
    return max(_drop(drawing, end, b) for a, b in _both_ways() for end in a)


def _midpoint_perpendicular(drawing: _Drawing) -> float:
    return 0.5 * sum(_drop(drawing, a.mean(0), b) for a, b in _both_ways())


def _nearest(drawing: _Drawing) -> float:
    return _drop(drawing, _SECOND[1], _FIRST)


def _depths(segment: np.ndarray) -> np.ndarray:
    """Depths in a camera that looks up the page."""
    return segment[:, 1] - _CAMERA[1]


def _rays(drawing: _Drawing, *segments: np.ndarray) -> None:
    for end in np.concatenate(segments):
        drawing.stroke(_CAMERA, end, "help", dashed=True)


def _scaled_endpoints(drawing: _Drawing) -> float:
    _rays(drawing, _FIRST)
    apart = [drawing.stroke(a, b, "measured") for a, b in zip(_FIRST, _SECOND, strict=True)]
    return float((np.array(apart) / _depths(_FIRST)).max())


def _scaled_perpendicular(drawing: _Drawing) -> float:
    _rays(drawing, _SECOND)
    apart = [_drop(drawing, end, _SECOND) for end in _FIRST]
    feet = np.array([_foot(end, _SECOND) for end in _FIRST])
    return float((np.array(apart) / _depths(feet)).max())


#: By function: what is drawn, which returns the value by construction, and further arguments of the function.
_PICTURES = {
    "angle": (_angle, ()),
    "angular_distance": (lambda drawing: 1 - np.cos(_angle(drawing)), ()),
    "endpoint_distance": (
        lambda drawing: sum(drawing.stroke(a, b, "measured") for a, b in zip(_FIRST, _SECOND, strict=True)), ()
    ),
    "midpoint_distance": (lambda drawing: drawing.stroke(_FIRST.mean(0), _SECOND.mean(0), "measured"), ()),
    "midpoint_perpendicular_distance": (_midpoint_perpendicular, ()),
    "perpendicular_distance": (_perpendicular, ()),
    "nearest_distance": (_nearest, ()),
    "overlap": (_overlap, ()),
    "inner_segment_distance": (_inner, ()),
    "scale_invariant_endpoint_distance": (_scaled_endpoints, (_depths(_FIRST),)),
    "scale_invariant_perpendicular_distance": (_scaled_perpendicular, (_depths(_FIRST), _depths(_SECOND), True)),
}  # fmt: skip


def _in_space(segment: np.ndarray) -> np.ndarray:
    return np.column_stack([segment, np.zeros(2)])


def _page(point: np.ndarray) -> tuple[float, float]:
    return float(_MARGIN + _SCALE * point[0]), float(_MARGIN + _SCALE * (3.3 - point[1]))


def figure(name: str) -> tuple[str, float]:
    """Return the picture of a distance as SVG, and its value."""
    draw, further = _PICTURES[name]
    value = float(getattr(segment3, name)(_in_space(_FIRST), _in_space(_SECOND), *further))
    drawing = _Drawing(value)
    drawn = draw(drawing)
    if not np.isclose(drawn, value, rtol=1e-9):
        raise ExtensionError(f"segment-figure {name}: drawn {drawn}, but the library returns {value}.")
    camera = any((start == _CAMERA).all() for start, *_ in drawing.strokes)
    body = [
        _stroke(start, end, kind, dashed) for start, end, kind, dashed in drawing.strokes if kind in ("help", "inner")
    ]
    body += [_stroke(*_FIRST, "first", False), _stroke(*_SECOND, "second", False)]
    body += [_stroke(start, end, kind, False) for start, end, kind, _ in drawing.strokes if kind == "measured"]
    body += [
        f'<path d="{arc}" fill="none" stroke="{_COLOURS["measured"]}" stroke-width="2.5"/>' for arc in drawing.arcs
    ]
    body += [
        _label(segment[0] - [0.25, 0.08], text, kind)
        for segment, text, kind in ((_FIRST, "a", "first"), (_SECOND, "b", "second"))
    ]
    if camera:
        body.append(_label(_CAMERA - [0.55, 0.35], "camera", "help"))
    width, height = 2 * _MARGIN + _SCALE * 7, 2 * _MARGIN + _SCALE * (4.8 if camera else 3.0)
    svg = (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" role="img" aria-label="{name}" '
        f'xmlns="http://www.w3.org/2000/svg" style="max-width:100%">{"".join(body)}</svg>'
    )
    return svg, value


def _stroke(start: np.ndarray, end: np.ndarray, kind: str, dashed: bool) -> str:
    (x0, y0), (x1, y1) = _page(start), _page(end)
    style = 'stroke-dasharray="4 4"' if dashed else ""
    width = {"help": 1.2, "measured": 3.5, "inner": 9.0}.get(kind, 3.5)
    colour, opacity = ("#c8372d", 0.3) if kind == "inner" else (_COLOURS[kind], 1)
    return (
        f'<line x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}" stroke="{colour}" stroke-opacity="{opacity}" '
        f'stroke-width="{width}" {style}/>'
    )


def _label(place: np.ndarray, text: str, kind: str) -> str:
    x, y = _page(place)
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="15" font-style="italic" fill="{_COLOURS[kind]}">{text}</text>'


class SegmentFigure(SphinxDirective):
    """The picture of one distance, with its value."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        """Build the picture and its caption."""
        name = self.arguments[0]
        svg, value = figure(name)
        caption = nodes.paragraph()
        caption += [nodes.literal(text=f"segment3.{name}"), nodes.Text(f" of these two: {value:.3f}")]
        return [nodes.raw("", svg, format="html"), caption]


def setup(app: Sphinx) -> dict[str, object]:
    """Register the directive."""
    app.add_directive("segment-figure", SegmentFigure)
    return {"parallel_read_safe": True}
