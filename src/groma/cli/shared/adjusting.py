# SPDX-License-Identifier: BSD-3-Clause
"""``groma adjust`` of a scene: progress, requested files, summary."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from groma._counted import counted
from groma.cli.shared import output as _output
from groma.cli.shared.input import refuse_idle
from groma.cli.shared.measurements import PANEL, Measured, say_survey
from groma.cli.shared.options import PLAIN, RESULTS, Contributions, Force, RollingShutter, Truth
from groma.errors import InputError, ProblemError

if TYPE_CHECKING:
    from collections.abc import Callable

    from groma.adjustment.adjust import AdjustOptions
    from groma.adjustment.report import AdjustResult, Progress
    from groma.adjustment.rolling_shutter import Motions
    from groma.adjustment.uncertainty import SceneUncertainty
    from groma.cli.shared.console import Console
    from groma.compilation.time import Compilation
    from groma.scene import Scene


@dataclass(frozen=True)
class Wanted:
    """The results requested from ``groma adjust``, one parameter of the command; None and False: not requested."""

    output: Annotated[
        Path | None,
        PLAIN.option(
            "Result: a folder (COLMAP model and structures), a groma archive (.npz) or a BAL file (.txt, .bz2, "
            ".gz). Without it, only reports are written.",
            "--output",
            "-o",
            metavar="OUT",
        ),
    ] = None
    rolling_shutter: RollingShutter = None
    page: Annotated[
        Path | None,
        RESULTS.option(
            "Also write an HTML page: before and after, with the photographs that groma view finds.",
            "--report",
            metavar="FILE",
        ),
    ] = None
    covariance: Annotated[
        Path | None,
        RESULTS.option(
            "Also write the uncertainty: covariances (.npz) or standard deviations (.json) of images, points, lines, "
            "planes and directions.",
            metavar="FILE",
        ),
    ] = None
    covariance_gauge: Annotated[
        Literal["auto", "inner", "held"],
        RESULTS.option("Gauge of the covariances: inner, all camera centres; held, the first camera and the scale."),
    ] = "auto"
    sigma0: Annotated[
        float,
        RESULTS.option(
            "With --covariance: factor on the assumed measurement noise, which is 1 pixel, or estimated from the "
            "residuals where observations have weights, as in maps.",
            metavar="S",
        ),
    ] = 1.0
    diagnosis: Annotated[
        bool | None, RESULTS.option("Report what the data do not determine. Default: up to 300 images.")
    ] = None
    protocol: Annotated[
        Path | None,
        PANEL.option(
            "Also write measurements with residuals, redundancy numbers and tests, as text (adjustment.txt).",
            metavar="FILE",
        ),
    ] = None
    contributions: Contributions = False
    truth: Truth = None
    force: Force = False

    def validate(self) -> None:
        """Refuse values out of range, and options without effect."""
        if self.covariance is not None and self.covariance.suffix not in (".npz", ".json"):
            raise InputError(f"--covariance must end in .npz or .json; got {self.covariance}.")
        if not 0.0 < self.sigma0 < float("inf"):
            raise InputError(f"--sigma0 must be positive; got {self.sigma0}.")
        if self.truth is not None and not self.contributions:
            raise InputError("--truth is what --contributions compares with. Add --contributions, or leave it out.")
        refuse_idle(
            ("--covariance-gauge", self.covariance_gauge != "auto" and self.covariance is None, "with --covariance"),
            ("--sigma0", self.sigma0 != 1.0 and self.covariance is None, "with --covariance"),
        )

    @property
    def given(self) -> dict[str, object]:
        """Options that need a scene with images as a whole, by name."""
        return {
            "--report": self.page, "--covariance": self.covariance, "--protocol": self.protocol,
            "--contributions": self.contributions, "--diagnosis": self.diagnosis,
            "--rolling-shutter": self.rolling_shutter,
        }  # fmt: skip


#: Of a command that was given none.
WANTED_NOTHING = Wanted()


def adjust_and_write(
    console: Console, source: Path, options: AdjustOptions, wanted: Wanted, measured: Measured
) -> None:
    """Adjust the scene in a file, write the requested results and print a summary.

    Raises
    ------
    ProblemError
        If requested covariances do not exist; raised after everything else was written. If the images are not
        connected, there is a warning instead.
    """
    from groma.adjustment.covariance_files import write_covariances
    from groma.cli.shared.diagnosis import try_diagnosis
    from groma.compilation.time import compilation_time
    from groma.io import check_target, read_scene, structures_of, write_scene

    before = read_scene(source)
    if wanted.output is not None:
        check_target(before, wanted.output)
    true = None if wanted.truth is None else read_scene(wanted.truth)
    console.expect_compilation(_work_of(before, options))
    with compilation_time() as compilation, console.progress() as progress:
        before, result, options, survey, motions = _adjusted(before, options, wanted, measured, progress)
    entries = ()
    if wanted.contributions:
        from groma.adjustment.contributions import contributions  # with evaluation, half a second to import

        entries = contributions(before, options, true)
    diagnosis = try_diagnosis(result.diagnose, before.num_images, console, wanted.diagnosis)
    numbers = result.summary(diagnosis, entries)
    numbers["seconds"]["compilation"] = compilation.seconds
    numbers |= {} if survey is None else {"survey": survey}
    if motions is not None:
        numbers["rolling_shutter"] = motions.to_dict()
        numbers["warnings"] += motions.warnings()

    if wanted.output is not None:
        write_scene(result.scene, wanted.output, force=wanted.force, like=structures_of(source))
    if wanted.protocol is not None:
        from groma.adjustment.survey.protocol import protocol

        with _output.atomic_output(wanted.protocol, wanted.force) as draft:
            draft.write_text(protocol(numbers), encoding="utf-8")
    found, failure = None, None
    if wanted.covariance is not None:
        try:
            found = result.uncertainty(wanted.covariance_gauge, wanted.sigma0)
            _output.check_output(wanted.covariance, wanted.force)
            write_covariances(wanted.covariance, result.scene, found, wanted.force)
            numbers["uncertainty"] = found.to_dict()
        except ProblemError as error:
            reasons = why_no_covariances(result.scene, wanted.covariance)
            numbers["warnings"] += reasons
            failure = None if reasons else error  # raised after all else is written
    if wanted.page is not None:
        _write_page(wanted.page, wanted.force, source, before, result, numbers, found)
    _say(console, numbers, compilation)
    say_survey(console, survey or {})
    console.say(*(motions.sentences() if motions else ()))
    for path in (wanted.output, wanted.page, wanted.protocol, wanted.covariance if "uncertainty" in numbers else None):
        if path is not None:
            console.wrote(path)
    if all(place is None for place in (wanted.output, wanted.page, wanted.covariance, console.json_target)):
        console.say("No -o given: the adjusted scene was not written.")
    _output.write_json(console.json_target, numbers, wanted.force)
    if failure is not None:
        raise failure


def _work_of(scene: Scene, options: AdjustOptions) -> str:
    """Return the name of the list of compiled functions that an adjustment probably needs."""
    from groma.compilation.needed import adjusting

    models = scene.cameras.models if options.camera_model is None else (options.camera_model,)
    estimated = options.refine_intrinsics
    if estimated is None:
        unknown = len(scene.principal_point_priors) > 0
        estimated = unknown or options.camera_model is not None or "BAL" in models
    has_points_alone = not (scene.num_lines or scene.num_planes or any(scene.num_measurements.values()))
    return adjusting(models, estimated, has_points_alone)


def _write_page(
    path: Path,
    force: bool,
    source: Path,
    before: Scene,
    result: AdjustResult,
    numbers: dict[str, Any],
    found: SceneUncertainty | None,
) -> None:
    """Write the page, before and after; covariances give standard deviations to what is measured on it."""
    from groma.viz.pictures import folder_of_images
    from groma.viz.report.covariances import LandmarkCovariances, centers_of_images
    from groma.viz.report.page import PageContents, write_report
    from groma.viz.report.survey import survey_card
    from groma.viz.report.tables import contributions_card

    known = None
    if found is not None:
        centers = centers_of_images(result.scene, found.centers, result.scene.images.frame_idx)
        known = LandmarkCovariances(found.gauge, found.points, found.lines, found.planes, centers)
    contents = PageContents(
        warnings=numbers["warnings"],
        diagnosis=numbers["diagnosis"],
        cards=contributions_card(numbers.get("contributions")) + survey_card(numbers.get("survey")),
        covariances=known,
    )
    title = f"Adjustment of {_output.subject(source)}"
    with _output.atomic_output(path, force) as draft:
        images = folder_of_images(source, result.scene.images.names)
        write_report(draft, before, result.scene, result.report, images, title, contents)


def _adjusted(
    before: Scene,
    options: AdjustOptions,
    wanted: Wanted,
    measured: Measured,
    progress: Callable[[Progress], bool | None],
) -> tuple[Scene, AdjustResult, AdjustOptions, dict[str, Any] | None, Motions | None]:
    """Return the initial scene, the result, how it was weighted, and the numbers of measurements and camera motions."""
    from groma.adjustment.adjust import adjust
    from groma.scene.counts import has_weights

    surveyed = bool(measured) or before.has_survey
    for option, given in (("--protocol", wanted.protocol), ("--keep-suspects", measured.keep_suspects or None)):
        if not surveyed and given is not None:
            raise InputError(
                f"{option} is of measurements; there are none. Add --positions, --control, --distances or others."
            )
    if wanted.rolling_shutter is not None:
        from groma.adjustment.rolling_shutter import with_rolling_shutter

        before = with_rolling_shutter(before, wanted.rolling_shutter)
    if not surveyed and not len(before.camera_motions):
        if before.is_metric or not has_weights(before):
            return before, adjust(before, options, progress), options, None, None
        from groma.mapping.noise.weighted import adjust_weighted

        return before, *adjust_weighted(before, options, progress), None, None
    from groma.mapping.surveyed import adjust_surveyed  # with what finds noise in images

    survey = measured.read(None, lambda: before.images.names) if measured else None
    found = adjust_surveyed(before, survey, options, progress, measured.keep_suspects)
    return found.surveyed.scene, found.result, options, found.to_dict() if surveyed else None, found.motions


def why_no_covariances(scene: Scene, path: Path) -> list[str]:
    """Return a warning if the images are not connected, so that joint covariances are undefined."""
    from groma.scene.connections import connected_images

    groups = connected_images(scene)
    if len(groups) < 2:
        return []
    names = [[scene.images.names[image] for image in group[:3]] for group in groups[:4]]
    parts = [
        f"{counted(len(group), 'images')} ({', '.join(some)}{', ...' if len(group) > 3 else ''})"
        for group, some in zip(groups, names, strict=False)
    ]
    more = [f"and {len(groups) - 4} more"] if len(groups) > 4 else []
    return [
        f"{path} was not written: the images fall into {len(groups)} groups without common landmarks, and "
        f"covariances between groups are not defined: {', '.join(parts + more)}. Add matches between them, or adjust "
        "each group as a scene of its own."
    ]


def _say(console: Console, numbers: dict[str, Any], compilation: Compilation) -> None:
    """Print the main numbers, the diagnosis and the warnings."""
    from groma.cli.shared.diagnosis import say_diagnosis
    from groma.cli.shared.sentences import describe_uncertainty, say_adjustment, say_contributions

    say_adjustment(console, numbers, numbers["termination_sentence"], compilation)
    console.say(*(describe_uncertainty(numbers["uncertainty"]) if "uncertainty" in numbers else ()))
    say_contributions(console, numbers.get("contributions", []))
    say_diagnosis(numbers["diagnosis"], console)
    console.warn(*numbers["warnings"])
