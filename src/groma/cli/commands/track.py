# SPDX-License-Identifier: BSD-3-Clause
"""``groma track``: follow a camera through a sequence, and map points, lines and planes on the way."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, cast

import typer

from groma._counted import counted
from groma.cli.shared import options as _options

if TYPE_CHECKING:
    from groma.cli.shared.console import Console
    from groma.evaluation.trajectory import TrajectoryScores
    from groma.io.sequences.frame import Sequence
    from groma.tracking import TrackedFrame, Tracker, TrackResult


def track(
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE", help="Folder of TUM RGB-D, 7-Scenes, KITTI, EuRoC or plain images; or a video."
        ),
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="Folder for the results.")],
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera",
            metavar="CAMERA",
            help="File or numbers: fx fy cx cy [k1 k2 p1 p2 [k3]]. Default: what the sequence says.",
        ),
    ] = None,
    kind: Annotated[
        str | None, typer.Option("--kind", metavar="KIND", help="rgbd, stereo or mono; told by the files otherwise.")
    ] = None,
    points: Annotated[bool, typer.Option("--points/--no-points", help="Follow points.")] = True,
    lines: Annotated[bool, typer.Option("--lines/--no-lines", help="Follow line segments.")] = True,
    line_detector: _options.LineDetector = "lsd",
    planes: Annotated[bool, typer.Option("--planes/--no-planes", help="Find planes in depth images.")] = True,
    loops: Annotated[bool, typer.Option("--loops/--no-loops", help="Close loops.")] = True,
    max_frames: Annotated[
        int | None, typer.Option("--max-frames", min=1, metavar="N", help="Stop after N frames. Default: all.")
    ] = None,
    stride: Annotated[int, typer.Option("--stride", min=1, metavar="N", help="Take every N-th frame.")] = 1,
    max_depth: Annotated[
        float, typer.Option("--max-depth", min=0.1, metavar="M", help="Ignore depths beyond, metres.")
    ] = 6.0,
    depth_scale: Annotated[
        float | None,
        typer.Option(
            "--depth-scale",
            metavar="S",
            help="Depth in files per metre. Default: that of the layout (TUM 5000, else 1000).",
        ),
    ] = None,
    force: _options.Force = False,
    threads: _options.Threads = None,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Track a camera through a sequence.

    OUT then holds trajectory.txt (TUM format), the keyframes as a COLMAP model with lines and planes beside it
    (structures/), scene.npz, summary.json and report.html. While it runs, OUT.work holds the keyframes that are
    finished (groma view --live OUT shows them); Ctrl-C ends the track early and writes what there is. Where the track
    was lost for long and no place was recognised later, further maps are in OUT/part_2, part_3, ...
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.console import Console
    from groma.errors import InputError

    console = Console(quiet, verbose, json_target, threads)
    _output.check_outputs(force, output, json_target=json_target)
    if kind not in (None, "rgbd", "stereo", "mono"):
        raise InputError(f"--kind must be rgbd, stereo or mono; got {kind!r}.")

    import shutil

    from groma.io.sequences import open_sequence
    from groma.tracking import TrackedFrame, Tracker, TrackOptions
    from groma.viz.report.trajectory import write_track_report

    frames = open_sequence(
        sequence,
        camera=camera,
        depth_scale=depth_scale,
        stride=stride,
        max_frames=max_frames,
        kind=cast("Literal['rgbd', 'stereo', 'mono'] | None", kind),
    )
    options = TrackOptions(
        points=points, lines=lines, planes=planes, close_loops=loops, max_depth=max_depth, detector=line_detector
    )
    options.make_detector()  # refuses a wrong name now
    tracker = Tracker(frames.camera, options)
    console.announce_compilation()
    work = output.with_name(output.name + ".work")
    rows: list[TrackedFrame] = []
    interrupted = _run(tracker, frames, work, console, rows)
    result = tracker.finish()
    if not len(result.trajectory):
        raise InputError(
            f"No frame of {sequence} could be tracked: {' '.join([*frames.warnings, *result.warnings])} "
            "Check the camera and the depth scale."
        )
    numbers = {"kind": frames.kind, "interrupted": interrupted, **result.statistics, "sequence": str(sequence)}
    numbers["warnings"] = [*frames.warnings, *result.warnings]
    if result.parts:
        folders = ", ".join(f"part_{number}" for number in range(2, len(result.parts) + 2))
        numbers["warnings"].append(f"Only the longest part is in trajectory.txt and the report; see also {folders}.")
    compared, scores = _scores(result, frames)
    if scores:
        numbers["reference"] = scores
    with _output.atomic_output(output, force) as draft:
        _write(result, draft)
        write_track_report(
            draft / "report.html",
            result,
            rows,
            compared,
            title=f"Track of {sequence.absolute().name}",
            warnings=numbers["warnings"],
        )
        _output.write_json(str(draft / "summary.json"), numbers)
    shutil.rmtree(work, ignore_errors=True)
    _tell(console, result, scores, numbers["warnings"])
    console.say(f"Wrote {output}. Open {(output / 'report.html').absolute()} in a browser.")
    _output.write_json(json_target, numbers, force)


def _run(tracker: "Tracker", frames: "Sequence", work: Path, console: "Console", rows: "list[TrackedFrame]") -> bool:
    """Track all frames, noting in ``rows`` what became of each; return whether Ctrl-C ended it early."""
    from groma.tracking.journal import Journal

    journal = Journal(work)
    total, done = frames.num_frames or 0, 0
    try:
        with console.stages() as progress:
            for frame in frames:
                tracked = tracker.process(frame)
                rows.append(tracked)
                journal.frame(tracked)
                done += 1
                progress("tracking frame", done, total)
                if tracked.status in ("lost", "skipped") or tracked.weak:
                    why = tracked.reason or ("held by the prior: " + ", ".join(tracked.weak) if tracked.weak else "")
                    console.detail(f"frame {frame.name or done}: {tracked.status} {why}".rstrip())
                if tracked.keyframe:
                    journal.keyframe(tracker, tracked)
    except KeyboardInterrupt:
        console.warn("interrupted; what was tracked so far is written.")
        return True
    return False


def _write(result: "TrackResult", draft: Path) -> None:
    from groma.io import write_scene
    from groma.io.trajectories import write_tum

    write_scene(result.scene, draft, format="colmap")
    write_scene(result.scene, draft / "scene.npz")
    write_tum(result.trajectory, draft / "trajectory.txt")
    for number, part in enumerate(result.parts, start=2):
        folder = draft / f"part_{number}"
        folder.mkdir()
        write_scene(part.scene, folder / "scene.npz")
        write_tum(part.trajectory, folder / "trajectory.txt")


def _scores(result: "TrackResult", frames: "Sequence") -> "tuple[TrajectoryScores | None, dict[str, Any]]":
    """Comparison with the reference of the sequence, if it has one, and its numbers or why there are none."""
    from groma.errors import GromaError
    from groma.evaluation.trajectory import score_trajectory

    if frames.reference is None or len(result.trajectory) < 3:
        return None, {}
    align = "sim3" if frames.kind == "mono" else "se3"
    try:
        scores = score_trajectory(result.trajectory, frames.reference, align=align, max_time_difference=0.02)
    except GromaError as error:
        return None, {"error": str(error)}
    return scores, scores.to_dict()


def _tell(console: "Console", result: "TrackResult", scores: dict[str, Any], warnings: list[str]) -> None:
    statistics = result.statistics
    statuses = ", ".join(f"{count:,} {status}" for status, count in sorted(statistics["frames"].items()))
    kinds = ("keyframes", "points", "lines", "planes", "loops")
    console.say(f"Frames: {statuses}; {', '.join(counted(statistics[kind], kind) for kind in kinds)}")
    total = statistics["milliseconds"].get("total")
    if total:
        console.say(f"Time per frame: median {total['median']:.1f} ms, 95 % below {total['p95']:.1f} ms")
    if "ate_rmse" in scores:
        drift = scores["drift_percent"]
        console.say(
            f"Against the reference ({scores['alignment']}): position error {scores['ate_rmse']:.4f} (root mean "
            f"square, units of the reference) over {scores['path_length']:.2f}"
            + (f"; drift {drift:.2f} %, {scores['drift_deg_per_metre']:.4f} deg per unit" if drift is not None else "")
        )
    for sentence in warnings:
        console.warn(sentence)
