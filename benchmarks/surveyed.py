# SPDX-License-Identifier: BSD-3-Clause
"""Camera poses against a survey, and what points, lines and planes bring.

    python benchmarks/surveyed.py SCENE ...
    python benchmarks/surveyed.py SCENE ... --scales 1 3 5 7

SCENE is a folder with ``images/``, a start ``sparse_inc/`` and the survey ``sparse_gt/``, both COLMAP models. Each
scene is mapped once with the defaults of ``groma map``; its last adjustment is then repeated from the same start with
points alone, with lines, and with lines and planes. *Squares* is plain least squares of the points.

Two more columns say how far the comparison can be believed. *Predicted* is the standard deviation of the camera centres
after adjusting the points, as photographs with such noise would give it. *Misfit* is how much worse the surveyed poses
fit the photographs than the adjusted ones do: twice the difference of the robust costs of the points, over the degrees
of freedom of the poses. Perfect poses would give about one. Where it is hundreds, survey and photographs, with this
calibration, contradict each other, and no adjustment of these photographs could come as near to the survey as its own
noise would allow.

With ``--scales`` the last adjustment, of everything, is repeated with these scales of the first loss, in standard
deviations of the noise, instead.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

import groma
from groma.evaluation import evaluate_poses
from groma.evaluation.alignment import align_points
from groma.pipelines.map import MapOptions, MapResult, map_images
from groma.pipelines.uncertainty import position_sigma, uncertainty
from groma.scene import Scene

KINDS = {
    "points": {"lines": False, "planes": False},
    "+ lines": {"planes": False},
    "+ planes": {},
}
#: Scale of the one loss under which costs are compared, in standard deviations.
MISFIT_LOSS = 3.0


def scores(scene: Scene, survey: Scene) -> str:
    """Root mean square and largest distance of the centres (thousandths of a unit), and mean rotation, degrees."""
    found = evaluate_poses(scene, survey)
    return f"{1e3 * found.center_rmse:.2f} / {1e3 * found.center_max:.1f} / {found.rotation_deg_mean:.3f}"


def misfit(scene: Scene, survey: Scene, sigma_px: float) -> tuple[float, float]:
    """Predicted deviation of the centres (survey units) and excess of the cost at the surveyed poses per freedom."""
    alone = {"lines": False, "planes": False, "point_sigma_px": sigma_px, "loss": "cauchy", "loss_scale": MISFIT_LOSS}
    free = groma.adjust(scene, groma.AdjustOptions(**alone))
    row = {name: k for k, name in enumerate(survey.images.names)}
    at = [row[name] for name in scene.images.names]
    survey_from_scene = align_points(free.scene.cam_centers_in_world, survey.cam_centers_in_world[at])
    predicted = position_sigma(uncertainty(free.scene, problem=free.problem).centers)
    placed = free.scene.transformed(survey_from_scene).with_poses(survey.cam_from_world[at])
    held = groma.adjust(placed, groma.AdjustOptions(**alone, refine_poses=False))
    freedom = 6 * scene.num_images - 7
    excess = 2.0 * (held.report.solve.final_cost - free.report.solve.final_cost) / freedom
    return survey_from_scene.scale * float(np.sqrt(np.mean(predicted**2))), excess


def tell_kinds(folder: Path, start: Scene, survey: Scene, result: MapResult) -> None:
    """Print a row: the start, plain least squares, and what each kind of landmark brings."""
    squares = groma.adjust(start, groma.AdjustOptions(loss="none", lines=False, planes=False)).scene
    cells = [scores(start, survey), scores(squares, survey)]
    for kinds in KINDS.values():
        options = replace(result.adjusted_with, **kinds)
        cells.append(scores(groma.adjust(result.before, options).scene, survey))
    predicted, excess = misfit(result.before, survey, result.sigma_px["points"])
    print(f"| {folder.name} | " + " | ".join(cells) + f" | {1e3 * predicted:.2f} | {excess:.0f} |", flush=True)


def tell_scales(folder: Path, survey: Scene, result: MapResult, scales: list[float]) -> None:
    """Print a row: the centres' error for each scale of the first loss."""
    cells = []
    for scale in scales:
        found = groma.adjust(result.before, replace(result.adjusted_with, loss_scale=scale))
        cells.append(f"{1e3 * evaluate_poses(found.scene, survey).center_rmse:.2f}")
    print(f"| {folder.name} | " + " | ".join(cells) + " |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+", type=Path)
    parser.add_argument("--scales", nargs="+", type=float, metavar="S", help="scales of the first loss to compare")
    arguments = parser.parse_args()
    print("centres: rms / largest, thousandths of the survey's unit; rotations: mean, degrees\n")
    columns = ["start", "squares", *KINDS, "predicted", "misfit"]
    if arguments.scales:
        columns = [f"{scale:g}" for scale in arguments.scales]
    print("| scene | " + " | ".join(columns) + " |\n|---|" + "--:|" * len(columns))
    for folder in arguments.scenes:
        start, survey = groma.read_scene(folder / "sparse_inc"), groma.read_scene(folder / "sparse_gt")
        with tempfile.TemporaryDirectory() as work:
            result = map_images(folder / "images", work, start, MapOptions())
        if arguments.scales:
            tell_scales(folder, survey, result, arguments.scales)
        else:
            tell_kinds(folder, start, survey, result)


if __name__ == "__main__":
    main()
