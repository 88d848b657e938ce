# SPDX-License-Identifier: BSD-3-Clause
"""What comes out of a map: the scene, its numbers, what its data determine, and the folder of results."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.adjust import AdjustOptions, assembly_options_of, losses_of, relation_loss_of
from groma.adjustment.assemble import assemble
from groma.adjustment.contributions import Contribution, contributions
from groma.adjustment.diagnosis import diagnose_scene
from groma.adjustment.report import AdjustReport, AdjustResult
from groma.adjustment.rolling_shutter import Motions, motions_of
from groma.adjustment.stages import with_loss
from groma.adjustment.survey.attach import Surveyed
from groma.adjustment.survey.gross_errors import reliability_of
from groma.adjustment.survey.protocol import protocol
from groma.adjustment.uncertainty import pose_uncertainty
from groma.bounded.json_text import json_text
from groma.execution import begin, beside
from groma.features.segments import Segments
from groma.io import atomic_output, write_geometry, write_scene
from groma.mapping.depth.points import MeasuredDepths
from groma.mapping.lines.confidence import line_confidence
from groma.mapping.lines.intervals import with_supported_intervals
from groma.mapping.lines.line_map import LineMap, explain
from groma.mapping.surveyed import survey_numbers
from groma.mapping.unused import without_unused
from groma.problem.problem import Problem
from groma.scene import Scene
from groma.scene.counts import num_relations
from groma.solver.observability.diagnosis import Diagnosis, Finding
from groma.viz.pictures import ImageFiles
from groma.viz.report.images import Photographs, page_photographs
from groma.viz.report.page import PageContents, write_report
from groma.viz.report.survey import survey_card
from groma.viz.report.tables import contributions_card

#: Fields of a result that are scenes of one frame.
SCENES_OF_RESULT = ("scene", "start", "before", "adjusted")


@dataclass(frozen=True)
class MapResult:
    """A map, and the report of how it was made."""

    #: Points, lines, planes, poses.
    scene: Scene
    #: The scene that went in: the given model, or the reconstruction of the points.
    start: Scene
    #: The map before its last joint adjustment, with the same landmarks as ``scene``.
    before: Scene
    #: ``scene`` with the lines that were left out after they had taken part in the adjustment.
    adjusted: Scene
    #: Report of the last joint adjustment, and what it was told: noise, losses, what is estimated.
    report: AdjustReport
    adjusted_with: AdjustOptions
    #: Estimated standard deviations, pixels: of points, and of segment end points.
    sigma_px: dict[str, float]
    #: What became of the segments, in words.
    explanation: str
    #: Number of segments with each outcome, by name.
    outcomes: dict[str, int]
    #: Sentences for the user.
    warnings: tuple[str, ...]
    #: Photographs that were to be placed; 0 where that is not known.
    num_photographs: int = 0
    #: How the map got into the frame of measurements, where there are any.
    surveyed: Surveyed | None = None
    #: What was found out about the depth maps, where there are any.
    depths: MeasuredDepths | None = None

    def diagnose(self) -> Diagnosis:
        """Say in words what the observations determine, at the noise and with the loss of the last adjustment.

        How well the cameras are known, of which :meth:`summary` tells, is found out meanwhile.
        """
        _ = self._uncertainty
        found = diagnose_scene(self.scene, problem=_problem_of(self.scene, self.adjusted_with))
        missing = self.num_photographs - self.scene.num_images
        if 2 * missing <= self.num_photographs:
            return found
        sentence = (
            f"{missing} of {self.num_photographs} photographs were not placed. All findings are about the other "
            f"{self.scene.num_images}."
        )
        left = Finding("photographs_left_out", "problem", sentence, values={"count": float(missing)})
        others = tuple(finding for finding in found.findings if finding.kind != "determined")
        return replace(found, findings=(left, *others))

    def pose_uncertainty(self) -> dict[str, Any] | None:
        """Return how well the cameras are known, by leaving out one landmark after the other."""
        return self._uncertainty()

    @cached_property
    def _uncertainty(self) -> Callable[[], dict[str, Any] | None]:
        return begin(self._pose_uncertainty)

    def _pose_uncertainty(self) -> dict[str, Any] | None:
        problem = _problem_of(self.adjusted, self.adjusted_with)
        return pose_uncertainty(self.adjusted, problem, self.report.sigma0 or 1.0, by_landmarks=True)

    def contributions(self, reference: Scene | None = None) -> tuple[Contribution, ...]:
        """Repeat the last adjustment with points only, with lines and with planes: :func:`groma.contributions`."""
        return contributions(self.before, self.adjusted_with, reference)

    def summary(self, diagnosis: Diagnosis | None = None, contributions: Sequence[Contribution] = ()) -> dict[str, Any]:
        """Return all numbers as plain values: the content of ``summary.json``."""
        numbers = {
            **self.report.to_dict(),
            "num_images": self.scene.num_images,
            "num_points": self.scene.num_points,
            "num_lines": self.scene.num_lines,
            "line_confidence": _confidence_numbers(self.scene.lines.confidence),
            "num_planes": self.scene.num_planes,
            "num_directions": self.scene.num_directions,
            "num_relations": num_relations(self.scene),
            "sigma_px": self.sigma_px,
            "segments": self.outcomes,
            "explanation": self.explanation,
            "warnings": list(self.warnings),
            "estimated": {
                "poses": self.adjusted_with.refine_poses,
                "intrinsics": self.adjusted_with.refine_intrinsics is not False,
            },
            "diagnosis": None if diagnosis is None else diagnosis.to_dict(),
            "pose_uncertainty": None if diagnosis is None else self.pose_uncertainty(),
        }
        if contributions:
            numbers["contributions"] = [entry.to_dict() for entry in contributions]
        if self.depths is not None:
            numbers["depth"] = self.depths.to_dict()
        if len(self.scene.camera_motions):
            numbers["rolling_shutter"] = self.motions().to_dict()
        if self.scene.has_survey or len(self.scene.pose_priors):
            found = reliability_of(self.scene, _problem_of(self.scene, self.adjusted_with))
            numbers["survey"] = survey_numbers(self.surveyed, found, self.scene)
        return numbers

    def motions(self) -> Motions:
        """Return how the cameras moved while images were read, and how well the last adjustment tells."""
        return motions_of(self.scene, _problem_of(self.scene, self.adjusted_with))

    def photographs(self, images: ImageFiles | None) -> Photographs:
        """Begin to read the photographs for the page of :meth:`write`; other work goes on meanwhile."""
        return page_photographs(self.scene, images)

    def write(
        self,
        folder: str | os.PathLike[str],
        images: ImageFiles | None = None,
        title: str = "Map",
        *,
        summary: Mapping[str, Any] | None = None,
        force: bool = False,
        work: str | os.PathLike[str] | None = None,
        photographs: Photographs | None = None,
    ) -> None:
        """Write everything that ``groma map`` writes to a folder, whole or not at all.

        A COLMAP model with the lines and planes beside it (``structures``), ``scene.npz``, lines and planes as PLY and
        OBJ, ``summary.json`` and ``report.html``; with measurements of other instruments ``adjustment.txt``.

        Parameters
        ----------
        folder : path
            Made here.
        images : path or mapping, optional
            The photographs, for the page.
        title : str
            Heading of the page.
        summary : mapping, optional
            Content of ``summary.json``; by default :meth:`summary`. The page shows its diagnosis and contributions.
        force : bool
            Replace what is there.
        work : path, optional
            Folder on the same disk in which the results are built; by default beside ``folder``.
        photographs : callable, optional
            What :meth:`photographs` began before; by default they are read now.
        """
        numbers = dict(self.summary() if summary is None else summary)
        if isinstance(images, str | os.PathLike):
            numbers["images"] = os.path.abspath(images)  # where groma localize looks for them
        with atomic_output(folder, force, work) as draft:
            others = draft.with_name("others")
            others.mkdir()
            with beside(partial(self._write_scene, draft, others)):
                self._write_page(others, photographs or self.photographs(images), title, numbers)
            for file in others.iterdir():
                file.rename(draft / file.name)

    def _write_scene(self, model: Path, others: Path) -> None:
        write_scene(self.scene, model, format="colmap")
        write_scene(self.scene, others / "scene.npz")
        write_geometry(self.scene, others)

    def _write_page(self, folder: Path, photographs: Photographs, title: str, numbers: dict[str, Any]) -> None:
        """Write the page and what else says how good the map is."""
        write_report(
            folder / "report.html",
            self.before,
            self.scene,
            self.report,
            title=title,
            contents=PageContents(
                self.outcomes,
                self.explanation,
                self.warnings,
                numbers.get("diagnosis"),
                contributions_card(numbers.get("contributions")) + survey_card(numbers.get("survey")),
                photographs=photographs,
            ),
        )
        if "survey" in numbers:
            (folder / "adjustment.txt").write_text(protocol(numbers), encoding="utf-8")
        (folder / "summary.json").write_text(json_text(numbers), encoding="utf-8")


def _confidence_numbers(confidence: FloatArray) -> dict[str, Any]:
    """How many lines are expected to be right, and how many have a probability of 0 to 0.1, to 0.2 and so on."""
    counts = np.histogram(confidence, np.linspace(0.0, 1.0, 11))[0]
    return {"expected_right": float(confidence.sum()), "lines_by_tenth": counts.tolist()}


def _problem_of(scene: Scene, told: AdjustOptions) -> Problem:
    """Return the problem of the last adjustment at its solution."""
    last_loss, relation_loss = losses_of(scene, told)[-1], relation_loss_of(scene, told)
    problem = assemble(scene, assembly_options_of(scene, told, last_loss, relation_loss)).problem
    return with_loss(problem, last_loss, relation_loss, told.line_loss_factor)


def result_of(
    points: Scene,
    before: Scene,
    adjusted: AdjustResult,
    weighted: AdjustOptions,
    line_map: LineMap,
    segments: Sequence[Segments],
    min_confidence: float,
    held: bool,
) -> MapResult:
    """Return the result of a map from its last adjustment, with the lines that are probably right.

    Where poses were held, lines as mapped tell best what their segments say: none has given way to a plane yet.
    """
    scene = with_supported_intervals(adjusted.scene, segments)
    before = before.replace(line_intervals=scene.line_intervals)
    confidence = line_confidence(before if held else scene, weighted.structure_sigma_px)
    scene, kept = scene.replace(lines=scene.lines.replace(confidence=confidence)), confidence >= min_confidence
    scene, before = without_unused(scene.keep(lines=kept), before.keep(lines=kept))
    missing = [] if line_map.num_lines else ["No line was mapped; see what became of the segments."]
    return MapResult(
        scene=scene,
        start=points,
        before=before,
        adjusted=adjusted.scene,
        report=adjusted.report,
        adjusted_with=weighted,
        sigma_px={"points": weighted.point_sigma_px, "lines": weighted.line_sigma_px},
        explanation=explain(line_map, int((~kept).sum()), min_confidence),
        outcomes={outcome.name.lower(): count for outcome, count in line_map.outcome_counts().items()},
        warnings=(*missing, *adjusted.report.warnings),
    )
