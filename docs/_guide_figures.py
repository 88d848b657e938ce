# SPDX-License-Identifier: BSD-3-Clause
"""Figures of the guides for the directive ``drawn``: small made problems, solved by groma when the pages are built."""

import tempfile
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import groma
from groma.adjustment.parts.cut import write_parts
from groma.evaluation.trajectory import score_trajectory
from groma.geometry import quaternion, se3
from groma.io import read_scene
from groma.io.trajectories import Trajectory
from groma.scene import synthetic
from groma.scene.pose_graph import GraphPoses, Motions, PoseGraph

_BLUE, _GREEN, _RED, _GREY = "#2a6fb0", "#2f8f46", "#c8372d", "#8a8a8a"


def pose_graph(figure: Figure) -> None:
    """A walk of two rounds whose odometry drifts (left), and the same after an adjustment with six recognised places,
    one of them wrong (right). The robust loss gives up the wrong edge, dashed.
    """
    rng = np.random.default_rng(7)
    truth = _rounds(80)
    first = np.concatenate([np.arange(79), [0, 8, 16, 24, 32, 5]])
    second = np.concatenate([np.arange(1, 80), [40, 48, 56, 64, 72, 60]])
    motion = se3.compose(se3.inverse(truth[first]), truth[second])
    motion[-1] = se3.identity()
    noise = np.concatenate([rng.normal(0, 0.01, (len(first), 3)), rng.normal(0, 0.02, (len(first), 3))], axis=1)
    measured = se3.compose(motion, se3.exp(noise * [1, 1, 0, 0, 0, 1]))
    information = np.tile(np.diag([1e4] * 3 + [2500.0] * 3), (len(first), 1, 1))
    start = GraphPoses(ids=np.arange(80), world_from_body=_chained(truth[0], measured[:79]))
    graph = PoseGraph(start, Motions(first, second, measured, information))
    result = groma.adjust_pose_graph(graph, groma.PoseGraphOptions(loss="geman_mcclure"))
    for axes, poses in zip(figure.subplots(1, 2), (graph.poses, result.graph.poses), strict=True):
        places = poses.world_from_body[:, 4:6]
        for edge in range(79, len(first)):
            ends = places[[first[edge], second[edge]]]
            axes.plot(*ends.T, color=_RED, linewidth=1, linestyle="--" if edge in result.outliers else "-")
        axes.plot(*places.T, color=_BLUE)
        axes.set(aspect="equal")
        axes.set_axis_off()
    figure.set_size_inches(7, 3)


def trajectory_errors(figure: Figure) -> None:
    """A path that drifts (blue) beside the true one (grey), aligned by a rotation and a translation. The absolute error
    is the length of the red strokes; the relative error compares each step with the true step, and knows nothing of
    what came before.
    """
    true = _rounds(40)[:34]
    step = se3.compose(se3.inverse(true[:-1]), true[1:])
    turn = np.zeros((len(step), 6))
    turn[:, 5] = 0.012
    poses = _chained(true[0], se3.compose(step, se3.exp(turn)))
    times = np.arange(len(true), dtype=float)
    scores = score_trajectory(Trajectory(times, poses), Trajectory(times, true))
    moved = scores.similarity.points(poses[:, 4:])
    axes = figure.add_subplot()
    for pair in zip(moved, true[:, 4:], strict=True):
        axes.plot(*np.array(pair)[:, :2].T, color=_RED, linewidth=0.8)
    axes.plot(*true[:, 4:6].T, color=_GREY)
    axes.plot(*moved[:, :2].T, ".-", color=_BLUE, markersize=4)
    axes.set(aspect="equal")
    axes.set_axis_off()


