# SPDX-License-Identifier: BSD-3-Clause
"""Why a point or a line is not determined by its own observations, in words."""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.problem.problem import Problem
from groma.solver._findings import Finding, few, first_upper
from groma.solver._observability import Observers, distinct, nearest_place
from groma.solver._words import Names

#: Camera centres nearer together than this share of the viewing distance count as one place.
ONE_PLACE = 1e-3
#: A line within this angle of the direction of the motion runs along it, and planes through a line nearer together than
#: this are one plane; a ray nearer to a line than the second angle sees it end-on.
ALONG = np.radians(5.0)
END_ON = np.radians(0.5)
#: Points whose least extent is below this share of the next are on one plane.
FLAT = 1e-3


def landmark_findings(
    problem: Problem,
    name: str,
    seen: Observers,
    centers: FloatArray,
    weakness: FloatArray,
    names: Names,
    limits: tuple[float, float],
) -> list[Finding]:
    """Explain the landmarks of a group whose weakest direction is worse than ``limits`` (undetermined, weak)."""
    kind = problem.variables[name].manifold.kind
    if kind not in ("point", "line"):
        return []
    undetermined, weak = limits
    is_open = ~(weakness <= undetermined)
    findings = []
    alone = is_open & (seen.count <= 1)
    rest = is_open & ~alone
    one_place = len(seen.pose) > 0 and _spread(centers[distinct(seen.pose)]) < ONE_PLACE * float(
        np.median(seen.distance)
    )
    one_place = one_place and len(distinct(seen.pose)) > 1

    def add(code: str, severity: str, which: BoolArray, one: str, many: str, remedy: str) -> None:
        bad = np.flatnonzero(which)
        if len(bad) == 0:
            return
        listed = few([names(name, int(i)) for i in bad])
        text = f"{first_upper(listed)} {one}" if len(bad) == 1 else f"{len(bad)} {kind}s {many} ({listed})"
        findings.append(
            Finding(
                code, severity, f"{text}. {remedy}", name, tuple(int(i) for i in bad),
                {"share": len(bad) / len(weakness), "weakest": float(weakness[bad].max())},
            )
        )  # fmt: skip

    if one_place:
        findings.append(
            Finding(
                "pure_rotation", "problem",
                f"The cameras only turn: their centres are in one place, so no depth of any {kind} is determined. Add "
                "images taken from elsewhere.",
                name, tuple(int(i) for i in np.flatnonzero(rest)), {"spread": _spread(centers[distinct(seen.pose)])},
            )
        )  # fmt: skip
        rest = np.zeros_like(rest)
    if kind == "point":
        add(
            "point_seen_once", "problem", alone & (seen.count == 1),
            "is seen by one camera only: its depth is open", "are seen by one camera only: their depth is open",
            "Drop them or add views.",
        )  # fmt: skip
        add(
            "point_no_parallax", "problem", rest,
            "has no parallax: the rays to it are parallel, it could be at infinity",
            "have no parallax: the rays to them are parallel, they could be at infinity",
            "Add views from farther apart, or drop them.",
        )  # fmt: skip
        findings += _flat(problem, name, weakness, undetermined)
    else:
        end_on, same_plane, along = _line_geometry(problem, name, seen, centers)
        add(
            "line_end_on", "problem", is_open & end_on & (seen.count > 0),
            "is seen end-on: it points at the cameras", "are seen end-on: they point at the cameras",
            "A view from the side would determine them.",
        )  # fmt: skip
        alone, rest = alone & ~end_on, rest & ~end_on
        add(
            "line_seen_once", "problem", alone & (seen.count == 1),
            "is seen by one camera only: it can be any line in the plane through it and the camera",
            "are seen by one camera only: each can be any line in the plane through it and the camera",
            "Drop them or add views.",
        )  # fmt: skip
        add(
            "line_along_motion", "problem", rest & same_plane & along,
            "runs along the motion of the cameras, so they all see it in one plane: it can slide and turn in it",
            "run along the motion of the cameras, so these all see each in one plane: they can slide and turn in it",
            "A view from beside the path would determine them.",
        )  # fmt: skip
        add(
            "line_in_epipolar_plane", "problem", rest & same_plane & ~along,
            "lies in a plane with the cameras that see it (its epipolar plane) and can slide and turn in it",
            "lie in a plane with the cameras that see them (their epipolar plane) and can slide and turn in it",
            "A view from outside that plane would determine them.",
        )  # fmt: skip
        rest = rest & ~same_plane
        add("line_open", "problem", rest, "is not determined", "are not determined", "Drop them or add views.")
    add(
        f"{kind}_unseen", "problem", is_open & (seen.count == 0),
        "is seen by no camera and not determined otherwise", "are seen by no camera and not determined otherwise",
        "Drop them.",
    )  # fmt: skip
    shaky = ~is_open & (weakness > weak)
    add(
        f"{kind}_weak", "warning", shaky,
        f"is weak: uncertain by more than {weak:.0%} of the distance",
        f"are weak: uncertain by more than {weak:.0%} of the distance",
        "Views from farther apart would help.",
    )  # fmt: skip
    return findings


