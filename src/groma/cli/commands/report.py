# SPDX-License-Identifier: BSD-3-Clause
"""``groma report``: a scene as one HTML file that opens anywhere."""

from pathlib import Path
from typing import Annotated

from groma.cli.shared import options as _options
from groma.cli.shared.console import Console


def report(
    console: Console,
    source: _options.Input,
    output: Annotated[Path, _options.PLAIN.option("The HTML file.", "--output", "-o", metavar="FILE")] = Path(
        "report.html"
    ),
    images: Annotated[
        Path | None, _options.PLAIN.option("Folder of the photographs, shown with their measurements.", metavar="DIR")
    ] = None,
    before: Annotated[
        Path | None, _options.PLAIN.option("The same scene before adjustment, to compare with.", metavar="SCENE")
    ] = None,
    covariance: Annotated[
        Path | None,
        _options.PLAIN.option(
            "File of groma adjust --covariance FILE.npz: adds standard deviations to lengths and angles measured on "
            "the page.",
            metavar="FILE",
        ),
    ] = None,
    force: _options.Force = False,
) -> None:
    """Write a self-contained HTML page of a scene: 3D view, photographs, residuals, numbers. It needs no network.

    For the folder of a finished map the page also shows convergence and the rejection reasons of segments.
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.input import check_inputs

    _output.check_outputs(force, output, json_target=console.json_target, file=True)
    check_inputs(source, images, before, covariance)

    from groma.errors import InputError
    from groma.io import read_scene
    from groma.scene.counts import counts_of
    from groma.viz.pictures import image_file
    from groma.viz.report.covariances import read_covariances
    from groma.viz.report.page import PageContents, write_report
    from groma.viz.report.saved import saved_report

    if images is not None and not images.is_dir():
        raise InputError(f"{images} is not a folder of images. Check --images.")
    scene = read_scene(source)
    earlier = read_scene(before) if before is not None else None
    if images is not None and scene.num_images and not any(image_file(images, name) for name in scene.images.names):
        console.warn(f"{images} holds none of the images of the scene, such as {scene.images.names[0]!r}.")
    saved = saved_report(source) if source.is_dir() else None
    found = None if covariance is None else read_covariances(covariance, scene)
    with _output.atomic_output(output, force) as draft:
        told = {} if saved is None else {"outcomes": saved.outcomes, "explanation": saved.explanation}
        contents = PageContents(**told, covariances=found)
        write_report(draft, earlier, scene, saved, images, _output.subject(source), contents)
    console.wrote(output)
    _output.write_json(console.json_target, {"output": str(output), **counts_of(scene)}, force)
