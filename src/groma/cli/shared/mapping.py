# SPDX-License-Identifier: BSD-3-Clause
"""Mapping on the command line: progress, Ctrl-C, resuming from finished stages, summary."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from groma.cli.shared import output as _output
from groma.cli.shared.depth import say_depth
from groma.cli.shared.diagnosis import DIAGNOSING
from groma.cli.shared.interrupt import stages_that_are_kept
from groma.cli.shared.measurements import say_survey
from groma.errors import OutputError

if TYPE_CHECKING:
    from groma.adjustment.survey.given import Survey
    from groma.cli.shared.console import Console
    from groma.features.external import ExternalMatches
    from groma.io.depth_maps import DepthMaps
    from groma.mapping.options import MapOptions
    from groma.mapping.plan import Start
    from groma.mapping.result import MapResult
    from groma.scene import Scene

#: Name of the last stage.
WRITING = "writing the results"


def run_map(
    console: Console,
    images: Path,
    work: Path,
    model: Scene | None,
    options: MapOptions,
    line_matches: ExternalMatches | None = None,
    survey: Survey | None = None,
    depth: DepthMaps | None = None,
) -> MapResult:
    """Map a folder of photographs; Ctrl-C ends the command and keeps the finished stages in ``work``."""
    from groma.compilation.ahead import mapping
    from groma.compilation.loading import loading
    from groma.execution import share_memory
    from groma.features.images import one_opencv_thread
    from groma.mapping.checkpoints import check_free, has_stages
    from groma.mapping.map import map_images

    check_free(work)
    share_memory()
    one_opencv_thread()
    needed = mapping(options.refine_poses)
    console.expect_compilation(needed)
    start: Start = "photographs" if model is None else "model" if model.num_point_observations else "poses"
    console.expect_stages(
        *stages_of_map(options, start, survey is not None, line_matches is not None, depth is not None)
    )
    if has_stages(work):
        console.say(f"Resuming from the finished stages in {work}, as far as they fit.")
    with stages_that_are_kept(console, f"finished stages are kept in {work}") as say, loading(needed, options.threads):
        return map_images(images, work, model, options, say, line_matches, survey, depth)


def stages_of_map(
    options: MapOptions,
    start: Start = "model",
    surveyed: bool = False,
    given_segments: bool = False,
    depth: bool = False,
) -> tuple[str, ...]:
    """Return the names of the stages of a map, with those that the command adds."""
    from groma.mapping.plan import planned_stages

    return (*planned_stages(options, start, surveyed, given_segments, depth), DIAGNOSING, WRITING)


def write_map(console: Console, result: MapResult, output: Path, work: Path, force: bool, **how: Any) -> None:
    """Write the folder of results and remove the finished stages; ``how`` is passed to :meth:`MapResult.write`."""
    from groma.mapping.checkpoints import remove_stages, system_reason

    try:
        _output.check_output(output, force)
        with console.stages() as say:
            say(WRITING, 0, 1)
            result.write(output, force=force, work=work, **how)
    except OutputError as error:
        raise OutputError(
            f"Cannot write {output}: {system_reason(error)}. Finished stages are kept in {work}: the same command goes "
            "on from there."
        ) from error
    remove_stages(work)


def say_map(console: Console, result: MapResult, numbers: dict[str, Any], explain: bool = True) -> None:
    """Print the content of a map, its fit, the diagnosis, and the outcome of the segments.

    Without ``explain`` the last two are printed with --verbose only.
    """
    from groma.cli.shared.diagnosis import say_diagnosis
    from groma.cli.shared.sentences import (
        KINDS,
        describe_pose_uncertainty,
        describe_relations,
        describe_structure,
        fit_table,
        say_contributions,
    )

    counts = {kind: getattr(result.scene, f"num_{kind}") for kind in KINDS}
    console.table(*fit_table(counts, result.report.inliers))
    console.say(*describe_pose_uncertainty(numbers.get("pose_uncertainty")))
    console.say(*describe_structure(numbers["num_relations"]))
    console.detail(*describe_relations(result.report.relations))
    say_contributions(console, numbers.get("contributions", []))
    if explain or console.verbose:
        say_diagnosis(numbers["diagnosis"], console)
    (console.say if explain else console.detail)(result.explanation)
    say_depth(console, numbers.get("depth") or {})
    say_survey(console, numbers.get("survey") or {})
    console.warn(*result.warnings)
