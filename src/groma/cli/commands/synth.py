# SPDX-License-Identifier: BSD-3-Clause
"""``groma synth``: synthetic scenes with exact truth."""

from pathlib import Path
from typing import Annotated, Literal

from groma.cli.shared import options as _options
from groma.cli.shared.console import Console

#: Cameras (cost: memory, some kilobytes for each).
MOST = 1_000_000
Kind = Literal["holistic", "corridor"]


def synth(
    console: Console,
    output: Annotated[
        Path, _options.PLAIN.option("Folder for truth.npz and start.npz.", "--output", "-o", metavar="OUT")
    ],
    kind: Annotated[
        Kind,
        _options.PLAIN.option(
            "holistic: cameras on a sphere around a cube of points, lines and planes. corridor: a walk."
        ),
    ] = "holistic",
    cameras: Annotated[
        int, _options.PLAIN.option("Number of cameras.", "--cameras", "-n", min=2, max=MOST, metavar="N")
    ] = 50,  # derived from groma.scene.synthetic
    noise: Annotated[
        float | None,
        _options.PLAIN.option(
            "Noise of the measurements, pixels. Default: 1; in a corridor 0.5.", min=0.0, metavar="PX"
        ),
    ] = None,
    seed: _options.Seed = 0,
    force: _options.Force = False,
) -> None:
    """Generate a synthetic scene of points, lines and planes with exact ground truth.

    truth.npz holds the exact scene with noisy measurements; start.npz the same scene with perturbed cameras and
    landmarks, as the start of an adjustment.
    """
    from groma.cli.shared import output as _output

    _output.check_outputs(force, output, json_target=console.json_target)

    from groma.io import write_scene
    from groma.scene import synthetic
    from groma.scene.counts import counts_of, sentence_of

    make = synthetic.holistic if kind == "holistic" else synthetic.corridor
    made = make(cameras, seed=seed) if noise is None else make(cameras, seed=seed, noise_px=noise)
    with _output.atomic_output(output, force) as draft:
        draft.mkdir()
        write_scene(made.truth, draft / "truth.npz")
        write_scene(made.start, draft / "start.npz")
    console.wrote(f"{output / 'truth.npz'} and {output / 'start.npz'}: {sentence_of(made.truth)}")
    _output.write_json(
        console.json_target, {"kind": kind, "seed": seed, "noise_px": made.noise_px, **counts_of(made.truth)}, force
    )
