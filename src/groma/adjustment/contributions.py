# SPDX-License-Identifier: BSD-3-Clause
"""What each kind of landmark contributes: the same adjustment with and without lines, planes and what lies on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from groma._image_names import rows_by_name
from groma._typing import FloatArray
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.report import AdjustResult
from groma.adjustment.uncertainty import position_sigma, uncertainty
from groma.errors import InputError, ProblemError, given_or_default
from groma.evaluation.alignment import align_poses, camera_centers
from groma.evaluation.poses import evaluate_poses
from groma.scene import Relations, Scene
from groma.scene.checks import check_scene_given

#: Kinds in the order in which they are added.
KINDS = ("points", "lines", "planes and directions", "points on lines")
#: With more images than this the standard deviations are left out (cost: they take memory with the square of the
#: images).
MAX_IMAGES = 300
#: Percentiles of reported distributions over the images (convention: quartiles, and the ends of a box plot).
PERCENTILES = (5, 25, 50, 75, 95)


@dataclass(frozen=True)
class Contribution:
    """An adjustment of everything up to one kind of landmark; residuals in pixels.

    Lengths are in scene units, or in those of the reference where there is one.
    """

    #: The kind that was added last.
    added: str
    #: Adjusted landmarks and relations of all kinds so far, and the relations that the loss gave up.
    num_landmarks: int
    num_relations: int
    num_dropped: int
    #: Root mean square residual of the inliers by kind: see :func:`groma.adjustment.fit.inliers`.
    rmse_px: dict[str, float]
    #: Median distance of the camera centres from those of points alone, after a similarity alignment, and its
    #: percentiles over the images (:data:`PERCENTILES`).
    moved: float
    moved_percentiles: tuple[float, ...]
    #: Median predicted standard deviation of the camera centres, with the first camera and the scale held, because
    #: relations in lengths leave no free scale; None where it is not known.
    center_sigma: float | None
    #: Why it is not known; empty if it is.
    center_sigma_missing: str
    #: How many landmarks are unobservable, by kind, where that is known; they are no harm to the others.
    num_undetermined: dict[str, int]
    #: Against a reference, if there is one: rms error of the camera centres, its percentiles over the images, and mean
    #: error of the rotations.
    center_error: float | None
    center_error_percentiles: tuple[float, ...] | None
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
    """Adjust a scene with points only, then with lines, with planes and directions, and with points on lines.

    Every adjustment starts from the given scene; kinds of landmarks that it does not have are skipped.

    Parameters
    ----------
    scene : Scene
        The scene; not modified.
    options : AdjustOptions, optional
        How to adjust; ``points``, ``lines`` and ``planes`` limit the landmarks used.
    reference : Scene, optional
        The reference scene; images are matched by name.
    progress : callable, optional
        Called with the added kind before each adjustment.

    Returns
    -------
    tuple of Contribution
        One entry for each kind, in the order of :data:`KINDS`.

    Raises
    ------
    InputError
        If the scene has no points to begin with, or no image of the reference.
    """
    check_scene_given(scene)
    options = replace(given_or_default(options, AdjustOptions), check_lens=False)
    if not (options.points and scene.num_point_observations):
        raise InputError(
            "Contributions are relative to a point-only adjustment, but the scene has no points. "
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
    """Return, for each kind in the scene, its name, the scene with the relations so far, and the options."""
    all_of = scene.relations
    with_lines = options.lines and scene.num_line_observations > 0
    with_planes = options.planes and scene.num_planes + scene.num_directions > 0
    steps = [("points", Relations(), False, False)]
    if with_lines:
        steps.append(("lines", Relations(), True, False))
    if with_planes:
        steps.append(("planes and directions", all_of.take(point_on_line=[]), with_lines, True))
    if with_lines and len(all_of.point_on_line):
        steps.append(("points on lines", all_of, True, with_planes))
    return [
        (kind, scene.replace(relations=relations), replace(options, lines=lines, planes=planes))
        for kind, relations, lines, planes in steps
    ]


def _contribution(kind: str, result: AdjustResult, alone: Scene, reference: Scene | None) -> Contribution:
    report, scene = result.report, result.scene
    scores = None if reference is None else evaluate_poses(scene, reference)
    unit = 1.0 if scores is None else scores.alignment.scale
    moved = unit * _distances(scene.cam_from_world, alone.cam_from_world)
    outcomes = report.relations.values()
    sigma, missing, num_undetermined = _center_sigma(result)
    return Contribution(
        added=kind,
        num_landmarks=report.num_points + report.num_lines + report.num_planes,
        num_relations=sum(outcome["held"] + outcome["dropped"] for outcome in outcomes),
        num_dropped=sum(outcome["dropped"] for outcome in outcomes),
        rmse_px={name: told["rmse_px"]["after"] for name, told in report.inliers.items()},
        moved=0.0 if scene is alone else float(np.median(moved)),
        moved_percentiles=_percentiles(0.0 * moved if scene is alone else moved),
        center_sigma=None if sigma is None else unit * sigma,
        center_sigma_missing=missing,
        num_undetermined=num_undetermined,
        center_error=None if scores is None else scores.center_rmse,
        center_error_percentiles=None if reference is None else _percentiles(_errors(scene, reference)),
        rotation_error_deg=None if scores is None else scores.rotation_deg_mean,
        iterations=report.solve.iterations,
        seconds=report.solve.seconds["total"],
    )


def _distances(poses: FloatArray, others: FloatArray) -> FloatArray:
    """Distances (N,) between the camera centres of poses (N, 7), the first aligned to the others by a similarity."""
    aligned = align_poses(poses, others).poses(poses)
    return np.linalg.norm(camera_centers(aligned) - camera_centers(others), axis=1)


def _errors(scene: Scene, reference: Scene) -> FloatArray:
    rows = rows_by_name(reference.images.names, scene.images.names).tolist()
    pairs = [(row, k) for k, row in enumerate(rows) if row >= 0]
    mine, true = np.array(pairs).T
    return _distances(scene.cam_from_world[mine], reference.cam_from_world[true])


def _percentiles(values: FloatArray) -> tuple[float, ...]:
    return tuple(float(value) for value in np.percentile(values, PERCENTILES))


def _center_sigma(result: AdjustResult) -> tuple[float | None, str, dict[str, int]]:
    """Return the median standard deviation of camera centres, or why there is none, and unobservable counts."""
    if result.scene.num_images > MAX_IMAGES:
        return None, f"more than {MAX_IMAGES} images", {}
    try:
        found = uncertainty(result.scene, gauge="held", problem=result.problem)
    except (InputError, ProblemError) as error:
        return None, str(error), {}
    num_undetermined = {name: len(ids) for name, ids in found.undetermined.items() if len(ids)}
    sigma = position_sigma(found.centers)
    known = sigma[np.isfinite(sigma) & (sigma > 0)]
    if not len(known):
        return None, "the poses are held" if (sigma == 0).any() else "no pose is determined", num_undetermined
    return float(np.median(known)), "", num_undetermined
