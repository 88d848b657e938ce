# SPDX-License-Identifier: BSD-3-Clause
"""``groma track``: follow a camera through a sequence, and map points, lines and planes on the way."""

from pathlib import Path
from typing import Annotated, Any, Literal, cast

import typer

from groma.cli.shared import command as _complete
from groma.cli.shared import options as _options
from groma.cli.shared.console import Console

#: As :func:`groma.tracking.track` names them.
_STAGES = ("tracking frame", "adjusting all keyframes")


def track(
    console: Console,
    sequence: Annotated[
        Path,
        typer.Argument(
            metavar="SEQUENCE",
            help="Folder of TUM RGB-D, 7-Scenes, KITTI, EuRoC, stereo pairs or plain images; or a video.",
        ),
    ],
    output: Annotated[Path, _options.PLAIN.option("Folder for the results.", "--output", "-o", metavar="OUT")],
    map_: Annotated[
        Path | None,
        _options.PLAIN.option("OUT of an earlier track: relocalise in its map, and extend it.", "--map", metavar="MAP"),
    ] = None,
    camera: Annotated[
        str | None,
        _options.CAMERAS.option(
            "Calibration file (also YAML of Kalibr, ROS, OpenCV or ORB-SLAM, JSON of Open3D or Replica), the OUT of "
            "groma map, or parameters in OpenCV's order: fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]]. Default: that of "
            "the sequence.",
            metavar="CAMERA",
        ),
    ] = None,
    camera_model: Annotated[
        str | None,
        _options.CAMERAS.option(
            "Camera model, COLMAP's name; with --camera-params, instead of --camera.",
            choices=_complete.CAMERA_MODELS,
            metavar="NAME",
        ),
    ] = None,
    camera_params: Annotated[
        str | None,
        _options.CAMERAS.option("Camera parameters, in COLMAP's order and pixel coordinates.", metavar="F,CX,CY,..."),
    ] = None,
    kind: Annotated[
        str | None,
        _options.CAMERAS.option(
            "rgbd, stereo or mono. Default: recognised by the files.", choices=_complete.SEQUENCES, metavar="KIND"
        ),
    ] = None,
    masks: Annotated[
        Path | None,
        _options.LANDMARKS.option(
            "Masks of the (left) images, a folder as for groma map --masks, or one image for all: black is not used.",
            metavar="PATH",
        ),
    ] = None,
    points: Annotated[bool, _options.LANDMARKS.option("Track points.")] = True,
    lines: Annotated[bool, _options.LANDMARKS.option("Track line segments.")] = True,
    line_detector: _options.LineDetector = "lsd",
    planes: Annotated[bool, _options.LANDMARKS.option("Find planes in depth images, or in points and lines.")] = True,
    loops: Annotated[bool, _options.PLAIN.option("Close loops.")] = True,
    max_frames: Annotated[
        int | None, _options.PLAIN.option("Stop after N frames. Default: all.", min=1, metavar="N")
    ] = None,
    stride: Annotated[int, _options.PLAIN.option("Use every N-th frame.", min=1, metavar="N")] = 1,
    # derived from TrackOptions
    max_depth: Annotated[float, _options.PLAIN.option("Ignore depths beyond M metres.", min=0.1, metavar="M")] = 6.0,
    depth_scale: Annotated[
        float | None,
        _options.PLAIN.option(
            "Depth values per metre. Default: that of the calibration file or of the layout (TUM 5000, else 1000).",
            metavar="S",
        ),
    ] = None,
    force: _options.Force = False,
) -> None:
    """Track a camera through a sequence.

    OUT will hold trajectory.txt (TUM format), the keyframes as a COLMAP model with lines and planes (structures/),
    scene.npz, summary.json and report.html. While it runs, OUT.work holds the finished keyframes (groma view --live OUT
    shows them); Ctrl-C ends the track early and writes the result so far. Submaps that could not be merged after a
    loss are in OUT/submap_2, submap_3, ...
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.input import camera_line, refuse_idle
    from groma.errors import InputError, did_you_mean

    _output.check_outputs(force, output, json_target=console.json_target)
    if kind not in (None, *_complete.SEQUENCES):
        raise InputError(f"--kind must be rgbd, stereo or mono; got {kind!r}.{did_you_mean(kind, _complete.SEQUENCES)}")
    line = camera_line(camera_model, camera_params)
    if camera is not None and line is not None:
        raise InputError("--camera and --camera-model exclude each other. Leave one of them out.")
    camera = camera or line
    refuse_idle(("--line-detector", line_detector != "lsd" and not lines, "with lines"))

    from groma.cli.shared.mapping import WRITING
    from groma.features.images import one_opencv_thread
    from groma.io.sequences import open_sequence
    from groma.mapping.checkpoints import check_free, remove_stages
    from groma.tracking.options import TrackOptions
    from groma.tracking.saved import FrameSource
    from groma.tracking.sequence import TrackProgress
    from groma.tracking.sequence import track as track_sequence

    known = cast("Literal['rgbd', 'stereo', 'mono'] | None", kind)
    frames = open_sequence(
        sequence, camera=camera, depth_scale=depth_scale, stride=stride, max_frames=max_frames, kind=known, masks=masks
    )
    alone = console.threads == 1
    if alone or frames.camera.baseline is None:  # dense disparities of pairs pay for threads of their own
        one_opencv_thread()
    source = FrameSource.of(sequence, camera, masks, depth_scale=depth_scale, kind=known)
    options = TrackOptions(
        points=points, lines=lines, planes=planes, close_loops=loops, max_depth=max_depth, detector=line_detector,
        threaded=not alone,
    )  # fmt: skip
    options.make_detector()  # refuses a wrong name now
    console.expect_compilation("track")
    work = _output.work_folder(output)
    check_free(work)
    console.expect_stages(*(() if map_ is None else ("reading the map",)), *_STAGES, WRITING)
    with console.stages() as stages:

        def show(event: TrackProgress) -> None:
            stages(event.stage, event.done, event.total)
            frame = event.frame
            if frame is not None and (frame.weak or frame.status in ("lost", "skipped")):
                why = frame.reason or ("held by the prior: " + ", ".join(frame.weak) if frame.weak else "")
                console.detail(f"frame {event.name or event.done}: {frame.status} {why}".rstrip())

        result = track_sequence(frames, options, show, work=work, name=str(sequence), map_=map_, source=source)
    if result.interrupted:
        console.warn("interrupted; what was tracked so far is written.")
    _output.check_output(output, force)
    with console.stages() as say:
        say(WRITING, 0, 1)
        files = getattr(frames, "pictures", {})  # of a video there are none
        pictures = {name: files[name] for name in result.scene.images.names if name in files}
        unwritten = result.write(output, f"Track of {_output.subject(sequence)}", force, pictures or None)
    console.warn(*unwritten)
    remove_stages(work)
    numbers = result.summary()
    _say(console, numbers)
    console.wrote_page(output)
    _output.write_json(console.json_target, numbers, force)


def _say(console: Console, numbers: dict[str, Any]) -> None:
    statuses = [[f"frames {status}", f"{count:,}"] for status, count in sorted(numbers["frames"].items())]
    kinds = ("keyframes", "points", "lines", "planes", "loops")
    console.table(("", "number"), [*statuses, *([kind, f"{numbers[kind]:,}"] for kind in kinds)])
    total = numbers["milliseconds"].get("total")
    if total:
        console.say(f"Time per frame: median {total['median']:.1f} ms, 95 % below {total['p95']:.1f} ms")
    if "landmark_planes" in numbers:
        console.say(numbers["landmark_planes"]["sentence"])
    if "right_camera" in numbers:
        turn = numbers["right_camera"]
        angles = ", ".join(
            f"{angle:+.3f} ± {sigma:.3f} ({name})"
            for name, angle, sigma in zip(("pitch", "yaw", "roll"), turn["angles_deg"], turn["sigma_deg"], strict=True)
        )
        console.say(f"The right camera is turned by {angles} degrees; this is taken into account.")
    depth = numbers.get("depth_camera", {})
    if depth.get("used") and abs(depth["inverse_offset"]) > depth["sigma"]:
        offset, sigma = depth["inverse_offset"], depth["sigma"]
        console.say(f"Inverse depths are off by {offset:+.4f} ± {sigma:.4f} per metre; this is taken into account.")
    scores = numbers.get("reference", {})
    if "ate_rmse" in scores:
        drift = scores["drift_percent"]
        how = scores["alignment"] + (" by positions and orientations" if scores["by_orientations"] else "")
        console.say(
            f"Against the reference ({how}): position error {scores['ate_rmse']:.4f} (root mean "
            f"square, units of the reference) over {scores['path_length']:.2f}"
            + (f"; drift {drift:.2f} %, {scores['drift_deg_per_metre']:.4f} deg per unit" if drift is not None else "")
        )
    console.warn_of_all(numbers["warnings"])
