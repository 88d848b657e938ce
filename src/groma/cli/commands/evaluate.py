# SPDX-License-Identifier: BSD-3-Clause
"""``groma evaluate``: a result compared with a reference, by the usual scores."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from groma._counted import counted
from groma.cli.shared import options as _options
from groma.cli.shared import output as _output
from groma.cli.shared.console import Console
from groma.cli.shared.input import check_inputs, refuse_idle
from groma.errors import InputError

# Repeated from groma.io.trajectories and groma.evaluation.trajectory, whose import would load NumPy.
_Format = Literal["auto", "tum", "kitti", "euroc", "log"]
_Alignment = Literal["se3", "sim3", "none"]
_StepUnit = Literal["frames", "metres", "seconds"]
_MAX_ANGLE, _MAX_TIME = 10.0, 0.01  # derived from groma.evaluation.gates.SCORES


def poses(
    console: Console,
    estimate: Annotated[Path, typer.Argument(metavar="EST", help="Scene to evaluate.")],
    reference: Annotated[Path, typer.Argument(metavar="REF", help="Reference scene.")],
    force: _options.ForceReport = False,
) -> None:
    """Compare the camera poses of two scenes after similarity alignment; images are matched by name."""
    _output.check_json(console.json_target, force)
    check_inputs(estimate, reference)

    from groma.evaluation.poses import evaluate_poses
    from groma.io import read_scene

    scores = evaluate_poses(read_scene(estimate), read_scene(reference))
    console.warn(*scores.warnings)
    console.say(f"{counted(scores.num_images, 'images')} in both, after similarity alignment")
    if scores.num_missing:
        missing = counted(scores.num_missing, "images")
        console.warn(
            f"{missing} of the reference {'is' if scores.num_missing == 1 else 'are'} missing in the estimate."
        )
    if scores.num_images < 3:  # derived from three points that fix a similarity
        console.warn("The alignment takes the centres of one or two images onto each other, whatever their poses.")
    rows = [
        ["camera centres, units of the reference", f"{scores.center_rmse:.4g}", "", ""],
        ["rotations, degrees", "", f"{scores.rotation_deg_mean:.4g}", f"{scores.rotation_deg_max:.4g}"],
    ]
    console.table(("", "rms", "mean", "largest"), rows)
    console.table(
        ("pose error within", *(f"{degrees:g}°" for degrees in scores.auc)),
        [["area under curve", *(f"{value:.3f}" for value in scores.auc.values())]],
    )
    _output.write_json(console.json_target, scores.to_dict(), force)


_Thresholds = Annotated[
    list[float] | None,
    _options.PLAIN.option(
        "Distance in units of REF; may be repeated. By default 1, 5 and 10 thousandths of its extent.",
        "--threshold",
        metavar="TAU",
    ),
]


def lines(
    console: Console,
    estimate: Annotated[Path, typer.Argument(metavar="EST", help="Scene or line set to evaluate.")],
    reference: Annotated[
        Path | None,
        typer.Argument(
            metavar="REF",
            help="Scene, line set or edge graph (.npz, .npy, .txt), mesh (.ply, .obj) or points as reference.",
            show_default=False,
        ),
    ] = None,
    threshold: _Thresholds = None,
    silhouettes: Annotated[
        Path | None,
        _options.PLAIN.option(
            "Masks of the object, named like the images of EST: report how far lines leave them. REF is then optional.",
            metavar="FOLDER",
        ),
    ] = None,
    align: Annotated[
        bool, _options.PLAIN.option("First align EST to REF by the poses of images in both scenes.", "--align")
    ] = False,
    force: _options.ForceReport = False,
) -> None:
    """Compare 3D line segments with a reference: recall and precision.

    With --silhouettes also, or only, with the silhouettes of the object: a true line projects into them in every view.
    """
    _output.check_json(console.json_target, force)
    check_inputs(estimate, reference, silhouettes)
    if reference is None and silhouettes is None:
        raise InputError("There is nothing to compare with. Pass a reference, --silhouettes FOLDER, or both.")
    refuse_idle(
        ("--align", align and reference is None, "with a reference"),
        ("--threshold", bool(threshold) and reference is None, "with a reference"),
    )

    numbers: dict[str, object] = {}
    if reference is not None:
        numbers |= _compare_lines(console, estimate, reference, threshold, align)
    if silhouettes is not None:
        numbers["silhouettes"] = _compare_silhouettes(console, estimate, silhouettes)
    _output.write_json(console.json_target, numbers, force)


def _compare_lines(
    console: Console, estimate: Path, reference: Path, threshold: list[float] | None, align: bool
) -> dict[str, object]:
    from groma.evaluation.lines import evaluate_lines
    from groma.io import read_scene
    from groma.io.reference import read_reference

    read = read_scene if align else read_reference
    scores = evaluate_lines(read(estimate), read(reference), threshold, align)
    lines_there = counted(scores.num_lines, "lines")
    console.say(f"{lines_there}, {scores.length:.6g} long; reference {scores.reference_length:.6g} long")
    if scores.num_lines == 0:
        console.warn(f"{estimate} holds no lines.")
    header = ("within", "length found", "of the reference", "lines right", "for 90 % right", "length right")
    rows = [
        [
            f"{tau:.4g}",
            f"{scores.inlier_length[tau]:.6g}",
            *map(
                _percent,
                (recall, scores.precision_count[tau], scores.precision_strict[tau], scores.precision_length[tau]),
            ),
        ]
        for tau, recall in scores.recall_length.items()
    ]
    console.table(header, rows)
    return scores.to_dict()


def _compare_silhouettes(console: Console, estimate: Path, folder: Path) -> dict[str, object]:
    from groma.evaluation.silhouettes import LIMITS, evaluate_silhouettes, read_silhouettes
    from groma.io import read_scene

    scene = read_scene(estimate)
    scores = evaluate_silhouettes(scene, read_silhouettes(folder, scene.images.names))
    found = scores.to_dict()
    console.say(f"{counted(scene.num_lines, 'lines')} in {counted(scores.num_views, 'views')} with a silhouette")
    beyond = [int((scores.distance > limit).sum()) for limit in LIMITS]
    rows = [
        [f"{limit:g} px", f"{count:,}", _percent(count / max(scene.num_lines, 1))]
        for limit, count in zip(LIMITS, beyond, strict=True)
    ]
    console.table(("leave it by more than", "lines", "share"), rows)
    return found


def planes(
    console: Console,
    estimate: Annotated[Path, typer.Argument(metavar="EST", help="Scene to evaluate.")],
    reference: Annotated[
        Path, typer.Argument(metavar="REF", help="Reference: scene with planes, or points (.ply, .obj, .npy, .npz).")
    ],
    threshold: _Thresholds = None,
    max_angle: Annotated[
        float, _options.PLAIN.option("Largest angle between planes that match.", metavar="DEG")
    ] = _MAX_ANGLE,
    max_offset: Annotated[
        float | None, _options.PLAIN.option("Largest offset of planes that match; by default 1 % of REF.", metavar="D")
    ] = None,
    force: _options.ForceReport = False,
) -> None:
    """Compare planes with reference planes (angles and offsets of matches) or with points (share explained)."""
    _output.check_json(console.json_target, force)
    check_inputs(estimate, reference)

    from groma.evaluation.planes import evaluate_planes, score_planes_by_points
    from groma.io import read_scene
    from groma.io.reference import holds_scene, read_reference

    scene = read_scene(estimate)
    if scene.num_planes == 0:
        console.warn(f"{estimate} holds no planes.")
    if holds_scene(reference):
        if threshold is not None:
            raise InputError("--threshold is for a reference of points. For planes pass --max-angle and --max-offset.")
        found = evaluate_planes(scene, read_scene(reference), max_angle, max_offset)
        planes_there = counted(found.num_planes, "planes")
        console.say(
            f"{len(found.matches):,} of {planes_there} match {found.num_reference:,} of the reference: "
            f"precision {_percent(found.precision)}, recall {_percent(found.recall)}"
        )
        if len(found.matches):
            rows = [
                ["normals, degrees", f"{found.normal_deg_mean:.4g}", f"{found.normal_deg_max:.4g}"],
                ["offsets, units of the reference", f"{found.offset_mean:.4g}", f"{found.offset_max:.4g}"],
            ]
            console.table(("", "mean", "largest"), rows)
        _output.write_json(console.json_target, found.to_dict(), force)
        return
    refuse_idle(
        ("--max-angle", max_angle != _MAX_ANGLE, "with planes to compare with"),
        ("--max-offset", max_offset is not None, "with planes to compare with"),
    )
    shares = score_planes_by_points(scene.planes.hesse, read_reference(reference).surface_points(), threshold)
    console.say(f"{counted(shares.num_planes, 'planes')}, {counted(shares.num_points, 'points')}")
    rows = [
        [f"{tau:.4g}", _percent(share), f"{shares.inlier_rmse[tau]:.4g}"] for tau, share in shares.inlier_share.items()
    ]
    console.table(("within", "of the points", "rms"), rows)
    _output.write_json(console.json_target, shares.to_dict(), force)


def trajectory(
    console: Console,
    estimate: Annotated[Path, typer.Argument(metavar="EST", help="Trajectory to evaluate.")],
    reference: Annotated[Path, typer.Argument(metavar="REF", help="Reference trajectory.")],
    format: Annotated[_Format, _options.PLAIN.option("Format of both files; .gz is unpacked.")] = "auto",
    align: Annotated[_Alignment, _options.PLAIN.option("Alignment of EST to REF; sim3 for monocular.")] = "se3",
    max_time_difference: Annotated[
        float, _options.PLAIN.option("Largest difference of associated times, s.", metavar="S")
    ] = _MAX_TIME,
    times: Annotated[
        Path | None,
        _options.PLAIN.option(
            "Times of a REF without any (KITTI), one a line; by default times.txt beside it.", metavar="FILE"
        ),
    ] = None,
    rpe_delta: Annotated[float, _options.PLAIN.option("Step of the relative errors.", metavar="D")] = 1.0,
    rpe_unit: Annotated[_StepUnit, _options.PLAIN.option("Unit of the step.")] = "frames",
    force: _options.ForceReport = False,
) -> None:
    """Compare a trajectory with a reference: absolute and relative errors, and drift; poses are matched by time.

    Two files of equal length of which one has no times (KITTI) are matched by line.
    """
    _output.check_json(console.json_target, force)
    check_inputs(estimate, reference, times)

    from groma.evaluation.trajectory import Spread, counts_lines, score_trajectory
    from groma.io import read_trajectory
    from groma.io.trajectories import read_times

    def row(name: str, spread: Spread, unit: str) -> list[str]:
        values = (spread.rmse, spread.mean, spread.median, spread.max)
        return [f"{name}, {unit}", *(f"{value:.4g}" for value in values)]

    ours, theirs = read_trajectory(estimate, format), read_trajectory(reference, format)
    refuse_idle(("--times", times is not None and not counts_lines(theirs), "on a REF without times of its own"))
    beside = reference.with_name("times.txt")
    if times is None and counts_lines(theirs) and not counts_lines(ours) and beside.is_file():
        times = beside if len(read_times(beside)) == len(theirs) else None
    if times is not None:
        theirs = read_trajectory(reference, format, read_times(times))
        console.detail(f"The poses of {reference} have the times of {times}.")
    scores = score_trajectory(ours, theirs, align, max_time_difference, rpe_delta, rpe_unit)
    console.warn(*scores.warnings)
    applied = {"se3": "rotation and translation", "sim3": f"similarity of scale {scores.similarity.scale:.6g}"}
    console.say(
        f"{counted(scores.num_poses, 'poses')} associated by {scores.association} of {scores.num_estimate:,} and "
        f"{scores.num_reference:,}, "
        f"path of {scores.path_length:.6g} m; alignment: {applied.get(align, 'none')}"
        + (", by positions and orientations" if scores.by_orientations else "")
    )
    if scores.by_orientations:
        console.say("The positions alone do not determine the rotation between the two.")
    step = f"{rpe_delta:g} {rpe_unit.removesuffix('s') if rpe_delta == 1 else rpe_unit}"
    rows = [row("absolute position", scores.ate, "m"), row("absolute rotation", scores.rotation_deg, "deg")]
    if scores.rpe_translation is None or scores.rpe_rotation_deg is None:
        console.warn(f"No two associated poses are {step} apart; there are no relative errors.")
    else:
        rows += [
            row("relative position", scores.rpe_translation, f"m per {step}"),
            row("relative rotation", scores.rpe_rotation_deg, f"deg per {step}"),
        ]
    console.table(("", "rms", "mean", "median", "largest"), rows)
    if scores.drift_percent is not None:
        console.say(
            f"Drift {scores.drift_percent:.4g} % and {scores.drift_deg_per_metre:.4g} deg/m, mean over segments of "
            f"{scores.segment_lengths[0]:.4g} to {scores.segment_lengths[-1]:.4g} m."
        )
    else:
        console.say("No drift by length of the way: the camera moved no farther than its positions err.")
    _output.write_json(console.json_target, scores.to_dict(), force)


def _percent(share: float) -> str:
    """A share in percent; a dash for NaN."""
    return f"{100 * share:.1f} %" if share == share else "–"
