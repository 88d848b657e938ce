# SPDX-License-Identifier: BSD-3-Clause
"""``groma adjust`` of a pose graph (g2o)."""

from pathlib import Path
from typing import Any

from groma._counted import counted
from groma.cli.shared.console import Console
from groma.cli.shared.sentences import spent
from groma.errors import InputError


def adjust_graph_and_write(
    source: Path, output: Path | None, console: Console, force: bool, options: dict[str, Any], refused: dict[str, Any]
) -> dict[str, Any]:
    """Adjust a pose graph, write it, print a summary and return the numbers.

    Parameters
    ----------
    source, output : Path
        Files of g2o; without ``output`` nothing is written.
    console : Console
        Prints the summary.
    force : bool
        Replace an existing file.
    options : dict
        Fields of :class:`groma.adjustment.graphs.pose_graph.PoseGraphOptions` that were chosen.
    refused : dict
        Options that do not apply to pose graphs, with their values.
    """
    for name, value in refused.items():
        if value:
            raise InputError(f"{name} is for scenes with images; {source} is a pose graph. Leave it out.")
    if output is not None and not output.name.lower().endswith((".g2o", ".g2o.gz")):
        raise InputError(f"A pose graph is written as .g2o or .g2o.gz; got {output}.")

    from groma.adjustment.graphs.pose_graph import PoseGraphOptions, adjust_pose_graph
    from groma.compilation.time import compilation_time
    from groma.io.g2o import read_g2o, write_g2o

    graph = read_g2o(source)
    console.expect_compilation("pose graph")
    with compilation_time() as compilation, console.progress() as progress:
        result = adjust_pose_graph(graph, PoseGraphOptions(**options), progress)
    if output is not None:
        write_g2o(result.graph, output, force)
    numbers = result.summary()
    numbers["seconds"]["compilation"] = compilation.seconds
    rows = [[kind, f"{numbers[f'num_{kind}']:,}"] for kind in ("poses", "motions")]
    if len(result.outliers):
        rows.append(["beyond the scale of the loss", f"{len(result.outliers):,}"])
    if numbers["noise"] is not None:
        rows.append(["noise, times that of the file", f"{numbers['noise']:.3g}"])
    console.table(("", "number"), rows)
    time = spent(numbers["seconds"]["total"], compilation.seconds, compilation.compiled)
    costs = f"Cost {numbers['initial_cost']:.5g} -> {numbers['final_cost']:.5g}"
    steps = counted(numbers["iterations"], "steps")
    console.say(f"{costs}, {steps} in {time}. {result.report.termination.sentence}")
    if result.from_motions:
        console.say("It began from poses that follow from the motions alone: they cost less than those of the file.")
    console.warn(*result.warnings)
    if output is not None:
        console.wrote(output)
    else:
        console.say("No -o given: the adjusted graph was not written.")
    return numbers
