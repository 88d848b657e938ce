# SPDX-License-Identifier: BSD-3-Clause
"""The options of an adjustment as parts take them."""

from __future__ import annotations

import os
from dataclasses import fields
from typing import Any

from groma.adjustment.adjust import AdjustOptions, assembly_options_of, losses_of, relation_loss_of, start_tolerance_of
from groma.factors.losses import Loss
from groma.io.archive import read_archive
from groma.solver.options import SolverOptions


def settings_of(
    part: str | os.PathLike[str], options: AdjustOptions
) -> tuple[list[Loss], SolverOptions, dict[str, Any]]:
    """Return the losses, the options of the solver and those of the assembly that :func:`adjust_parts` takes.

    Automatic choices, such as those by the kind of cameras, are made for the given part.
    """
    scene = read_archive(part)
    losses = losses_of(scene, options)
    assembly = assembly_options_of(scene, options, losses[-1], relation_loss_of(scene, options))
    solver = SolverOptions(
        max_iterations=options.max_iterations,
        function_tolerance=options.function_tolerance,
        start_tolerance=start_tolerance_of(scene, options),
        linear_solver=options.linear_solver,
        threads=options.threads,
    )
    values = {item.name: getattr(assembly, item.name) for item in fields(assembly) if item.name != "loss"}
    return losses, solver, values
