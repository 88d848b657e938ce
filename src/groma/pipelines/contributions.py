# SPDX-License-Identifier: BSD-3-Clause
"""What each kind of landmark contributes: the same adjustment with and without lines, planes and what lies on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from groma.errors import InputError, ProblemError
from groma.evaluation.alignment import align_poses
from groma.evaluation.poses import evaluate_poses
from groma.geometry import se3
from groma.pipelines.adjust import AdjustOptions, AdjustResult, adjust
from groma.pipelines.uncertainty import position_sigma, uncertainty
from groma.scene import Relations, Scene

#: What is added, one after the other.
KINDS = ("points", "lines", "planes and directions", "points on lines")
#: With more images than this the standard deviations are left out.
MOST_IMAGES = 300


@dataclass(frozen=True)
class Contribution:
    """An adjustment of everything up to one kind of landmark; lengths in scene units, residuals in pixels."""

    #: The kind that was added last.
    added: str
    #: Adjusted landmarks and relations of all kinds so far, and the relations that the loss gave up.
    num_landmarks: int
    num_relations: int
    num_dropped: int
    #: Root mean square residual by kind, without the loss.
    rmse_px: dict[str, float]
    #: Median distance of the camera centres from those of points alone, after a similarity alignment.
    moved: float
    #: Median predicted standard deviation of the camera centres, with the first camera and the scale held, because
    #: relations in lengths leave no free scale; None where it is not known.
    center_sigma: float | None
    #: Against a reference, if there is one: rms error of the camera centres, and mean error of the rotations.
    center_error: float | None
    rotation_error_deg: float | None
    iterations: int
    seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers and words, for JSON."""
        return asdict(self)


def contributions(
    scene: Scene,
    options: AdjustOptions | None = None,
    reference: Scene | None = None,
    progress: Callable[[str], None] | None = None,
) -> tuple[Contribution, ...]:
    """Adjust a scene by its points alone, then with lines, then with planes and directions, then with points on lines.

    Every adjustment begins at the scene as it is given; kinds that it does not hold are left out.

    Parameters
    ----------
    scene : Scene
        The scene; it is not changed.
    options : AdjustOptions, optional
        How to adjust; ``points``, ``lines`` and ``planes`` say what may take part.
    reference : Scene, optional
        The scene taken for true; images are matched by name.
    progress : callable, optional
        Called with what is added, before each adjustment.

    Returns
    -------
    tuple of Contribution
        One entry for each kind, in the order of :data:`KINDS`.

    Raises
    ------
    InputError
        If the scene has no points to begin with, or no image of the reference.
    """
    options = options or AdjustOptions()
    if not (options.points and scene.num_point_observations):
        raise InputError(
            "Contributions are measured against an adjustment by points alone, and there are no points. "
            "Leave out --contributions, or --no-points."
        )
    found: list[Contribution] = []
    alone: Scene | None = None
    for kind, variant, chosen in _variants(scene, options):
        if progress is not None:
            progress(kind)
        result = adjust(variant, chosen)
        alone = alone or result.scene
        found.append(_contribution(kind, result, alone, reference))
    return tuple(found)


def _variants(scene: Scene, options: AdjustOptions) -> list[tuple[str, Scene, AdjustOptions]]:
    """Return what is added, the scene with the relations so far, and the options, for each kind that is there."""
    all_of = scene.relations
    with_lines = options.lines and scene.num_line_observations > 0
    with_planes = options.planes and scene.num_planes + scene.num_directions > 0
    steps = [("points", Relations(), False, False)]
    if with_lines:
        steps.append(("lines", Relations(), True, False))
    if with_planes:
        steps.append(
            ("planes and directions", replace(all_of, point_on_line=all_of.point_on_line[:0]), with_lines, True)
        )
    if with_lines and len(all_of.point_on_line):
        steps.append(("points on lines", all_of, True, with_planes))
    return [
        (kind, scene.replace(relations=relations), replace(options, lines=lines, planes=planes))
        for kind, relations, lines, planes in steps
    ]


def _contribution(kind: str, result: AdjustResult, alone: Scene, reference: Scene | None) -> Contribution:
    report, scene = result.report, result.scene
    moved = align_poses(scene.cam_from_world, alone.cam_from_world).poses(scene.cam_from_world)
    away = se3.inverse(moved)[:, 4:] - alone.cam_centers_in_world
    scores = None if reference is None else evaluate_poses(scene, reference)
    outcomes = report.relations.values()
    return Contribution(
        added=kind,
        num_landmarks=report.num_points + report.num_lines + report.num_planes,
        num_relations=sum(outcome["held"] + outcome["dropped"] for outcome in outcomes),
        num_dropped=sum(outcome["dropped"] for outcome in outcomes),
        rmse_px={name: values["after"] for name, values in report.rmse_px.items()},
        moved=0.0 if scene is alone else float(np.median(np.linalg.norm(away, axis=1))),
        center_sigma=_center_sigma(result),
        center_error=None if scores is None else scores.center_rmse,
        rotation_error_deg=None if scores is None else scores.rotation_deg_mean,
        iterations=report.solve.iterations,
        seconds=report.solve.seconds["total"],
    )


def _center_sigma(result: AdjustResult) -> float | None:
    if result.scene.num_images > MOST_IMAGES:
        return None
    try:
        found = uncertainty(result.scene, gauge="held", problem=result.problem)
    except (InputError, ProblemError):  # poses are held, or the data leave a line or a plane open
        return None
    sigma = position_sigma(found.centers)
    known = sigma[np.isfinite(sigma) & (sigma > 0)]
    return float(np.median(known)) if len(known) else None
