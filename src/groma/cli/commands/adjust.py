# SPDX-License-Identifier: BSD-3-Clause
"""``groma adjust``: bundle adjustment of a COLMAP model, a BAL file or an archive; a pose graph; parts."""

from typing import Annotated, Any, Literal

import typer

from groma.cli.shared import command as _complete
from groma.cli.shared import measurements as _measured
from groma.cli.shared import options as _options
from groma.cli.shared.adjusting import WANTED_NOTHING, Wanted, adjust_and_write
from groma.cli.shared.console import Console
from groma.errors import did_you_mean

LineResidual = Literal["endpoints", "bearing", "normal"]
PlaneResidual = Literal["normal_offset", "quaternion"]
Keep = Literal["auto", "always", "never"]


def _check_linear_solver(name: str) -> None:
    """Refuse a linear solver that is not registered, also by a plugin: before this, none is loaded."""
    from groma.solver.linear.choice import linear_solver_names

    if name not in linear_solver_names():
        known = ", ".join(linear_solver_names())
        suggestion = did_you_mean(name, linear_solver_names())
        raise typer.BadParameter(f"{name!r} is not one of {known}.{suggestion}", param_hint="'--linear-solver'")


def adjust(
    console: Console,
    source: _options.Input,
    loss: Annotated[
        str,
        _options.ADJUSTMENT.option(
            "auto, none, huber, soft_l1, cauchy, tukey, geman_mcclure, barron, truncated, or one of an installed "
            "package. auto: robust (Cauchy, then Geman-McClure) for matched features, none for BAL files.",
            choices=_complete.LOSSES,
            metavar="NAME",
        ),
    ] = "auto",
    loss_scale: Annotated[
        float | None,
        _options.ADJUSTMENT.option(
            "Scale of the loss, in units of the noise (pixels for images). Default: 1.", metavar="S"
        ),
    ] = None,
    camera_model: Annotated[
        str | None,
        _options.CAMERAS.option(
            "Change the model of all cameras first (PINHOLE to OPENCV, ...); new parameters start at 0 and are "
            "estimated.",
            choices=_complete.CAMERA_MODELS,
            metavar="NAME",
        ),
    ] = None,
    refine_intrinsics: Annotated[
        bool | None,
        _options.CAMERAS.option(
            "Estimate the calibration too. Default: for BAL files, with --camera-model, and in maps of photographs "
            "without a known one.",
            "--refine-intrinsics/--fix-intrinsics",
        ),
    ] = None,
    refine_principal_point: Annotated[
        bool,
        _options.CAMERAS.option(
            "With the intrinsics: all principal points too. Default: those exactly in the middle of the image, which "
            "were not measured, with a prior there.",
            "--refine-principal-point",
        ),
    ] = False,
    refine_rigs: Annotated[
        bool, _options.CAMERAS.option("Estimate the poses of the cameras on their rigs.", "--refine-rigs")
    ] = False,
    points: Annotated[bool, _options.ADJUSTMENT.option("Use points.")] = True,
    lines: Annotated[bool, _options.ADJUSTMENT.option("Use lines.")] = True,
    planes: Annotated[bool, _options.ADJUSTMENT.option("Use planes.")] = True,
    max_iterations: Annotated[
        int | None,
        _options.ADJUSTMENT.option("Stop after N steps. Default: 50, for pose graphs 100.", min=0, metavar="N"),
    ] = None,
    linear_solver: Annotated[
        str,
        _options.ADJUSTMENT.option(
            "Linear solver: auto, dense, sparse, pcg, or one of an installed package.",
            choices=_complete.LINEAR_SOLVERS,
            metavar="NAME",
        ),
    ] = "auto",
    line_chart: Annotated[
        str | None,
        _options.ADJUSTMENT.option(
            "Line parametrisation: cartesian (default), orthonormal_left, orthonormal_right, free_left, "
            "free_right, or one of an installed package.",
            choices=_complete.LINE_CHARTS,
            metavar="NAME",
        ),
    ] = None,
    line_residual: Annotated[
        LineResidual,
        _options.ADJUSTMENT.option(
            "Residual of a segment: endpoints, distances in the image; bearing, angles of rays; normal, the plane "
            "through camera and segment, also against the ray to the line's anchor."
        ),
    ] = "endpoints",
    plane_residual: Annotated[
        PlaneResidual,
        _options.ADJUSTMENT.option(
            "Residual of a measured plane: normal_offset, in the camera; quaternion, in the world."
        ),
    ] = "normal_offset",
    gauge: Annotated[
        str | None,
        _options.ADJUSTMENT.option(
            "free; first_camera, to hold the first camera and the scale; or auto (default): free, unless "
            "distances between landmarks are in scene units.",
            choices=_complete.GAUGES,
            metavar="NAME",
        ),
    ] = None,
    keep: Annotated[
        Keep,
        _options.ADJUSTMENT.option("With a folder of parts: keep them in memory between steps; auto: as many as fit."),
    ] = "auto",
    measured: _measured.Measured = _measured.NOTHING,
    wanted: Wanted = WANTED_NOTHING,
) -> None:
    """Adjust cameras, points, lines and planes together (bundle adjustment).

    Reads a scene, minimises the robust reprojection error and writes the scene back. The input is never modified.
    LIMAP's structures beside a COLMAP model are read and written too. A diagnosis at the end reports what the data do
    not determine. Pose graphs (g2o, TORO) can be adjusted too, and so can a folder of parts (groma convert --parts), in
    one process or in those started by mpiexec.
    """
    from groma.cli.shared import output as _output
    from groma.cli.shared.input import check_inputs, refuse_idle
    from groma.cli.shared.parts import adjust_parts_and_write, has_company, is_parts
    from groma.cli.shared.pose_graph import adjust_graph_and_write
    from groma.io.g2o import is_g2o

    if linear_solver != "auto":
        _check_linear_solver(linear_solver)
    measured.validate()
    in_parts = has_company() or is_parts(source)
    output, force = wanted.output, wanted.force
    if not in_parts:
        files = (wanted.page, wanted.covariance, wanted.protocol)
        _output.check_outputs(force, output, *files, json_target=console.json_target)
    wanted.validate()
    refuse_idle(
        ("--keep", keep != "auto" and not in_parts, "on a folder of parts"),
        (
            "--refine-principal-point",
            refine_principal_point and not (refine_intrinsics or camera_model),
            "with --refine-intrinsics",
        ),
    )
    refused = {  # by what is no scene with images as a whole
        **wanted.given, "--camera-model": camera_model, "--keep-suspects": measured.keep_suspects, **measured.given,
    }  # fmt: skip
    if not in_parts:
        check_inputs(source, wanted.truth, *measured.files)
    if not in_parts and is_g2o(source):
        refused |= {
            "--gauge": gauge, "--refine-intrinsics": refine_intrinsics, "--refine-rigs": refine_rigs,
            "--no-points": not points, "--no-lines": not lines, "--no-planes": not planes, "--line-chart": line_chart,
            "--line-residual": line_residual != "endpoints", "--plane-residual": plane_residual != "normal_offset",
        }  # fmt: skip
        graph_options = _chosen(
            loss="none" if loss == "auto" else loss, loss_scale=loss_scale, linear_solver=linear_solver,
            max_iterations=max_iterations, threads=console.threads,
        )  # fmt: skip
        numbers = adjust_graph_and_write(source, output, console, force, graph_options, refused)
        _output.write_json(console.json_target, numbers, force)
        return

    from groma.adjustment.adjust import AdjustOptions

    options = AdjustOptions(**_chosen(
        loss=loss, loss_scale=loss_scale, camera_model=camera_model, refine_intrinsics=refine_intrinsics,
        refine_principal_point=refine_principal_point or None, refine_rigs=refine_rigs, points=points, lines=lines,
        planes=planes, max_iterations=max_iterations, linear_solver=linear_solver, line_chart=line_chart, gauge=gauge,
        line_residual=line_residual, plane_residual=plane_residual, threads=console.threads,
    ))  # fmt: skip
    if in_parts:
        adjust_parts_and_write(source, output, console, options, refused, keep, force)
        return
    adjust_and_write(console, source, options, wanted, measured)


def _chosen(**options: Any) -> dict[str, Any]:
    """Options that were given; for the others the library has its defaults."""
    return {name: value for name, value in options.items() if value is not None}
