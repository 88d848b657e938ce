# SPDX-License-Identifier: BSD-3-Clause
"""``groma adjust`` of a pose graph in a file of g2o."""

from pathlib import Path
from typing import Any

from groma._counted import counted
from groma.cli.shared.compilation import compilation_time, spent
from groma.cli.shared.console import Console
from groma.errors import InputError


def is_pose_graph(path: Path) -> bool:
    """Tell by its name whether a file holds a pose graph: it ends in .g2o or .g2o.gz."""
    return path.name.lower().endswith((".g2o", ".g2o.gz"))


def adjust_pose_graph_file(
    source: Path, output: Path | None, console: Console, force: bool, options: dict[str, Any], refused: dict[str, Any]
) -> dict[str, Any]:
    """Adjust a pose graph, write it, say how it went and return the numbers.

    Parameters
    ----------
    source, output : Path
        Files of g2o; without ``output`` nothing is written.
    console : Console
        Where to speak.
    force : bool
        Replace what is there.
    options : dict
        Fields of :class:`groma.adjustment.pose_graph.PoseGraphOptions` that were chosen.
    refused : dict
        Options of the command that mean nothing for a pose graph, and their values.
    """
    for name, value in refused.items():
        if value:
            raise InputError(f"{name} is for scenes with images; {source} is a pose graph. Leave it out.")
    if output is not None and not is_pose_graph(output):
        raise InputError(f"A pose graph is written as .g2o or .g2o.gz; got {output}.")

    from groma.adjustment.pose_graph import PoseGraphOptions, adjust_pose_graph
    from groma.io.g2o import read_g2o, write_g2o

    graph = read_g2o(source)
    settings = PoseGraphOptions(**options)
    console.announce_compilation()
    with compilation_time() as compilation, console.progress() as progress:
        result = adjust_pose_graph(graph, settings, progress)
    if output is not None:
        write_g2o(result.graph, output, force)
    report = result.report
    parts = int(graph.parts().max()) + 1
    console.say(f"{counted(len(graph.poses), 'poses')}, {counted(len(graph.motions), 'motions')} between them")
    console.say(f"  {'cost':<16}{report.initial_cost:>10.5g}     ->{report.final_cost:>9.5g}")
    time = spent(report.seconds["total"], compilation.seconds, compilation.compiled)
    console.say(f"  {counted(report.iterations, 'steps')} in {time}. {report.termination.sentence}")
    if len(result.doubtful):
        console.say(f"  {counted(len(result.doubtful), 'motions')} beyond the scale of the loss")
    warnings = list(report.warnings)
    if parts > 1:
        warnings.append(f"The graph falls into {parts} parts; each keeps the frame of its held or first pose.")
    for sentence in warnings:
        console.warn(sentence)
    console.say(f"Wrote {output}" if output is not None else "No -o given: the adjusted graph was not written.")
    ids = graph.poses.ids
    return {
        "num_poses": len(graph.poses),
        "num_motions": len(graph.motions),
        "num_parts": parts,
        "planar": graph.planar,
        "initial_cost": report.initial_cost,
        "final_cost": report.final_cost,
        "iterations": report.iterations,
        "termination": report.termination.key,
        "converged": report.converged,
        "linear_solver": report.linear_solver,
        "seconds": {**report.seconds, "compilation": compilation.seconds},
        "chi_square": {"before": float(result.chi_square_before.sum()), "after": float(result.chi_square.sum())},
        "doubtful_motions": [
            [int(ids[graph.motions.first_idx[row]]), int(ids[graph.motions.second_idx[row]])] for row in result.doubtful
        ],
        "warnings": warnings,
    }


__all__ = ["adjust_pose_graph_file", "is_pose_graph"]
