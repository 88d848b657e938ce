# SPDX-License-Identifier: BSD-3-Clause
"""Why a point or a line is not determined by its own observations, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.gates import NORMAL
from groma.solver.linear.visible_motion import Observers, nearest_place
from groma.solver.observability.findings import Finding, few, first_upper
from groma.solver.observability.gates import DIAGNOSIS
from groma.solver.observability.inspection import Inspection


@dataclass(frozen=True)
class _Landmarks:
    """The points or lines of a group that are not determined, sorted by how much of them is seen."""

    inspection: Inspection
    #: The group and its kind: point, line.
    name: str
    kind: str
    seen: Observers
    #: (count,) as given to :func:`landmark_findings`.
    weakness: FloatArray
    num_unobservable: IntArray
    #: (count,) not determined and seen by one camera, by several, by none.
    alone: BoolArray
    rest: BoolArray
    unseen: BoolArray
    #: (count,) determined, but weak.
    shaky: BoolArray

    def finding(self, code: str, severity: str, which: BoolArray, one: str, many: str, remedy: str) -> list[Finding]:
        """Return the finding about some landmarks, in words for one and for many; none without landmarks."""
        bad = np.flatnonzero(which)
        if len(bad) == 0:
            return []
        names = [self.inspection.names(self.name, int(i)) for i in bad[:1]]
        if len(bad) == 1:
            text, remedy = f"{first_upper(names[0])} {one}", _of_one(remedy)
        elif len(bad) > max(DIAGNOSIS.most * len(which), 1):
            everyone = "All" if len(bad) == len(which) else "Nearly all"
            text = f"{everyone} {self.kind}s ({len(bad):,} of {len(which):,}) {many}"
        else:
            listed = few([self.inspection.names(self.name, int(i)).removeprefix(f"{self.kind} ") for i in bad])
            text = f"{len(bad):,} of {len(which):,} {self.kind}s {many} ({self.kind}s {listed})"
        values = {"share": len(bad) / len(which), "weakest": float(self.weakness[bad].max())}
        return [Finding(code, severity, f"{text}. {remedy}", self.name, tuple(int(i) for i in bad), values)]


def landmark_findings(
    inspection: Inspection, name: str, seen: Observers, weakness: FloatArray, num_unobservable: IntArray
) -> list[Finding]:
    """Explain the points or lines of a group whose weakest direction is not determined, or weak.

    Parameters
    ----------
    inspection : Inspection
        The linearisation.
    name : str
        The group.
    seen : Observers
        Who sees it.
    weakness : (count,) float
        Standard deviation of the weakest direction, as a share of the viewing distance.
    num_unobservable : (count,) int
        Directions that are not determined.
    """
    kind = inspection.problem.variables[name].manifold.kind
    unobservable = ~(weakness <= DIAGNOSIS.undetermined)
    poses = np.bincount(seen.of(unobservable)[0], minlength=len(unobservable))
    alone, rest, unseen = unobservable & (poses == 1), unobservable & (poses > 1), unobservable & (poses == 0)
    shaky = ~unobservable & (weakness > DIAGNOSIS.weak)
    findings: list[Finding] = []
    turning = _only_turning(kind, seen, rest, shaky)
    if turning is not None:
        bad = tuple(int(i) for i in np.flatnonzero(rest | shaky))
        findings.append(Finding("pure_rotation", "problem", turning[0], name, bad, {"spread": turning[1]}))
        rest, shaky = np.zeros_like(rest), np.zeros_like(shaky)
    landmarks = _Landmarks(inspection, name, kind, seen, weakness, num_unobservable, alone, rest, unseen, shaky)
    special, explained = _point_findings(landmarks) if kind == "point" else _line_findings(landmarks)
    return [*findings, *special, *_general_findings(landmarks, rest & ~explained)]


def _point_findings(landmarks: _Landmarks) -> tuple[list[Finding], BoolArray]:
    """Explain points by their rays; also return which of those seen by several cameras that explains."""
    inspection, name, rest = landmarks.inspection, landmarks.name, landmarks.rest
    angle = _parting(inspection, name, landmarks.alone | rest | landmarks.unseen, landmarks.seen)
    apart = angle > DIAGNOSIS.parallax
    if rest.any():
        apart |= (angle > DIAGNOSIS.small_parallax) & (inspection.worst_residuals(name, rest) > NORMAL.sure)
    findings = landmarks.finding(
        "point_seen_once", "problem", landmarks.alone,
        "is seen by one camera only: its depth is not determined",
        "are seen by one camera only: their depth is not determined",
        "Drop them or add views.",
    )  # fmt: skip
    findings += landmarks.finding(
        "point_no_parallax", "problem", rest & ~apart,
        "has no parallax: the rays to it are almost parallel, it could be at infinity",
        "have no parallax: the rays to them are almost parallel, they could be at infinity",
        "Add views from farther apart if their place matters; for the rotation of the cameras they count.",
    )  # fmt: skip
    return findings + _flat(inspection, name, landmarks.weakness, landmarks.seen), ~apart


def _line_findings(landmarks: _Landmarks) -> tuple[list[Finding], BoolArray]:
    """Explain lines by where their cameras are; also return which of those seen by several cameras that explains."""
    end_on, same_plane, along = _line_geometry(landmarks.inspection, landmarks.name, landmarks.seen)
    alone, rest = landmarks.alone & ~end_on, landmarks.rest & ~end_on
    several = landmarks.num_unobservable[landmarks.rest & same_plane] > 1
    can = f"can slide {'and' if several.all() else 'or'} turn in it"
    findings = landmarks.finding(
        "line_end_on", "problem", (landmarks.alone | landmarks.rest) & end_on,
        "is seen end-on: it points at the cameras", "are seen end-on: they point at the cameras",
        "A view from the side would determine them.",
    )  # fmt: skip
    findings += landmarks.finding(
        "line_seen_once", "problem", alone,
        "is seen by one camera only: it can be any line in the plane through it and the camera",
        "are seen by one camera only: each can be any line in the plane through it and the camera",
        "Drop them or add views.",
    )  # fmt: skip
    findings += landmarks.finding(
        "line_along_motion", "problem", rest & same_plane & along,
        f"runs along the motion of the cameras, so they all see it in one plane: it {can}",
        f"run along the motion of the cameras, so these see each in one plane: they {can}",
        "A view from beside the path would determine them.",
    )  # fmt: skip
    findings += landmarks.finding(
        "line_in_epipolar_plane", "problem", rest & same_plane & ~along,
        f"lies in a plane with the cameras that see it (its epipolar plane) and {can}",
        f"lie in a plane with the cameras that see them (their epipolar plane) and {can}",
        "A view from outside that plane would determine them.",
    )  # fmt: skip
    return findings, end_on | same_plane


def _general_findings(landmarks: _Landmarks, rest: BoolArray) -> list[Finding]:
    """Name the landmarks that nothing else explains, those without observations, and weak ones."""
    findings = landmarks.finding(
        f"{landmarks.kind}_unobservable", "problem", rest,
        "is not determined: some of its observations contradict the others, and hardly count under a robust loss",
        "are not determined: some of their observations contradict the others, and hardly count under a robust loss",
        "These may be wrong matches.",
    )  # fmt: skip
    findings += landmarks.finding(
        f"{landmarks.kind}_unseen", "problem", landmarks.unseen,
        "is seen by no camera and not determined otherwise", "are seen by no camera and not determined otherwise",
        "Drop them.",
    )  # fmt: skip
    findings += landmarks.finding(
        f"{landmarks.kind}_weak", "warning", landmarks.shaky,
        f"is weak: uncertain by more than {100 * DIAGNOSIS.weak:.0f} % of the distance",
        f"are weak: uncertain by more than {100 * DIAGNOSIS.weak:.0f} % of the distance",
        "Views from farther apart would help.",
    )  # fmt: skip
    return findings


def _parting(inspection: Inspection, name: str, which: BoolArray, seen: Observers) -> FloatArray:
    """Twice the largest angle (count,) between the mean ray to a point and one of its rays; zero without rays."""
    variable, pose = seen.of(which)
    group = inspection.problem.variables[name]
    ray = group.ambient()[variable] - seen.centers[pose]
    ray /= np.maximum(np.linalg.norm(ray, axis=1, keepdims=True), 1e-300)
    mean = np.zeros((len(group), 3))
    np.add.at(mean, variable, ray)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-300)
    angle = np.arctan2(
        np.linalg.norm(np.cross(mean[variable], ray), axis=1), np.einsum("ni,ni->n", mean[variable], ray)
    )
    largest = np.zeros(len(group))
    np.maximum.at(largest, variable, 2 * angle)
    return largest


def _only_turning(kind: str, seen: Observers, rest: BoolArray, shaky: BoolArray) -> tuple[str, float] | None:
    """Say that the cameras stay in one place, or too near to one for most landmarks; with their spread."""
    used = np.flatnonzero(np.bincount(seen.pose, minlength=len(seen.centers)))
    affected = int((rest | shaky).sum())
    if len(used) < 2 or not affected:
        return None
    spread = _spread(seen.centers[used]) / float(np.median(seen.distance))
    if spread < DIAGNOSIS.flat and rest.any():
        text = f"The cameras only turn: their centres are in one place, so the depth of {kind}s is not determined."
    elif spread < DIAGNOSIS.edge_on and affected > 0.5 * len(rest):
        text = (
            f"The cameras hardly move: their centres are within {100 * spread:.1f} % of the viewing distance, and the "
            f"depth of {_so_many(kind, affected, len(rest))} is not determined or uncertain by more than "
            f"{100 * DIAGNOSIS.weak:.0f} %."
        )
    else:
        return None
    return f"{text} Add images taken from elsewhere.", spread


def _of_one(remedy: str) -> str:
    """Return a remedy for several landmarks as one for a single landmark."""
    for several, single in (("them", "it"), ("their", "its"), ("they count", "it counts")):
        remedy = remedy.replace(several, single)
    return remedy


def _so_many(kind: str, affected: int, count: int) -> str:
    """Return "all 80 points" or "43 of 80 points"."""
    return f"all {count:,} {kind}s" if affected == count else f"{affected:,} of {count:,} {kind}s"


def _spread(places: FloatArray) -> float:
    return float(np.linalg.norm(places - places.mean(axis=0), axis=1).max())


def _flat(inspection: Inspection, name: str, weakness: FloatArray, seen: Observers) -> list[Finding]:
    """Notice that all points lie on one plane."""
    good = weakness <= DIAGNOSIS.undetermined
    xyz = inspection.problem.variables[name].ambient()[good]
    if len(xyz) < 4:
        return []
    xyz = xyz - xyz.mean(axis=0)
    extent = np.sqrt(np.maximum(np.linalg.eigvalsh(xyz.T @ xyz / len(xyz)), 0.0))
    uncertain = NORMAL.alike * float(np.median(weakness[good] * seen.distance[good]))
    if not extent[0] < max(DIAGNOSIS.flat * extent[1], min(uncertain, DIAGNOSIS.little * extent[1])):
        return []
    return [
        Finding(
            "planar_scene", "warning",
            "All points lie on one plane: poses follow from a homography, which with two views has two solutions, and "
            "focal lengths cannot be separated from distances in frontal views. Add points off the plane.",
            name, tuple(int(i) for i in np.flatnonzero(good)), {"flatness": float(extent[0] / max(extent[1], 1e-300))},
        )
    ]  # fmt: skip


def _line_geometry(inspection: Inspection, name: str, seen: Observers) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Return which lines are seen end-on, in one plane with their cameras, and along the motion of these."""
    group, centers = inspection.problem.variables[name], seen.centers
    d = group.ambient()[:, 3:]
    d = d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-300)
    at = nearest_place(group.manifold, group.state, seen.middle)
    ray = at[seen.variable] - centers[seen.pose]
    normal = np.cross(ray, d[seen.variable])
    size, away = np.linalg.norm(normal, axis=1), np.maximum(np.linalg.norm(ray, axis=1), 1e-300)
    # a ray along the line has almost no plane
    sees_side = size > np.sin(DIAGNOSIS.end_on) * away
    end_on = np.bincount(seen.variable, weights=sees_side, minlength=len(group)) == 0
    planes = _scatter(normal / np.maximum(size, 1e-300)[:, None] * sees_side[:, None], seen.variable, len(group))
    values = np.linalg.eigvalsh(planes)
    same_plane = values[:, 1] <= np.sin(DIAGNOSIS.along) ** 2 * np.maximum(values[:, 2], 1e-300)
    path = _scatter(centers[seen.pose] - seen.middle[seen.variable], seen.variable, len(group))
    values, vectors = np.linalg.eigh(path)
    straight = values[:, 1] < np.sin(DIAGNOSIS.along) ** 2 * values[:, 2]
    along = straight & (np.abs(np.einsum("ni,ni->n", vectors[:, :, 2], d)) > np.cos(DIAGNOSIS.along))
    return end_on, same_plane, along


def _scatter(rows: FloatArray, index: IntArray, count: int) -> FloatArray:
    """Sum of r r^T over the rows of each index, (count, 3, 3)."""
    out = np.empty((count, 3, 3))
    for i in range(3):
        for j in range(i, 3):
            out[:, i, j] = out[:, j, i] = np.bincount(index, weights=rows[:, i] * rows[:, j], minlength=count)
    return out
