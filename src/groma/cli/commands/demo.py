# SPDX-License-Identifier: BSD-3-Clause
"""``groma demo``: ``groma map`` on real photographs shipped with the package."""

from pathlib import Path
from typing import Annotated

from groma.cli.shared import options as _options
from groma.cli.shared import output as _output
from groma.cli.shared.console import Console


def demo(
    console: Console,
    output: Annotated[
        Path | None,
        _options.PLAIN.option(
            "Folder for the results. Default: groma_demo, replaced.", "--output", "-o", metavar="DIR"
        ),
    ] = None,
    force: _options.Force = False,
) -> None:
    """Map 58 real photographs of a filing cabinet: points, lines and planes, adjusted together.

    It starts from a point-only COLMAP model. The folder will hold report.html (open it in a browser), a COLMAP model
    with lines and planes (structures/), scene.npz, lines.obj and summary.json, as with groma map. The result is
    compared with motion capture and with the dimensions of the cabinet.
    """
    replace, output = force or output is None, output or Path("groma_demo")
    _output.check_outputs(replace, output)
    _output.check_json(console.json_target, force)
    console.begin_compilation("map")

    from groma.cli.shared.diagnosis import try_diagnosis
    from groma.cli.shared.mapping import run_map, say_map, write_map
    from groma.evaluation import cabinet
    from groma.io import read_scene
    from groma.mapping.options import MapOptions

    console.say("58 photographs of a filing cabinet, nearly without texture (TUM RGB-D benchmark), about a minute.")
    folder, work = cabinet.folder(), _output.work_folder(output)
    images, reference = folder / "images", read_scene(folder / "motion_capture")
    # Blurred frames of a video show few lines, and some of them barely; all are kept to show what there is.
    options = MapOptions(threads=console.threads, min_confidence=0.0)
    result = run_map(console, images, work, read_scene(folder / "model"), options)
    found = try_diagnosis(result.diagnose, result.scene.num_images, console)
    numbers = result.summary(found) | cabinet.evaluate_cabinet(result.start, result.scene, reference)
    title = "A filing cabinet in 58 photographs"
    write_map(console, result, output, work, replace, images=images, title=title, summary=numbers)
    say_map(console, result, numbers, explain=False)
    console.say(*cabinet.sentences(numbers))
    console.say(f"Open {(output / 'report.html').absolute()} in a browser to walk around it, before and after.")
    console.say("With photographs of your own: groma map IMAGES -o OUT")
    _output.write_json(console.json_target, numbers, force)
