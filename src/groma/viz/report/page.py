# SPDX-License-Identifier: BSD-3-Clause
"""A scene, or a scene before and after adjustment, as one self-contained HTML file.

The file needs no network and no server: styles, viewer, data and photographs lie inside. The scene is drawn by WebGL,
or on a canvas where there is none, with the photographs and what was measured in them beside it; charts are inline
SVG; numbers stand in tables. Arrays travel as base64 float32, less a common offset, so that far away coordinates keep
their digits. The parts of the page are the files in ``web``; the scripts there are one program, joined in the order of
``SCRIPTS``.
"""

from __future__ import annotations

import base64
import hashlib
import html
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from groma._version import __version__
from groma.errors import InputError, OutputError
from groma.execution import begin
from groma.scene import Scene
from groma.scene.checks import check_scene_given
from groma.viz.drawable import Drawable, drawable
from groma.viz.pack import script_json
from groma.viz.pictures import ImageFiles
from groma.viz.report import charts as _charts
from groma.viz.report import tables as _page_tables
from groma.viz.report.covariances import LandmarkCovariances
from groma.viz.report.data import scene_data
from groma.viz.report.images import Photographs, image_data, page_photographs, up_in_page
from groma.viz.report.kept import kept

#: The scripts of the page, in order.
SCRIPTS = (
    *("data", "vectors", "colours", "orbit", "things", "webgl", "flat"),
    *("scene", "measure", "about", "photo", "strip", "main"),
)


class Report(Protocol):
    """Interface to the report of an adjustment."""

    @property
    def history(self) -> Sequence[Any]:
        """Steps: mappings or objects with iteration, cost, accepted."""
        ...

    @property
    def warnings(self) -> Sequence[str]:
        """Sentences for the user."""
        ...

    @property
    def termination(self) -> Any:
        """An enumeration member with a ``sentence``."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers of the machine-readable report."""
        ...


@dataclass(frozen=True)
class PageContents:
    """Contents of a page besides the scenes and the report of their adjustment."""

    #: Numbers of segments of a map by outcome, and the same in words.
    outcomes: Mapping[str, int] | None = None
    explanation: str = ""
    #: Sentences in a box; by default those of the report.
    warnings: Sequence[str] | None = None
    #: What the data determine, as :meth:`groma.solver.observability.diagnosis.Diagnosis.to_dict` gives it; by default
    #: what the numbers of the report hold under ``diagnosis``.
    diagnosis: Mapping[str, Any] | None = None
    #: HTML before the charts.
    cards: str = ""
    #: HTML of the large numbers instead of the usual ones.
    tiles: str | None = None
    #: Result of :func:`~groma.viz.report.images.page_photographs`; by default they are read now.
    photographs: Photographs | None = None
    #: Covariances of ``scene_after``, for standard deviations of measurements on the page.
    covariances: LandmarkCovariances | None = None


def write_report(
    path: str | os.PathLike[str],
    scene_before: Scene | None,
    scene_after: Scene,
    report: Report | None = None,
    images: ImageFiles | None = None,
    title: str = "Adjustment",
    contents: PageContents | None = None,
) -> None:
    """Write a self-contained HTML report.

    Parameters
    ----------
    path
        The HTML file; it is replaced.
    scene_before, scene_after
        The same scene before and after; ``scene_before`` may be None to show a single scene.
    report
        Report of the adjustment, for the numbers, the convergence curve and the warnings.
    images
        Folder of the photographs, or files by image name, shown behind what was measured in them. At most sixty are
        embedded, and made smaller the more there are.
    title
        Heading of the page.
    contents
        Further contents.

    Raises
    ------
    InputError
        If the two scenes do not hold the same landmarks and observations.
    OutputError
        If the file cannot be written.
    """
    check_scene_given(scene_after, "scene_after")
    drawn = None if scene_before is None else begin(partial(drawable, scene_before))
    after = drawable(scene_after)
    before = None if drawn is None else drawn()
    if before is not None and not _same_shape(before, after):
        raise InputError(
            "scene_before and scene_after must hold the same images, landmarks and observations, in the same order; "
            "they do not. Pass the input and the result of one adjustment, or scene_before=None."
        )
    scenes = [scene for scene in (scene_before, scene_after) if scene is not None]
    states = [state for state in (before, after) if state is not None]
    numbers = report.to_dict() if report is not None else None
    history = [step for step in report.history if _charts.entry(step)["iteration"] > 0] if report is not None else None
    said = contents or PageContents()
    sentences = said.warnings
    if sentences is None:
        sentences = () if report is None else report.warnings
    diagnosis = said.diagnosis
    if diagnosis is None and numbers is not None:
        diagnosis = numbers.get("diagnosis")
    script = '"use strict";\n' + "".join(_part(f"{name}.js") for name in SCRIPTS)
    held = kept(scene_after)
    photographs = said.photographs or page_photographs(scene_after, images)
    states[-1] = replace(after, up=up_in_page(scene_after, photographs))
    of_scene = begin(partial(scene_data, scenes, states, held, said.covariances))
    of_images = begin(partial(image_data, scene_after, held, states, photographs))
    parts = {
        "POLICY": _policy(script),
        "STYLE": _part("page.css"),
        "TITLE": html.escape(title),
        "LEAD": _lead(scene_after, after, report),
        "TILES": _page_tables.tiles(scene_after, before, after, numbers) if said.tiles is None else said.tiles,
        "WARNINGS": "".join(f'<p class="warning">{html.escape(text)}</p>' for text in sentences),
        "CHARTS": said.cards
        + _page_tables.diagnosis_card(diagnosis)
        + _page_tables.chart_cards(
            scene_after, before, after, history, _stages(numbers), said.outcomes, said.explanation
        ),
        "TABLES": _page_tables.number_tables(scene_after, before, after, numbers),
        "FOOTER": f"Written by groma {__version__}. Pixels: the centre of the first pixel is (0.5, 0.5).",
        "DATA": script_json(of_scene() | of_images()),
        "SCRIPT": script,
    }
    page = re.sub(r"\{\{([A-Z]+)\}\}", lambda match: parts[match[1]], _part("page.html"))
    try:
        Path(path).write_text(page, encoding="utf-8")
    except OSError as error:
        raise OutputError(f"Cannot write {path}: {error.strerror or error}. Choose another place.") from error


def _part(name: str) -> str:
    return files("groma.viz.report").joinpath("web", name).read_text(encoding="utf-8")


def _policy(script: str) -> str:
    """Return the content security policy: run this script, show embedded images, nothing else."""
    digest = base64.b64encode(hashlib.sha256(f"\n{script}\n".encode()).digest()).decode()
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; img-src data:; "
        "base-uri 'none'; form-action 'none'"
    )


def _same_shape(first: Drawable, second: Drawable) -> bool:
    names = ("points", "segments", "patch_members", "cam_from_world", "residuals", "residual_image")
    return all(np.shape(getattr(first, name)) == np.shape(getattr(second, name)) for name in names)


def _lead(scene: Scene, shown: Drawable, report: Report | None) -> str:
    counts = _page_tables.words(_page_tables.counts_of(scene, shown))
    first = f"{counts}. {report.termination.sentence}" if report is not None else f"{counts}."
    return f'<p class="lead">{html.escape(first)}</p>'


def _stages(numbers: Mapping[str, Any] | None) -> list[dict[str, Any]]:
    """Return the stages of an adjustment; a single one if the report does not list them."""
    if numbers is None:
        return []
    whole = {"loss": "", "initial_cost": numbers["initial_cost"], "first_step": 1}
    return [{**whole, **stage} for stage in numbers.get("stages") or [whole]]
