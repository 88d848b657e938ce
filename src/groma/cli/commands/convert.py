# SPDX-License-Identifier: BSD-3-Clause
"""``groma convert``: from one file format to another."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from groma.cli.shared import options as _options
from groma.cli.shared import output as _output
from groma.cli.shared.console import Console
from groma.cli.shared.input import check_inputs
from groma.cli.shared.parts import is_parts
from groma.errors import InputError

if TYPE_CHECKING:
    from groma.scene import Scene

#: What files of geometry hold; others hold everything.
_LANDMARKS = ("points", "lines", "planes")
_KINDS = {
    **dict.fromkeys((".ply", ".obj"), _LANDMARKS),
    **dict.fromkeys((".dxf", ".glb", ".gltf"), ("images", *_LANDMARKS)),
}


def convert(
    console: Console,
    source: _options.Input,
    target: Annotated[
        Path,
        typer.Argument(
            metavar="OUTPUT",
            help="Its name determines the format: a folder for a COLMAP model, .npz for a groma archive, .txt, .bz2 or "
            ".gz for BAL, .json for nerfstudio and instant-ngp (cameras, poses and points). For viewing: .ply, .obj "
            "(points, lines and planes); .glb, .gltf, .dxf or .rrd (rerun) with cameras.",
        ),
    ],
    parts: Annotated[
        bool,
        _options.PLAIN.option(
            "Divide the scene into parts in the folder OUTPUT, for groma adjust in one process or many.", "--parts"
        ),
    ] = False,
    part_size: Annotated[
        int | None, _options.PLAIN.option("With --parts: observations per part. Default: 1000000.", min=1, metavar="N")
    ] = None,
    force: _options.Force = False,
) -> None:
    """Convert a scene to another format, or divide it into parts; a folder of parts is joined to one scene."""
    if part_size is not None and not parts:
        raise InputError("--part-size is the size of parts. Add --parts, or leave it out.")
    _output.check_outputs(force, None if parts and force else target, json_target=console.json_target)
    check_inputs(source)
    numbers = _cut(source, target, console, force, part_size) if parts else _convert(source, target, console, force)
    _output.write_json(console.json_target, {"input": str(source), "output": str(target), **numbers}, force)


def _convert(source: Path, target: Path, console: Console, force: bool) -> dict[str, Any]:
    from groma.scene.counts import counts_of, sentence_of

    if is_parts(source):
        from groma.adjustment.parts import join_parts, parts_of
        from groma.io import write_scene

        scene = join_parts(parts_of(source))
        write_scene(scene, target, force=force)
    else:
        from groma.io.convert import convert as convert_scene

        scene = convert_scene(source, target, force)
    lost = []
    if target.suffix.lower() == ".json":
        lost = _beside_points(scene, target)
        scene = scene.points_only().keep(point_observations=[])
    kinds = _KINDS.get(target.suffix.lower(), ())
    console.wrote(f"{target}: {sentence_of(scene, *kinds)}")
    warnings = [*_missing_images(source, scene), *_unknown_sizes(scene, target), *_unseen_points(source, scene, target)]
    warnings = [] if kinds else [*lost, *warnings]
    console.warn(*warnings)
    return {**counts_of(scene), "warnings": warnings}


def _beside_points(scene: "Scene", target: Path) -> list[str]:
    """Warn of landmarks that a file of cameras, poses and points has no place for."""
    from groma._counted import counted

    left = [counted(n, kind) for n, kind in ((scene.num_lines, "lines"), (scene.num_planes, "planes")) if n]
    return [f"{target} holds cameras, poses and points; it has no place for {' and '.join(left)}."] if left else []


def _missing_images(source: Path, scene: "Scene") -> list[str]:
    """Warn of missing image files, if other images of the scene are found."""
    from groma._counted import first_of
    from groma.viz.pictures import folder_of_images, image_file

    names = scene.images.names
    folder = folder_of_images(source, names)
    missing = [] if folder is None else [name for name in names if image_file(folder, name) is None]
    if not missing:
        return []
    return [
        f"{len(missing):,} of the {len(names):,} images are not in {folder}: {first_of(missing, 3)}. Their poses are "
        "written all the same, and programs that read the images may stop there."
    ]


def _unknown_sizes(scene: "Scene", target: Path) -> list[str]:
    """Warn of a COLMAP model that is written without image sizes."""
    from groma._counted import counted

    cameras = scene.cameras
    unknown = int(((cameras.width == 0) | (cameras.height == 0)).sum())
    if target.suffix or not unknown:
        return []
    return [
        f"The images of {counted(unknown, 'cameras')} have no known size: the model says 0 x 0 pixels, counted from "
        "the image centre. groma adjust takes it; for anything else put the photographs beside the input, and repeat."
    ]


def _unseen_points(source: Path, scene: "Scene", target: Path) -> list[str]:
    """Warn of points without observations, if the target format can hold observations."""
    if not scene.num_points or len(scene.point_observations) or target.suffix.lower() == ".json":
        return []
    is_opensfm = source.stem.startswith("reconstruction") or (source / "reconstruction.json").is_file()
    tracks = " OpenSfM keeps that in tracks.csv: put it beside the input, and repeat." if is_opensfm else ""
    return [
        f"{source} does not say which images see its {scene.num_points:,} points: they are written without "
        f"observations, and groma adjust and groma map --model need these.{tracks}"
    ]


def _cut(source: Path, target: Path, console: Console, force: bool, part_size: int | None) -> dict[str, Any]:
    from groma._counted import counted
    from groma.adjustment.parts import PART_SIZE, num_ties_cut, write_parts
    from groma.io import read_scene
    from groma.scene.counts import counts_of

    if is_parts(source):
        raise InputError(f"{source} is a folder of parts already. Leave --parts out to join them.")
    scene, part_size = read_scene(source), part_size or PART_SIZE
    paths = write_parts(scene, target, part_size, force)
    console.wrote(f"{target}: {counted(len(paths), 'parts')}, {counted(scene.num_observations, 'observations')}")
    if cut := num_ties_cut(scene, part_size):
        console.warn(
            f"{cut:,} of {counted(len(scene.relations.point_on_line), 'points on lines')} are left out: the line is in "
            "another part."
        )
    return {**counts_of(scene), "num_parts": len(paths)}
