# SPDX-License-Identifier: BSD-3-Clause
"""``groma map``: points, lines and planes from photographs."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli import _options


def map_(
    images: Annotated[Path, typer.Argument(metavar="IMAGES", help="Folder of photographs.")],
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="OUT", help="Folder for the results."),
    ],
    model: Annotated[
        Path | None,
        typer.Option("--model", metavar="COLMAP", help="Poses, cameras and points; without it they are reconstructed."),
    ] = None,
    min_length: Annotated[float, typer.Option(min=5.0, metavar="PX", help="Shortest line segment, pixels.")] = 12.0,
    planes: Annotated[bool, typer.Option("--planes/--no-planes", help="Look for planes and directions.")] = True,
    refine_poses: Annotated[
        bool, typer.Option("--refine-poses/--fix-poses", help="Move the cameras too, or the landmarks alone.")
    ] = True,
    refine_intrinsics: Annotated[
        bool, typer.Option("--refine-intrinsics/--fix-intrinsics", help="Estimate the calibration too.")
    ] = False,
    force: _options.Force = False,
    threads: _options.Threads = None,
    seed: _options.Seed = 0,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Map photographs: points, lines and planes, adjusted together.

    OUT then holds a COLMAP model with the lines and planes beside it (structures/), scene.npz, lines.obj, summary.json
    and report.html. Finished stages are kept in OUT.work until the end: an interrupted run goes on from there.
    """
    from groma.cli import _output
    from groma.cli._console import Console

    console = Console(quiet, verbose, json_target, threads)
    _output.check_output(output, force)
    _output.check_json(json_target, force)

    import shutil

    from groma.io import read_scene, write_scene
    from groma.pipelines.map import MapOptions, map_images
    from groma.viz.report import write_report

    options = MapOptions(
        min_segment_length=min_length,
        find_planes=planes,
        refine_poses=refine_poses,
        refine_intrinsics=refine_intrinsics,
        threads=threads,
        seed=seed,
    )
    given = read_scene(model) if model is not None else None
    fresh = console.announce_compilation()
    work = output.with_name(output.name + ".work")
    with console.stages() as stages:
        result = map_images(images, work, given, options, stages)
    scene = result.scene
    solve = result.report.to_dict()
    numbers = {
        **solve,
        "num_images": scene.num_images,
        "num_points": scene.num_points,
        "num_lines": scene.num_lines,
        "num_planes": scene.num_planes,
        "num_directions": scene.num_directions,
        "sigma_px": result.sigma_px,
        "segments": result.fates,
        "explanation": result.explanation,
        "warnings": list(result.warnings),
    }
    with _output.atomic_output(output, force) as draft:
        write_scene(scene, draft, format="colmap")
        write_scene(scene, draft / "scene.npz")
        write_scene(scene, draft / "lines.obj")
        pictures = {name: images / name for name in scene.images.names}
        title = f"Map of {images.absolute().name}"
        write_report(draft / "report.html", result.before, scene, result.report, pictures, title)
        _output.write_json(str(draft / "summary.json"), numbers)
    shutil.rmtree(work, ignore_errors=True)
    console.say(
        f"{scene.num_images} images, {scene.num_points:,} points, {scene.num_lines:,} lines, "
        f"{scene.num_planes} planes, {scene.num_directions} directions"
    )
    console.say(result.explanation)
    for kind, rmse in result.report.rmse_px.items():
        console.say(f"  {kind}: {rmse['before']:.3f} px -> {rmse['after']:.3f} px (rms, outliers included)")
    for sentence in result.warnings:
        console.warn(sentence)
    console.detail(f"with compilation: {fresh}")
    console.say(f"Wrote {output}. Open {(output / 'report.html').absolute()} in a browser.")
    _output.write_json(json_target, numbers, force)