def improved_poses(figure: Figure) -> None:
    """Given poses (red), what an adjustment with points and lines makes of them (blue) and the truth (circles), seen
    from above.
    """
    made = synthetic.holistic(14, noise_px=0.5, seed=6)
    adjusted = groma.adjust(made.start, groma.AdjustOptions(loss="none")).scene
    aligned = groma.align(adjusted, made.truth).scene
    axes = figure.add_subplot()
    for scene, colour in ((made.start, _RED), (aligned, _BLUE)):
        centers, poses = scene.cam_centers_in_world, scene.cam_from_world
        forward = quaternion.rotate(quaternion.conjugate(poses[:, :4]), np.array([0.0, 0.0, 1.0]))
        axes.quiver(*centers[:, :2].T, *forward[:, :2].T, color=colour, width=0.005, scale=8)
    axes.plot(*made.truth.cam_centers_in_world[:, :2].T, "o", color=_GREY, fillstyle="none", markersize=9)
    axes.set(aspect="equal")
    axes.set_axis_off()


def parts(figure: Figure) -> None:
    """A walk round a corridor, cut into four parts: the points of each in a colour of its own, and the cameras, which
    all parts share.
    """
    scene = synthetic.corridor(40, seed=2).truth
    colours = (_BLUE, _GREEN, _RED, "#c98a1b")
    axes = figure.add_subplot()
    with tempfile.TemporaryDirectory() as folder:
        size = (len(scene.point_observations) + len(scene.line_observations)) // 4 + 1
        for path, colour in zip(write_parts(scene, Path(folder), size), colours, strict=True):
            axes.plot(*read_scene(path).points.xyz[:, :2].T, ".", markersize=1.5, color=colour)
    axes.plot(*scene.cam_centers_in_world[:, :2].T, "k^", markersize=4)
    axes.set(aspect="equal")
    axes.set_axis_off()


def relations(figure: Figure) -> None:
    """What relations hold: lines along a direction (blue), lines and points on a plane (green), lines that meet in a
    point (red).
    """
    axes = figure.add_subplot(projection="3d")
    for height in (0.3, 0.8, 1.3):
        axes.plot([0, 2], [0, 0], [height, height], color=_BLUE, linewidth=2)
    axes.quiver(2.2, 0, 0.8, 0.6, 0, 0, color=_BLUE, arrow_length_ratio=0.25)
    _panel(axes, np.array([[0, 0, 0], [2, 0, 0], [2, 1.5, 0], [0, 1.5, 0.0]]))
    axes.plot([0.4, 1.5], [0.4, 1.1], [0, 0], color=_GREEN, linewidth=2)
    axes.scatter([0.5, 1.1, 1.7], [1.2, 0.4, 0.7], [0, 0, 0], color=_GREEN, s=14)
    for end in ([0, 0, 1.7], [0, 1.4, 0], [0.9, 0, 0.0]):
        axes.plot(*np.array([[0, 0, 0], end]).T, color=_RED, linewidth=2)
    axes.scatter(0, 0, 0, color=_RED, s=28)
    axes.set(xlim=(0, 2.4), ylim=(0, 2.4), zlim=(0, 2.4))
    axes.set_box_aspect((1, 1, 1), zoom=1.4)
    axes.view_init(elev=22, azim=35)
    axes.set_axis_off()


def _rounds(count: int) -> np.ndarray:
    """Poses [qx qy qz qw tx ty tz] on two rounds of a rounded square, looking ahead."""
    around = np.linspace(0, 4 * np.pi, count, endpoint=False)
    radius = 2 / (np.cos(around) ** 4 + np.sin(around) ** 4) ** 0.25
    places = np.stack([radius * np.cos(around), radius * np.sin(around)], axis=1)
    ahead = np.roll(places, -1, axis=0) - np.roll(places, 1, axis=0)
    half = 0.5 * np.arctan2(ahead[:, 1], ahead[:, 0])
    zero = np.zeros(count)
    return np.stack([zero, zero, np.sin(half), np.cos(half), *places.T, zero], axis=1)


def _chained(first: np.ndarray, motions: np.ndarray) -> np.ndarray:
    poses = [first]
    for motion in motions:
        poses.append(se3.compose(poses[-1], motion))
    return np.array(poses)


def _panel(axes: Axes, corners: np.ndarray) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axes.add_collection3d(Poly3DCollection([corners], facecolor=_GREEN, alpha=0.15))
