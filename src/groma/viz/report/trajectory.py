# SPDX-License-Identifier: BSD-3-Clause
"""A tracked sequence as one self-contained HTML file.

The page of :func:`groma.viz.report.page.write_report` shows the map, preceded by the path of the camera from above and
from the side, its error over time if there is a reference, the features tracked in each frame, and timings.

*Up* is opposite to the mean y axis of the cameras; the view from the side is across the longer extent of the path.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from groma._typing import FloatArray
from groma.evaluation.trajectory import TrajectoryScores, apply_similarity
from groma.geometry import quaternion
from groma.io.trajectories import Trajectory
from groma.scene import Scene
from groma.scene.local_frame import upward
from groma.viz.framing import horizontal
from groma.viz.pictures import ImageFiles
from groma.viz.report import digits as _digits
from groma.viz.report import tables as _page_tables
from groma.viz.report.page import PageContents, write_report
from groma.viz.report.path_charts import Curve, legend, over_time, path

#: Words and colours of the statuses of frames other than tracked.
_STATUSES = {
    "weak": ("weak", "#e8c53a"),
    "found": ("found again", "#2c6fbb"),
    "lost": ("lost", "#d9472b"),
    "skipped": ("skipped", "#93989f"),
    "starting": ("starting", "#b9bdc4"),
}
_KINDS = {"points": "var(--after)", "lines": "var(--line)", "planes": "var(--plane)"}
#: A path is interrupted where this many times the usual time passes between two poses.
_GAP = 3.0
#: Times of frames are cut off at this multiple of their 95th percentile: the first frames may compile.
_CUT = 2.0


class Frame(Protocol):
    """Interface to a tracked frame."""

    @property
    def timestamp(self) -> float:
        """Seconds."""
        ...

    @property
    def status(self) -> str:
        """Such as ``tracked`` or ``lost``."""
        ...

    @property
    def counts(self) -> Mapping[str, int]:
        """Agreeing points, lines and planes."""
        ...

    @property
    def timings(self) -> Mapping[str, float]:
        """Seconds by stage, and ``total``."""
        ...


class Track(Protocol):
    """Interface to the result of a tracker."""

    @property
    def trajectory(self) -> Trajectory:
        """world_from_cam of all frames with a pose."""
        ...

    @property
    def scene(self) -> Scene:
        """The map."""
        ...

    @property
    def keyframes(self) -> FloatArray:
        """Time stamps of the keyframes."""
        ...

    @property
    def statistics(self) -> Mapping[str, Any]:
        """Counts, and ``milliseconds`` by stage."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences for the user."""
        ...


