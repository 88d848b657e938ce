# SPDX-License-Identifier: BSD-3-Clause
"""``groma evaluate``: a result against a reference, in the scores of the field."""

from pathlib import Path
from typing import Annotated

import typer

from groma.cli import _options


def poses(
    estimate: Annotated[Path, typer.Argument(metavar="EST", help="Scene to judge.")],
    reference: Annotated[Path, typer.Argument(metavar="REF", help="Scene taken for true.")],
    force: _options.Force = False,
    threads: _options.Threads = None,
    json_target: _options.Json = None,
    quiet: _options.Quiet = False,
    verbose: _options.Verbose = False,
) -> None:
    """Compare the camera poses of two scenes after similarity alignment; images are matched by name."""
    from groma.cli import _output
    from groma.cli._console import Console

    console = Console(quiet, verbose, json_target, threads)
    _output.check_json(json_target, force)

    from groma.evaluation.poses import evaluate_poses
    from groma.io import read_scene

    scores = evaluate_poses(read_scene(estimate), read_scene(reference))
    console.say(f"{scores.num_images} images in both, after similarity alignment")
    if scores.num_missing:
        console.warn(f"{scores.num_missing} images of the reference are missing in the estimate.")
    console.say(f"  camera centres   {scores.center_rmse:.6g} rms, in units of the reference")
    console.say(f"  rotations        {scores.rotation_deg_mean:.4g} deg mean, {scores.rotation_deg_max:.4g} max")
    areas = ", ".join(f"{value:.3f} at {degrees:g} deg" for degrees, value in scores.auc.items())
    console.say(f"  pose error AUC   {areas}")
    _output.write_json(json_target, scores.to_dict(), force)