def _spread(places: FloatArray) -> float:
    return float(np.linalg.norm(places - places.mean(axis=0), axis=1).max())


def _flat(problem: Problem, name: str, weakness: FloatArray, undetermined: float) -> list[Finding]:
    """Notice that all points lie on one plane."""
    good = weakness <= undetermined
    xyz = problem.variables[name].ambient()[good]
    if len(xyz) < 4:
        return []
    extent = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(xyz.T)), 0.0))
    if not extent[0] < FLAT * extent[1]:
        return []
    return [
        Finding(
            "planar_scene", "warning",
            "All points lie on one plane: poses follow from a homography, which with two views has two solutions, and "
            "focal lengths cannot be told from distances in views that face it. Add points off the plane.",
            name, tuple(int(i) for i in np.flatnonzero(good)), {"flatness": float(extent[0] / max(extent[1], 1e-300))},
        )
    ]  # fmt: skip


def _line_geometry(
    problem: Problem, name: str, seen: Observers, centers: FloatArray
) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return which lines are seen end-on, in one plane with their cameras, and along the motion of these."""
    group = problem.variables[name]
    d = group.ambient()[:, 3:]
    d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)
    at = nearest_place(group.manifold, group.state, seen.middle)
    ray = at[seen.variable] - centers[seen.pose]
    normal = np.cross(ray, d[seen.variable])
    size, away = np.linalg.norm(normal, axis=1), np.maximum(np.linalg.norm(ray, axis=1), 1e-300)
    # a ray along the line has almost no plane; what little there is says nothing
    sees_side = size > np.sin(END_ON) * away
    end_on = np.bincount(seen.variable, weights=sees_side, minlength=len(group)) == 0
    planes = _scatter(normal / np.maximum(size, 1e-300)[:, None] * sees_side[:, None], seen.variable, len(group))
    values = np.linalg.eigvalsh(planes)
    same_plane = values[:, 1] <= np.sin(ALONG) ** 2 * np.maximum(values[:, 2], 1e-300)
    path = _scatter(centers[seen.pose] - seen.middle[seen.variable], seen.variable, len(group))
    values, vectors = np.linalg.eigh(path)
    straight = values[:, 1] < np.sin(ALONG) ** 2 * values[:, 2]
    along = straight & (np.abs(np.einsum("ni,ni->n", vectors[:, :, 2], d)) > np.cos(ALONG))
    return end_on, same_plane, along


def _scatter(rows: FloatArray, index: IntArray, count: int) -> FloatArray:
    """Sum of r r^T over the rows of each index, (count, 3, 3)."""
    out = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            out[:, i, j] = out[:, j, i] = np.bincount(index, weights=rows[:, i] * rows[:, j], minlength=count)
    return out


__all__ = ["landmark_findings"]
