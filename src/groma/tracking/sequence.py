# SPDX-License-Identifier: BSD-3-Clause
"""A whole sequence in one call: frames from disk in, trajectory, map, scores and what became of each frame out."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from groma._counted import counted
from groma._log import log_warnings, logged_stages, logger_of
from groma.bounded.json_text import json_text
from groma.errors import GromaError, InputError, check_kind, given_or_default, is_interrupt
from groma.evaluation.trajectory import TrajectoryScores, score_trajectory
from groma.io import atomic_output, write_scene
from groma.io.sequences import Sequence, open_sequence
from groma.io.sequences.frame import Frame
from groma.io.trajectories import write_tum
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.journal import Journal
from groma.tracking.map.track_map import TrackMap
from groma.tracking.options import TrackOptions
from groma.tracking.outcome import LOST, SKIPPED, TrackedFrame, TrackResult
from groma.tracking.saved import FrameSource, SavedMap, read_saved_map, sources_of
from groma.tracking.tracker import Tracker
from groma.viz.pictures import ImageFiles
from groma.viz.report.trajectory import write_track_report

#: Frames without a pose that are named in a warning (convention: what a sentence can hold).
NAMED = 5
#: Largest difference between the times of a frame and of a pose of the reference, seconds (convention: of the TUM
#: benchmark).
MAX_TIME_DIFFERENCE = 0.02


@dataclass(frozen=True)
class TrackProgress:
    """What a progress callback gets after every frame."""

    #: ``tracking frame``, and at the end ``adjusting all keyframes``.
    stage: str
    #: Frames done, and how many there are; 0 if that is not known.
    done: int
    total: int
    #: What became of the frame, and its name in the sequence; None at the end.
    frame: TrackedFrame | None = None
    name: str = ""


_Told = Callable[[TrackProgress], bool | None]


@dataclass(frozen=True)
class SequenceResult(TrackResult):
    """Outcome of :func:`track`: that of the tracker, with properties of the sequence."""

    #: All frames in order, with their statuses.
    frames: tuple[TrackedFrame, ...] = ()
    #: Name of the sequence, and the kind of its frames: ``rgbd``, ``stereo`` or ``mono``.
    name: str = ""
    kind: str = ""
    #: Whether the track was ended early.
    interrupted: bool = False
    #: Comparison with the reference of the sequence, if it has one; else why there is none.
    scores: TrajectoryScores | None = None
    not_compared: str = ""
    #: The saved map, if any: its path, number of keyframes, and the time of the first frame found in it.
    saved: dict[str, Any] | None = None
    #: Locations of the frames of the keyframes, so that the result can be used as a map.
    sources: tuple[dict[str, Any], ...] = ()

    def summary(self) -> dict[str, Any]:
        """Return all numbers as plain values: the content of ``summary.json``."""
        numbers = {"kind": self.kind, "interrupted": self.interrupted, **self.statistics, "sequence": self.name}
        numbers["warnings"] = list(self.warnings)
        if self.saved is not None:
            numbers["map"] = self.saved
        if self.sources:
            numbers["sources"] = list(self.sources)
        if len(self.sources) == 1:
            numbers["images"] = self.sources[0]["path"]  # read by groma localize
        # The first frame of a monocular track gets its pose later, when the map is initialised.
        placed = [self.trajectory, *(submap.trajectory for submap in self.submaps)]
        times = {time for trajectory in placed for time in trajectory.timestamps.tolist()}
        numbers["frames_without_pose"] = [
            frame.name
            for frame in self.frames
            if frame.pose is None and (frame.status == SKIPPED or frame.timestamp not in times)
        ]
        if self.scores is not None:
            numbers["reference"] = self.scores.to_dict()
        elif self.not_compared:
            numbers["reference"] = {"error": self.not_compared}
        return numbers

    def write(
        self,
        folder: str | os.PathLike[str],
        title: str = "Track",
        force: bool = False,
        images: ImageFiles | None = None,
    ) -> tuple[str, ...]:
        """Write the folder of results of ``groma track`` atomically.

        ``trajectory.txt`` (TUM), the keyframes as a COLMAP model with lines and planes beside it (``structures``),
        ``scene.npz``, ``summary.json`` and ``report.html``; further maps in ``submap_2``, ``submap_3``, ...

        Parameters
        ----------
        folder : path
            The new folder.
        title : str
            Heading of the page.
        force : bool
            Replace an existing folder.
        images : path or mapping, optional
            Photographs for the page: a folder, or files by the names of keyframes.

        Returns
        -------
        tuple of str
            Files that could not be written, with reasons: a failing report does not lose trajectories and scenes.
        """
        with atomic_output(folder, force) as draft:
            model = _failure("the COLMAP model", lambda: write_scene(self.scene, draft, format="colmap"))
            draft.mkdir(exist_ok=True)
            write_scene(self.scene, draft / "scene.npz")
            write_tum(self.trajectory, draft / "trajectory.txt")
            for number, submap in enumerate(self.submaps, start=2):
                place = draft / f"submap_{number}"
                place.mkdir()
                write_scene(submap.scene, place / "scene.npz")
                write_tum(submap.trajectory, place / "trajectory.txt")
            page = draft / "report.html"
            report = _failure(
                page.name, lambda: write_track_report(page, self, self.frames, self.scores, images, title)
            )
            failed = tuple(sentence for sentence in (model, report) if sentence)
            numbers = self.summary()
            numbers["warnings"] += failed
            (draft / "summary.json").write_text(json_text(numbers), encoding="utf-8")
        return failed


def track(
    sequence: Sequence | str | os.PathLike[str],
    options: TrackOptions | None = None,
    progress: Callable[[TrackProgress], bool | None] | None = None,
    *,
    work: str | os.PathLike[str] | None = None,
    name: str = "",
    map_: str | os.PathLike[str] | None = None,
    source: FrameSource | None = None,
) -> SequenceResult:
    """Track a camera through a sequence and map points, lines and planes.

    Parameters
    ----------
    sequence : Sequence or path
        A sequence, or a path that :func:`groma.io.sequences.open_sequence` opens.
    options : TrackOptions, optional
        How to track.
    progress : callable, optional
        Called after every frame; return False to end the track there. Ctrl-C does the same once a frame has a pose.
    work : path, optional
        Folder for finished keyframes during the track (``groma view --live``); replaced.
    name : str
        Name of the sequence in the summary; by default the path.
    map_ : path, optional
        OUT of an earlier track, whose map is used and extended: the track starts lost in it, and continues in its world
        frame once relocalised.
    source : FrameSource, optional
        Location of the frames, so that the result can be used as a map later; by default the path.

    Returns
    -------
    SequenceResult
        Trajectory and map, adjusted together at the end, and the comparison with the reference of the sequence.

    Raises
    ------
    InputError
        If there is no sequence, or no frame of it could be tracked.
    OutputError
        If another run works in ``work``, or it cannot be written.
    """
    if isinstance(sequence, (str, os.PathLike)):
        name = name or os.fspath(sequence)
        source = source or FrameSource.of(sequence)
        sequence = open_sequence(sequence)
    check_kind(sequence, Sequence, "sequence", "Open one with groma.open_sequence(path), or pass the path.")
    progress = _logged(progress)
    earlier = None if map_ is None else read_saved_map(map_)
    tracker = Tracker(sequence.camera, options, saved=_loaded(earlier, sequence, options, progress))
    frames: list[TrackedFrame] = []
    journal = None if work is None else Journal(Path(work))
    with nullcontext() if journal is None else closing(journal):
        tracker, completed = _follow(tracker, sequence, frames, progress, journal)
        progress(TrackProgress("adjusting all keyframes", 0, 1))
        result = tracker.finish()
    unkept = [] if journal is None else journal.warnings
    warnings = [*sequence.warnings, *result.warnings, *_without_pose(frames), *unkept]
    if not len(result.trajectory):
        what = "could be tracked" if earlier is None else f"was found in the map {earlier.path}"
        check = "Check the camera and the depth scale." if sequence.kind == "rgbd" else "Check the camera."
        raise InputError(f"No frame of {name or 'the sequence'} {what}: {' '.join(warnings)} {check}")
    if result.submaps:
        folders = ", ".join(f"submap_{number}" for number in range(2, len(result.submaps) + 2))
        warnings.append(f"Only the longest submap is in trajectory.txt and the report; see also {folders}.")
    found = next((frame.timestamp for frame in frames if frame.pose is not None and frame.submap == 0), None)
    in_map = earlier is not None and bool(np.isnan(result.keyframes).any())
    if earlier is not None and not in_map:
        warnings.append(
            f"The sequence was not found in the map {earlier.path}: its trajectory is in a world of its own."
        )
    log_warnings("tracking", warnings)
    scores, not_compared = _compared(result, sequence)
    tracked: dict[str, Any] = {item.name: getattr(result, item.name) for item in fields(result)}
    tracked["warnings"] = tuple(warnings)
    return SequenceResult(
        **tracked,
        frames=tuple(frames),
        name=name,
        kind=sequence.kind,
        interrupted=not completed,
        scores=scores,
        not_compared=not_compared,
        saved=None if earlier is None else {
            "path": earlier.path, "keyframes": earlier.scene.num_images, "joined": in_map, "found_at": found,
        },
        sources=tuple(sources_of(result.scene, earlier, source, {frame.name for frame in frames})),
    )  # fmt: skip


def _logged(progress: _Told | None) -> _Told:
    """Return a progress callback that logs stages and frames, and passes them on."""
    stages = logged_stages("tracking", None)

    def told(event: TrackProgress) -> bool | None:
        stages(event.stage, event.done, event.total)
        if event.frame is not None:
            logger_of("tracking").debug("frame %s: %s", event.name or event.done, event.frame.status)
        return None if progress is None else progress(event)

    return told


def _loaded(
    earlier: SavedMap | None, sequence: Sequence, options: TrackOptions | None, progress: _Told
) -> TrackMap | None:
    """Return the map of an earlier track."""
    if earlier is None:
        return None

    def say(done: int, total: int) -> None:
        progress(TrackProgress("reading the map", done, total))

    camera = TrackCamera.of(sequence.camera)
    return earlier.track_map(camera, sequence.kind != "mono", given_or_default(options, TrackOptions), say)


def _follow(
    tracker: Tracker, sequence: Sequence, frames: list[TrackedFrame], progress: _Told, journal: Journal | None
) -> tuple[Tracker, bool]:
    """Track all frames and append them to ``frames``; return the tracker and whether the sequence was completed.

    If the tracker requests a restart, another one takes over.
    """
    total = sequence.num_frames or 0
    try:
        for frame, following in _read_ahead(sequence, tracker.options.threaded):
            tracked = tracker.process(frame, following)
            frames.append(tracked)
            if journal is not None:
                journal.frame(tracked, frame, tracker)
            event = TrackProgress("tracking frame", len(frames), total, tracked, frame.name)
            go_on = progress(event) is not False
            if journal is not None and tracked.keyframe:
                journal.keyframe(tracker, tracked)
            if not go_on:
                return tracker, False
            better = tracker.begun_anew()
            if better is not None:
                frames.clear()
                if journal is not None:
                    journal.begin_anew()
                return _follow(better, sequence, frames, progress, journal)
    except KeyboardInterrupt:
        if all(frame.pose is None for frame in frames):
            raise  # nothing was tracked yet that could be returned
        return tracker, False
    return tracker, True


def _read_ahead(sequence: Sequence, threaded: bool) -> Iterator[tuple[Frame, Frame | None]]:
    """Yield each frame with the next one, which is read in another thread.

    The error of a frame that cannot be read is raised when it is its turn.
    """
    if not threaded:
        yield from ((frame, None) for frame in sequence)
        return
    frames = iter(sequence)
    reader = ThreadPoolExecutor(1, thread_name_prefix="groma-read")
    try:
        waiting = deque(reader.submit(next, frames, None) for _ in range(2))
        while (frame := waiting.popleft().result()) is not None:
            waiting.append(reader.submit(next, frames, None))
            yield frame, None if waiting[0].exception() else waiting[0].result()
    finally:
        reader.shutdown(wait=True, cancel_futures=True)


def _compared(result: TrackResult, sequence: Sequence) -> tuple[TrajectoryScores | None, str]:
    """Return the comparison with the reference of the sequence, if it has one, and why it failed."""
    if sequence.reference is None or len(result.trajectory) < 3:
        return None, ""
    align = "sim3" if sequence.kind == "mono" else "se3"
    try:
        return score_trajectory(result.trajectory, sequence.reference, align, MAX_TIME_DIFFERENCE), ""
    except GromaError as error:
        return None, str(error)
    except Exception as error:  # a failing comparison must not lose the track
        return None, f"{type(error).__name__}: {error}"


def _without_pose(frames: list[TrackedFrame]) -> list[str]:
    """Return a warning that names the frames without a pose."""
    names = [frame.name or f"at {frame.timestamp:.3f} s" for frame in frames if frame.status in (LOST, SKIPPED)]
    if not names:
        return []
    more = f" and {len(names) - NAMED:,} more (all are in summary.json)" if len(names) > NAMED else ""
    return [f"No pose: {counted(len(names), 'frames')} of {len(frames):,}: {', '.join(names[:NAMED])}{more}."]


def _failure(what: str, step: Callable[[], object]) -> str | None:
    """Run a step; return a sentence if it fails for another reason than the disk."""
    try:
        step()
    except OSError:
        raise
    except Exception as error:
        if is_interrupt(error):
            raise KeyboardInterrupt from None
        return f"Not written: {what}, which failed ({type(error).__name__}: {error}). Please report it."
    return None
