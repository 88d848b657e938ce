# SPDX-License-Identifier: BSD-3-Clause
"""``groma map``: points, lines and planes from photographs."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from groma.cli.shared import command as _complete
from groma.cli.shared import depth as _depth
from groma.cli.shared import measurements as _measured
from groma.cli.shared import options as _options
from groma.cli.shared.console import Console
from groma.cli.shared.ranks import led_by_first_rank
from groma.compilation.ahead import mapping
from groma.errors import InputError

if TYPE_CHECKING:
    from groma.io.colmap.masks import Masks
    from groma.io.colmap.rigs import RigDescription
    from groma.mapping.options import MapOptions
    from groma.scene import Scene


@led_by_first_rank
def map_(
    console: Console,
    images: Annotated[
        Path,
        typer.Argument(
            metavar="IMAGES", help="Folder of photographs, and of folders of them; or a project with a folder images."
        ),
    ],
    output: Annotated[Path, _options.PLAIN.option("Folder for the results.", "--output", "-o", metavar="OUT")],
    model: Annotated[
        Path | None,
        _options.CAMERAS.option(
            "Poses, cameras and points: a COLMAP model, an archive (.npz) or the OUT of a map. Default: reconstruct "
            "them.",
            metavar="MODEL",
        ),
    ] = None,
    poses: Annotated[
        Path | None,
        _options.CAMERAS.option(
            "Poses without points: a model, transforms.json, reconstruction.json, poses_bounds.npy, a trajectory (TUM, "
            "KITTI), a g2o graph, or lines name x y z qx qy qz qw. Points are triangulated, poses refined, wrong ones "
            "reported.",
            metavar="FILE",
        ),
    ] = None,
    extend: Annotated[
        Path | None,
        _options.CAMERAS.option(
            "Add the photographs to this map (OUT of groma map, or a COLMAP model), and map all of both.", metavar="MAP"
        ),
    ] = None,
    map_images: Annotated[
        Path | None,
        _options.CAMERAS.option("With --extend: folder of the photographs of MAP, if unknown.", metavar="FOLDER"),
    ] = None,
    camera_model: Annotated[
        str | None,
        _options.CAMERAS.option(
            "Camera model, COLMAP's name. Without --model: the model to estimate (SIMPLE_RADIAL, or RADIAL if needed); "
            "with it: the model that its cameras are changed to, whose new parameters are estimated.",
            choices=_complete.CAMERA_MODELS,
            metavar="NAME",
        ),
    ] = None,
    camera_params: Annotated[
        str | None,
        _options.CAMERAS.option("Without --model: a known calibration, which is held.", metavar="F,CX,CY,..."),
    ] = None,
    mapper: Annotated[
        str,
        _options.CAMERAS.option(
            "Without --model and --poses: incremental or global structure from motion.",
            choices=_complete.MAPPERS,
            metavar="NAME",
        ),
    ] = "incremental",
    rig: Annotated[
        Path | None,
        _options.CAMERAS.option(
            "Rig of cameras that are rigidly mounted and triggered together: COLMAP's rig_config.json. Default: the "
            "one in IMAGES, if any.",
            metavar="FILE",
        ),
    ] = None,
    refine_rig: Annotated[
        bool, _options.CAMERAS.option("Estimate the poses of the cameras on the rig.", "--refine-rig/--fix-rig")
    ] = False,
    rolling_shutter: _options.RollingShutter = None,
    masks: Annotated[
        Path | None,
        _options.LANDMARKS.option(
            "Masks of photographs, a folder as for COLMAP (IMG_1.jpg.png, or IMG_1.png), or one image for all: nothing "
            "is found where they are black.",
            metavar="PATH",
        ),
    ] = None,
    line_matches: Annotated[
        Path | None,
        _options.LANDMARKS.option(
            "External segments and matches; the documentation describes the layout.", metavar="NPZ"
        ),
    ] = None,
    line_detector: _options.LineDetector = "lsd",
    line_matcher: Annotated[
        str | None,
        _options.LANDMARKS.option(
            "Segment matcher: wide_baseline, flow, or one of an installed package. Default: epipolar geometry only.",
            choices=_complete.MATCHERS,
            metavar="NAME",
        ),
    ] = None,
    min_length: Annotated[
        float, _options.LANDMARKS.option("Minimum length of line segments, pixels.", min=5.0, metavar="PX")
    ] = 12.0,  # derived from groma.mapping.lines.options
    cluster_size: Annotated[
        int,
        _options.LANDMARKS.option(
            "Map lines of more than N images in clusters of at most N, joined across borders; 0: all at once.",
            min=0,
            metavar="N",
        ),
    ] = 250,  # derived from groma.mapping.lines.options
    min_confidence: Annotated[
        float,
        _options.LANDMARKS.option(
            "Minimum probability of a line being right; 0 keeps all.", min=0.0, max=1.0, metavar="P"
        ),
    ] = 0.5,
    planes: Annotated[bool, _options.LANDMARKS.option("Find planes and directions.")] = True,
    refine_poses: Annotated[
        bool, _options.ADJUSTMENT.option("Estimate camera poses, or hold them.", "--refine-poses/--fix-poses")
    ] = True,
    refine_intrinsics: Annotated[
        bool | None,
        _options.ADJUSTMENT.option(
            "Estimate the calibration too. Default: where --camera-model changes it, and where none is known.",
            "--refine-intrinsics/--fix-intrinsics",
        ),
    ] = None,
    max_iterations: Annotated[
        int, _options.ADJUSTMENT.option("Stop each adjustment after N steps.", min=1, metavar="N")
    ] = 50,  # derived from groma.mapping.options
    refine_points: Annotated[
        bool,
        _options.ADJUSTMENT.option(
            "Refine the point measurements of the model in the images.", "--refine-points/--keep-points"
        ),
    ] = False,
    diagnosis: Annotated[
        bool | None, _options.ADJUSTMENT.option("Report what the data do not determine. Default: up to 300 images.")
    ] = None,
    measured: _measured.Measured = _measured.NOTHING,
    depth: _depth.Depth = None,
    depth_scale: _depth.DepthScale = None,
    relative_depth: _depth.RelativeDepth = False,
    contributions: _options.Contributions = False,
    truth: _options.Truth = None,
    force: _options.Force = False,
    seed: _options.Seed = 0,
) -> None:
    """Map photographs: points, lines and planes, adjusted together.

    OUT will hold a COLMAP model with lines and planes (structures/), scene.npz, lines and planes as PLY and OBJ,
    summary.json and report.html; with measurements adjustment.txt. Finished stages are kept in OUT.work until the end:
    after an interruption the same command resumes there.
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.extending import check_extension
    from groma.cli.shared.input import camera_parameters, check_inputs, refuse_idle

    _output.check_outputs(force, output, json_target=console.json_target)
    measured.validate()
    measured = measured if _has_noise(poses, measured.pose_sigma) else replace(measured, poses=None)
    check_inputs(images, model, poses, rig, line_matches, truth, extend, map_images, depth, masks, *measured.files)
    images = _photographs_of(console, images, model, hint=poses is None and extend is None)
    maps = _depth.depth_maps(depth, depth_scale, relative_depth, images)
    known = {"--model": model, "--poses": poses, "--rig": rig, "--camera-params": camera_params, "--depth": depth}
    check_extension(extend, map_images, known)
    _check_start(model, poses, rig)
    placed = model is not None or poses is not None or extend is not None
    refuse_idle(
        ("--mapper", mapper != "incremental" and placed, "without --model, --poses and --extend: it places cameras"),
        ("--refine-rig", refine_rig and poses is not None, "on rigs, and --poses takes every image for itself"),
        ("--line-matcher", line_matcher is not None and line_matches is not None, "without --line-matches"),
        ("--line-detector", line_detector != "lsd" and line_matches is not None, "without --line-matches"),
        ("--camera-params", model is not None and camera_params is not None, "on images without a model"),
        ("--keep-suspects", measured.keep_suspects and not measured, "on measurements (--positions, --control, ...)"),
        ("--truth", truth is not None and not contributions, "with --contributions, which compares with it"),
    )
    console.begin_compilation(mapping(refine_poses))
    from groma.cli.shared.diagnosis import try_diagnosis
    from groma.cli.shared.extending import end_queries, extend_map
    from groma.cli.shared.mapping import run_map, say_map, stages_of_map, write_map
    from groma.execution import work_with
    from groma.features.external import read_matches
    from groma.io import read_scene
    from groma.mapping.lines.options import MapLinesOptions
    from groma.mapping.options import MapOptions

    options = MapOptions(
        min_segment_length=min_length,
        detector=line_detector,
        matcher=line_matcher,
        lines=MapLinesOptions(min_length=min_length, cluster_size=cluster_size),
        min_confidence=min_confidence,
        find_planes=planes,
        refine_points=refine_points,
        refine_poses=refine_poses,
        refine_intrinsics=refine_intrinsics,
        max_iterations=max_iterations,
        camera_model=camera_model,
        camera_params=camera_parameters(camera_params),
        mapper=mapper,
        rigs=() if any(given is not None for given in (model, poses, extend)) else _rigs(console, images, rig),
        refine_rigs=refine_rig,
        masks=_masks_of(masks, images, extend),
        rolling_shutter=rolling_shutter,
        keep_suspects=measured.keep_suspects,
        threads=console.threads,
        seed=seed,
    )
    refuse_idle(("--refine-rig", refine_rig and not (placed or options.rigs), "with --rig"))
    start, options = _start(console, images, model, poses, options)
    matches = read_matches(line_matches) if line_matches is not None else None
    true, work = read_scene(truth) if truth is not None else None, _output.work_folder(output)
    photographs, extended = images, None
    if extend is not None:
        stages = stages_of_map(options, "model", bool(measured), matches is not None)
        extended = extend_map(console, extend, images, map_images, output, force, stages, seed, options.masks)
        photographs, start, options = extended.folder, extended.scene, replace(options, masks=extended.masks)
    survey = measured.read(photographs, lambda: _names_in(photographs)) if measured else None
    with work_with(console.threads):
        result = run_map(console, photographs, work, start, options, matches, survey, maps)
        if extended is not None and survey is None:
            from groma.localization.extension import in_world_of

            result = in_world_of(result, extended.map)
        page = {"images": photographs, "photographs": result.photographs(photographs)}
        found = try_diagnosis(result.diagnose, result.scene.num_images, console, diagnosis)
        numbers = result.summary(found, result.contributions(true) if contributions else ())
        page |= {"title": f"Map of {_output.subject(images)}", "summary": numbers}
        write_map(console, result, output, work, force, **page)
    end_queries(output)
    say_map(console, result, numbers)
    console.wrote_page(output)
    _output.write_json(console.json_target, numbers, force)


