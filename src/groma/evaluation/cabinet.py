# SPDX-License-Identifier: BSD-3-Clause
"""The packaged scene of ``groma demo``, and how near a map of it comes to what was measured.

58 photographs of a filing cabinet; a start from points alone (SIFT, matches of neighbours, incremental mapping); poses
by motion capture, which the map never sees. See ``data/ATTRIBUTION.md``.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

from groma.evaluation.poses import evaluate_poses
from groma.gates import gate
from groma.scene import Scene, Similarity

#: The cabinet in the frame of the motion capture: centre, heading about the vertical z, half sizes. Metres, radians.
#: Derived from the motion capture.
CENTER = np.array([-1.52988, 0.456476, 0.281575])
#: Derived from the motion capture, as above.
HEADING = 3.10232
#: Derived from the motion capture, as above.
HALF_SIZE = np.array([0.396318, 0.222742, 0.272709])


@dataclass(frozen=True)
class CabinetGates:
    """Which lines belong to an edge of the cabinet, and which planes and directions meet at a right angle."""

    near: float = gate(0.08, "m", "from the edge to the middle of a line", "convention: a fifth of the least half size")
    parallel_deg: float = gate(5.0, "degrees", "between an edge and its line", "convention: of this measure")
    covered: float = gate(0.3, "share", "of an edge that a line covers", "convention: of this measure")
    right_deg: float = gate(2.0, "degrees", "from a right angle", "convention: of this measure")


GATES = CabinetGates()


def folder() -> Path:
    """Return the folder with ``images``, ``model`` (the start) and ``motion_capture`` (poses to compare with)."""
    return Path(str(files("groma"))) / "data" / "cabinet"


def evaluate_cabinet(start: Scene, scene: Scene, reference: Scene) -> dict[str, Any]:
    """Return how near the map of the cabinet comes to the poses and the size that were measured.

    Photographs have no scale: the map is aligned with the motion capture by a similarity of the camera centres.

    Parameters
    ----------
    start, scene : Scene
        The model that the map began with, and the map.
    reference : Scene
        Poses by motion capture, in ``folder() / "motion_capture"``.
    """
    before, after = evaluate_poses(start, reference), evaluate_poses(scene, reference)
    return {
        "poses": {"before": before.to_dict(), "after": after.to_dict()},
        "cabinet": score_cabinet(scene, after.alignment),
        "right_angles_deg": right_angles(scene),
    }


def sentences(numbers: dict[str, Any]) -> list[str]:
    """Say what :func:`evaluate_cabinet` found."""
    poses, cabinet, angles = numbers["poses"], numbers["cabinet"], numbers["right_angles_deg"]
    size = " x ".join("?" if np.isnan(value) else f"{value:.2f}" for value in cabinet["size"])
    measured = " x ".join(f"{value:.2f}" for value in cabinet["size_measured"])
    lines = [
        "Compared with measurements that the map does not use (its scale is taken from the motion capture):",
        f"  camera centres: {1000 * poses['before']['center_rmse']:.1f} mm -> "
        f"{1000 * poses['after']['center_rmse']:.1f} mm from the motion capture (rms)",
        f"  cabinet: {cabinet['num_edges']} of 12 edges have lines; {size} m, measured {measured} m",
    ]
    if cabinet["num_lines"]:
        lines.append(f"  lines on its edges: {1000 * cabinet['distance']:.0f} mm from the measured edges (median)")
    if len(angles):
        slip = np.mean(np.abs(np.asarray(angles) - 90.0))
        lines.append(f"  right angles among planes and directions: {len(angles)}, off by {slip:.2f} degrees on average")
    return lines


def score_cabinet(scene: Scene, measured_from_scene: Similarity) -> dict[str, Any]:
    """Find the lines on the edges of the cabinet, and its size by them.

    Returns
    -------
    dict
        ``num_edges`` of its twelve with a line on them, ``num_lines`` on edges, their median ``distance`` from the
        measured edge (m), ``size`` (3,) as length, depth and height between lines on opposite edges (m; NaN where one
        side has none), and ``size_measured``.
    """
    turn = np.array([[np.cos(HEADING), -np.sin(HEADING), 0], [np.sin(HEADING), np.cos(HEADING), 0], [0, 0, 1]])
    ends = (measured_from_scene.points(scene.lines.segments.reshape(-1, 3)) - CENTER) @ turn
    ends = ends.reshape(-1, 2, 3)
    middle, along = ends.mean(1), ends[:, 1] - ends[:, 0]
    length = np.linalg.norm(along, axis=1)
    axis = np.abs(along).argmax(1)
    rows = np.arange(len(ends))
    corner = np.where(middle < 0, -HALF_SIZE, HALF_SIZE)
    away = np.abs(middle - corner)
    away[rows, axis] = 0.0
    on_edge = (
        (np.abs(along)[rows, axis] > np.cos(np.deg2rad(GATES.parallel_deg)) * length)
        & (length > GATES.covered * 2 * HALF_SIZE[axis])
        & (away.max(1) < GATES.near)
        & (np.abs(middle[rows, axis]) < HALF_SIZE[axis])
    )
    side = middle > 0
    edges = {(int(axis[row]), *np.delete(side[row], axis[row]).tolist()) for row in np.flatnonzero(on_edge)}
    size = np.full(3, np.nan)
    for k in range(3):
        used = on_edge & (axis != k)
        low, high = middle[used & ~side[:, k], k], middle[used & side[:, k], k]
        if len(low) and len(high):
            size[k] = np.median(high) - np.median(low)
    distance = float(np.median(np.linalg.norm(away[on_edge], axis=1))) if on_edge.any() else float("nan")
    counts = {"num_edges": len(edges), "num_lines": int(on_edge.sum())}
    return {**counts, "distance": distance, "size": size, "size_measured": 2 * HALF_SIZE}


def right_angles(scene: Scene) -> list[float]:
    """Return the angles, degrees, of all pairs of plane normals and directions that are nearly orthogonal."""
    vectors = np.concatenate([scene.planes.hesse[:, :3], scene.directions.vectors])
    first, second = np.triu_indices(len(vectors), 1)
    angles = np.rad2deg(np.arccos(np.clip(np.abs(np.einsum("ij,ij->i", vectors[first], vectors[second])), 0.0, 1.0)))
    return angles[angles > 90.0 - GATES.right_deg].tolist()