def write_track_report(
    path: str | os.PathLike[str],
    track: Track,
    frames: Sequence[Frame] = (),
    scores: TrajectoryScores | None = None,
    images: ImageFiles | None = None,
    title: str = "Track",
    *,
    warnings: Sequence[str] | None = None,
    diagnosis: Mapping[str, Any] | None = None,
) -> None:
    """Write a page of a tracked sequence that opens in any browser.

    Parameters
    ----------
    path
        The HTML file; it is replaced.
    track
        Trajectory, map and statistics, such as :class:`groma.tracking.TrackResult`.
    frames
        All frames in temporal order, for the charts over time.
    scores
        Comparison with a reference, if there is one.
    images
        Photographs of the keyframes: a folder, or files by image name.
    title
        Heading of the page.
    warnings
        Sentences in a box; by default those of the track.
    diagnosis
        As for :func:`groma.viz.report.page.write_report`.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    write_report(
        path,
        None,
        track.scene,
        None,
        images,
        title,
        PageContents(
            warnings=track.warnings if warnings is None else warnings,
            diagnosis=diagnosis,
            cards=_path_cards(track, scores)
            + _time_cards(track, frames, scores)
            + _stage_table(track)
            + _scores(scores),
            tiles=_tiles(track, scores),
        ),
    )


def _tiles(track: Track, scores: TrajectoryScores | None) -> str:
    numbers = track.statistics
    statuses = numbers.get("frames", {})
    known = sum(count for status, count in statuses.items() if status in ("tracked", "found", "weak"))
    cells = [(f"{known:,} <i>of</i> {sum(statuses.values()):,}", "frames with a pose")] if statuses else []
    if scores is not None:
        label = f"position error (rms) on a path of {scores.path_length:.3g}, units of the reference"
        cells.append((f"{scores.ate.rmse:.3g}", label))
    else:
        length = np.linalg.norm(np.diff(track.trajectory.world_from_cam[:, 4:], axis=0), axis=1).sum()
        cells.append(
            (f"{length:.4g}", "length of the path" + ("" if numbers.get("metric", True) else ", unknown scale"))
        )
    total = numbers.get("milliseconds", {}).get("total")
    if total:
        median, high = _digits.even([total["median"], total["p95"]])
        cells.append((f"{median} ms", f"per frame, median; 95th percentile {high} ms"))
    cells += [(f"{len(track.keyframes):,}", "keyframes"), (f"{numbers.get('loops', 0):,}", "loops closed")]
    return _page_tables.as_tiles(cells)


def _path_cards(track: Track, scores: TrajectoryScores | None) -> str:
    """The path from above and from the side; with a reference, in its world."""
    times, poses = track.trajectory.timestamps, track.trajectory.world_from_cam
    if not len(poses):
        return ""
    if scores is not None:
        poses = apply_similarity(scores.similarity, poses)
    curves = [("estimate", "var(--after)", times, poses)]
    if scores is not None:
        curves.append(("reference", "var(--before)", scores.timestamps, scores.reference))
    turn = quaternion.to_matrix(poses[:, :4])
    up = upward(turn.transpose(0, 2, 1))
    axes = _axes(poses[:, 4:], up)
    keyframes = poses[np.isin(times, track.keyframes), 4:]
    cards = ""
    for name, rows, words in (
        ("Path from above", (0, 1), ("along the path's longer extent", "")),
        ("Path from the side", (0, 2), ("along the path's longer extent", "up")),
    ):
        frame = axes[list(rows)]
        shown = [
            Curve(label, colour, _interrupted(when, at[:, 4:] @ frame.T), dashed=label == "reference")
            for label, colour, when, at in curves
        ]
        caption = "Filled: start; hollow: end; dots: keyframes. " + (legend(shown) if len(shown) > 1 else "")
        cards += _page_tables.card(name, caption, path(shown, keyframes @ frame.T, *words))
    return cards


def _axes(centers: FloatArray, up: FloatArray) -> FloatArray:
    """Return rows: along the longer horizontal extent, across it, and up."""
    first, second = horizontal(up)
    flat = (centers - centers.mean(axis=0)) @ np.stack([first, second], axis=1)
    spread = flat.T @ flat
    angle = float(0.5 * np.arctan2(2 * spread[0, 1], spread[0, 0] - spread[1, 1]))
    along: FloatArray = np.cos(angle) * first + np.sin(angle) * second
    # the end of the path is to the right of its start
    if (centers[-1] - centers[0]) @ along < 0:
        along = -along
    return np.stack([along, np.asarray(np.cross(up, along)), up])


def _interrupted(times: FloatArray, places: FloatArray) -> FloatArray:
    """Return places with NaN where time passes without a pose."""
    steps = np.diff(times)
    if not len(steps):
        return places
    return np.insert(places, np.flatnonzero(steps > _GAP * max(float(np.median(steps)), 1e-9)) + 1, np.nan, axis=0)


def _time_cards(track: Track, frames: Sequence[Frame], scores: TrajectoryScores | None) -> str:
    cards, begin = "", min([*track.trajectory.timestamps[:1], *(frame.timestamp for frame in frames[:1])], default=0.0)
    if scores is not None:
        curve = Curve("error", "var(--after)", scores.errors)
        cards += _page_tables.card(
            "Error over time",
            "Distance from the reference after alignment, in units of the reference.",
            over_time(scores.timestamps - begin, [curve]),
        )
    if not frames:
        return cards
    times = np.array([frame.timestamp for frame in frames]) - begin
    order = np.argsort(times, kind="stable")
    times, frames = times[order], [frames[k] for k in order]
    status = np.array([frame.status for frame in frames])
    marks = [(times[status == key], *of_status) for key, of_status in _STATUSES.items() if (status == key).any()]
    bands = [(when, colour) for when, _, colour in marks]
    marked = legend([Curve(words, colour, when) for when, words, colour in marks])
    curves = []
    for kind, colour in _KINDS.items():
        counts = np.array([frame.counts.get(kind, 0) for frame in frames], dtype=float)
        if counts.any():
            curves.append(Curve(kind, colour, counts))
    cards += _page_tables.card(
        "Followed",
        f"Points, lines and planes that agree with the pose of each frame. {legend(curves)}{marked}",
        over_time(times, curves, bands),
    )
    spent = 1e3 * np.array([frame.timings.get("total", np.nan) for frame in frames])
    if np.isfinite(spent).any():
        most = _CUT * float(np.nanpercentile(spent, 95))
        caption = "Milliseconds, all stages together." + (
            " Longer times are cut off." if np.nanmax(spent) > most else ""
        )
        chart = over_time(times, [Curve("total", "var(--after)", np.minimum(spent, most))])
        cards += _page_tables.card("Time per frame", caption, chart)
    return cards


def _stage_table(track: Track) -> str:
    stages = track.statistics.get("milliseconds", {})
    if not stages:
        return ""
    ordered = sorted(stages.items(), key=lambda item: (item[0] == "total", -item[1]["median"]))
    median, high = (_digits.even([spent[key] for _, spent in ordered]) for key in ("median", "p95"))
    rows = [
        [name.replace("_", " "), median[row], high[row], f"{spent['frames']:,}"]
        for row, (name, spent) in enumerate(ordered)
    ]
    head = ["stage", "median, ms", "95th percentile, ms", "frames"]
    return _page_tables.table("Stages", "Time of the stages of a frame, where they took place.", head, rows)


def _scores(scores: TrajectoryScores | None) -> str:
    if scores is None:
        return ""
    rows = []
    for name, spread in (
        ("position", scores.ate),
        ("rotation, degrees", scores.rotation_deg),
        ("position, frame to frame", scores.rpe_translation),
        ("rotation, frame to frame, degrees", scores.rpe_rotation_deg),
    ):
        if spread is not None:
            rows.append([name, *(f"{value:.4g}" for value in (spread.rmse, spread.median, spread.max))])
    words = {"se3": "rotation and translation", "sim3": "rotation, translation and scale", "none": "nothing"}
    caption = f"{scores.num_poses:,} poses over {scores.path_length:.4g}; aligned: {words[scores.alignment]}"
    if scores.alignment == "sim3":
        caption += f" ({scores.similarity.scale:.4g})"
    if scores.by_orientations:
        caption += ", by positions and orientations, since the positions alone do not determine the rotation"
    if scores.drift_percent is not None:
        caption += f". Drift {scores.drift_percent:.3g} %, {scores.drift_deg_per_metre:.3g} degrees per unit"
    return _page_tables.table("Against the reference", caption + ".", ["error", "rms", "median", "largest"], rows)