def _photographs_of(console: Console, folder: Path, model: Path | None, hint: bool) -> Path:
    """Return the folder ``images`` of a project, whose masks and depths are no photographs; else the folder itself."""
    from groma.bounded.names import IMAGES
    from groma.io import read_scene
    from groma.io.colmap.files import is_model
    from groma.io.colmap.rigs import RIG_FILE

    inner = folder / "images"
    if not inner.is_dir() or any(path.suffix.lower() in IMAGES or path.name == RIG_FILE for path in folder.iterdir()):
        return folder
    if model is not None and any((folder / name).is_file() for name in read_scene(model).images.names):
        return folder
    console.say(f"Photographs: {inner}; nothing else in {folder} is taken for one.")
    if model is None and hint and is_model(folder):
        console.say(f"The model in {folder} is not used; --model {folder} would save the reconstruction of points.")
    return inner


def _names_in(folder: Path) -> list[str]:
    """Names of the photographs in a folder."""
    from groma.mapping.photographs import image_files

    return [path.relative_to(folder).as_posix() for path in image_files(folder)]


def _masks_of(folder: Path | None, images: Path, map_: Path | None) -> "Masks | None":
    """Return the masks of photographs, and of those of the map that they extend."""
    from groma.io import read_scene
    from groma.io.colmap.masks import Masks

    if folder is None:
        return None
    known = () if map_ is None else read_scene(map_).images.names
    return Masks.of(folder, list(dict.fromkeys([*_names_in(images), *known])))


