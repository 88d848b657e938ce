# SPDX-License-Identifier: BSD-3-Clause
"""Adjusting a scene with measurements of other instruments: pixels have to be weighed against them.

Standard deviations of positions and distances are stated, those of observations in images are estimated from their
residuals, which the frame of the scene does not change. Gross errors among the measurements are taken out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.report import AdjustResult, Progress
from groma.adjustment.rolling_shutter import Motions, adjust_rolling_shutter, motions_of
from groma.adjustment.survey.attach import Survey, Surveyed, with_survey
from groma.adjustment.survey.given_poses import given_poses_of
from groma.adjustment.survey.gross_errors import reliability_of, without_gross_errors
from groma.adjustment.survey.records import Reliability
from groma.io.survey import WorldFrame
from groma.mapping.noise.weighted import adjust_weighted
from groma.scene import Scene, Similarity
from groma.scene.checks import check_scene_given
from groma.scene.survey import with_rejected


@dataclass(frozen=True, eq=False)
class SurveyedResult:
    """An adjustment with external measurements, and their reliability."""

    result: AdjustResult
    #: How the scene got into its frame, with the scene as it went in.
    surveyed: Surveyed
    #: Tests of the measurements; None where the poses are not determined.
    reliability: Reliability | None
    #: How the cameras moved while images were read; None with a global shutter.
    motions: Motions | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return plain values: the entry ``survey`` of ``summary.json``."""
        return survey_numbers(self.surveyed, self.reliability, self.result.scene)


def survey_numbers(surveyed: Surveyed | None, found: Reliability | None, scene: Scene) -> dict[str, Any]:
    """Return the entries of a summary about measurements, as plain values."""
    return (surveyed.to_dict() if surveyed else {}) | (found.to_dict() if found else {}) | given_poses_of(scene)


def adjust_surveyed(
    scene: Scene,
    survey: Survey | None = None,
    options: AdjustOptions | None = None,
    progress: Callable[[Progress], bool | None] | None = None,
    keep_suspects: bool = False,
) -> SurveyedResult:
    """Transform a scene into the frame of external measurements and adjust it with them.

    Parameters
    ----------
    scene : Scene
        Adjusted already, in any frame; or with ``camera_motions``, which are estimated first, without the measurements.
    survey : Survey, optional
        Measurements to add; without, those that the scene holds are used.
    options : AdjustOptions, optional
        As for :func:`groma.adjust`; ``point_sigma_px`` and ``line_sigma_px`` are estimated.
    progress : callable, optional
        As for :func:`groma.adjust`.
    keep_suspects : bool, optional
        Keep gross errors in the adjustment, also those that were taken out before.

    Raises
    ------
    InputError
        If measurements and scene do not fit together.
    """
    check_scene_given(scene)
    unmoved, motions = Surveyed(scene, Similarity(), WorldFrame("the frame of the scene")), None
    if len(scene.camera_motions):
        rolled = adjust_rolling_shutter(scene, options, progress)
        if survey is None and not scene.has_survey:
            return SurveyedResult(rolled.result, unmoved, None, rolled.motions)
        scene, motions = rolled.result.scene, rolled.motions
    surveyed = with_survey(scene, survey) if survey else replace(unmoved, scene=scene)
    if keep_suspects:
        surveyed = replace(surveyed, scene=with_rejected(surveyed.scene, ()))
    result, chosen = adjust_weighted(surveyed.scene, options, progress)
    if keep_suspects:
        found = reliability_of(result.scene, result.problem)
    else:
        result, found = without_gross_errors(result, lambda scene: adjust(scene, chosen, progress))
    if len(result.scene.camera_motions):
        motions = motions_of(result.scene, result.problem)
    return SurveyedResult(result, surveyed, found, motions)