def _has_noise(poses: Path | None, stated: str | None) -> bool:
    """Whether the noise of given poses is known; otherwise it is estimated."""
    from groma.io.measured_poses import holds_covariances

    return poses is not None and (stated is not None or holds_covariances(poses))


def _check_start(model: Path | None, poses: Path | None, rig: Path | None) -> None:
    """Refuse options that exclude each other."""
    if model is not None and poses is not None:
        raise InputError("--model and --poses exclude each other: a model has points. Leave one of them out.")
    if rig is not None and (model is not None or poses is not None):
        raise InputError("--rig is for images without a model: a model has its own rigs. Leave it out.")


def _rigs(console: Console, images: Path, path: Path | None) -> "tuple[RigDescription, ...]":
    """Return the rigs of the file given, or of the one in the folder of photographs; print a summary."""
    from groma.io.colmap.rigs import RIG_FILE, check_rigs, read_rigs
    from groma.mapping.photographs import image_files

    if path is None and not (images / RIG_FILE).is_file():
        return ()
    file = path or images / RIG_FILE
    found = read_rigs(file)
    names = [image.relative_to(images).as_posix() for image in image_files(images)]
    where = "Cameras" if path is not None else "Found in the folder: cameras"
    console.say(f"{where} on rigs by {file}. {check_rigs(found, names)}")
    return found


def _start(
    console: Console, images: Path, model: Path | None, poses: Path | None, options: "MapOptions"
) -> "tuple[Scene | None, MapOptions]":
    """Return the initial scene, None if there are only photographs, and the options adapted to its calibration."""
    from groma.io import read_scene
    from groma.mapping.posed.given import in_pixels_of, scene_at_poses

    if model is None:
        options.point_model()  # refuses a wrong name now
    if poses is None:
        if model is None:
            return None, options
        scene, scaled = in_pixels_of(read_scene(model), images)
        console.say(*scaled)
        return scene, options
    given = scene_at_poses(images, poses, options.point_model())
    console.say(*given.sentences)
    if given.calibrated:  # a model that came with parameters is the one of the scene
        return given.scene, options if options.camera_params is None else replace(options, camera_model=None)
    return given.scene, replace(options, camera_model=None, refine_intrinsics=options.refine_intrinsics is not False)
