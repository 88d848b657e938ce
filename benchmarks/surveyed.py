# SPDX-License-Identifier: BSD-3-Clause
"""Camera poses against a survey, and what points, lines and planes bring.

    python benchmarks/surveyed.py SCENE ...
    python benchmarks/surveyed.py SCENE ... --scales 1 3 5 7
    python benchmarks/surveyed.py SCENE ... --subsets 10
    python benchmarks/surveyed.py SCENE ... --limits
    python benchmarks/surveyed.py SCENE ... --noise --rendered 1 2 3
    python benchmarks/surveyed.py SCENE ... --deviations --rendered 1 2 3

SCENE is a folder with ``images/``, a start ``sparse_inc/`` and the survey ``sparse_gt/``, both COLMAP models. Each
scene is mapped once with the defaults of ``groma map``; its last adjustment is then repeated from the same start with
points alone, with lines, and with lines and planes. *Squares* is plain least squares of the points.

Two more columns say how far the comparison can be believed. *Predicted* is the standard deviation of the camera centres
after adjusting points, and points and lines, as photographs with such noise would give it. *Misfit* is how much worse
the surveyed poses fit the photographs than the adjusted ones do: twice the difference of the robust costs of the
points, over the degrees of freedom of the poses. Perfect poses would give about one. Where it is hundreds, survey and
photographs, with this calibration, contradict each other, and no adjustment of these photographs could come as near to
the survey as its own noise would allow.

With ``--scales`` the last adjustment, of everything, is repeated with these scales of its loss, in standard deviations
of the noise, instead.

With ``--subsets`` the last adjustment is repeated for so many random choices of half of the images or more, all
connected; scenes of fewer than ten images are left out one image at a time. Means over the choices, and in how many
lines, and planes in addition, brought the centres nearer. With ``--draws`` it is repeated for so many draws of 70 % of
the landmarks: mean and standard deviation of the errors of the centres and of the largest of a rotation, degrees, and
of their difference with and without lines in the same draw.

With ``--limits`` a row says how near the survey these photographs can come at all:

- *one among surveyed*: each camera in turn is placed by its photograph while all others stay at their surveyed poses;
  how far that is from its own surveyed place, root mean square and largest, and whose;
- *at 2, 3, 5 sigma*: the least root mean square of the centres of any result that fits points and lines worse by 4, 9
  and 25 in twice the logarithm of the likelihood;
- *calibrated*: the centres by points with focal lengths, principal point and distortion estimated; the distortion; and
  what that gains in twice the logarithm of the likelihood;
- *tails*: degrees of freedom of Student's distribution of the points' residuals, with one noise for all points and with
  each point's own.

With ``--noise`` the last adjustment is repeated with one noise for all points, with each point's own, and with that and
the errors that neighbours share, by points and by everything. ``--rendered`` adds rooms of boxes, rendered with these
seeds and reconstructed from the pictures, whose cameras are known exactly.

With ``--deviations`` the errors of the centres stand beside their standard deviations, as they follow from the noise,
and by leaving out one landmark after the other, as ``groma map`` states them; a scene without ``sparse_inc`` starts at
``sparse_gt``.
"""

import argparse
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from _rendered_boxes import BoxSettings, render_boxes
from _survey_limits import calibrated, nearest_at, one_among_surveyed, tail_freedom
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

import groma
from groma.adjustment.misfit.jackknife import landmark_jackknife, observations_alone
from groma.adjustment.uncertainty import position_sigma, uncertainty
from groma.evaluation import evaluate_poses
from groma.evaluation.alignment import align_points
from groma.mapping.map import MapResult, map_images
from groma.mapping.noise.observations import noise_px, with_point_noise
from groma.mapping.options import MapOptions
from groma.mapping.unused import without_unused
from groma.scene import Relations, Scene
from groma.solver.covariance.marginals import Covariances

KINDS = {"points": {"lines": False, "planes": False}, "+ lines": {"planes": False}, "+ planes": {}}
NOISES = [f"{kind}, {noise}" for kind in ("points", "all") for noise in ("one noise", "own", "own and shared")]
SUBSETS = [*KINDS, "lines help", "planes help"]
#: Points that an image of a subset shares with another at least, and images a scene needs for random subsets.
SHARED_POINTS, MANY_IMAGES = 60, 10
#: Centres: error, then stated deviations and those by leaving out landmarks, each root mean square and median.
DEVIATIONS = ["error", "stated", "by landmarks", "errors in deviations: stated", "by landmarks"]
#: Share of the landmarks in a draw; columns.
DRAWN = 0.7
DRAWS = ["points", "+ lines", "points, 70 % of the lines", "70 % of both", "70 % of the points alone", "lines bring"]
LIMITS = ["one among surveyed", "at 2, 3, 5 sigma", "calibrated", "k1, k2", "gain", "tails"]
#: Scale of the one loss under which costs are compared, in standard deviations.
MISFIT_LOSS = 3.0


def scores(scene: Scene, survey: Scene) -> str:
    """Root mean square and largest distance of the centres (thousandths of a unit), and mean rotation, degrees."""
    found = evaluate_poses(scene, survey)
    return f"{1e3 * found.center_rmse:.2f} / {1e3 * found.center_max:.1f} / {found.rotation_deg_mean:.3f}"


def predicted(scene: Scene, survey: Scene, options: groma.AdjustOptions) -> float:
    """Standard deviation of the centres (survey units) that the covariance of an adjustment tells."""
    found = groma.adjust(scene, options)
    sigma = position_sigma(uncertainty(found.scene, problem=found.problem).centers)
    return evaluate_poses(found.scene, survey).alignment.scale * float(np.sqrt(np.mean(sigma**2)))


def misfit(scene: Scene, survey: Scene, sigma_px: float) -> float:
    """Excess of the cost at the surveyed poses per freedom."""
    alone = {"lines": False, "planes": False, "point_sigma_px": sigma_px, "loss": "cauchy", "loss_scale": MISFIT_LOSS}
    free = groma.adjust(scene, groma.AdjustOptions(**alone))
    row = {name: k for k, name in enumerate(survey.images.names)}
    at = [row[name] for name in scene.images.names]
    survey_from_scene = align_points(free.scene.cam_centers_in_world, survey.cam_centers_in_world[at])
    placed = free.scene.transformed(survey_from_scene).with_poses(survey.cam_from_world[at])
    held = groma.adjust(placed, groma.AdjustOptions(**alone, refine_poses=False))
    freedom = 6 * scene.num_images - 7
    return 2.0 * (held.report.solve.final_cost - free.report.solve.final_cost) / freedom


def tell_kinds(folder: Path, start: Scene, survey: Scene, result: MapResult) -> None:
    """Print a row: the start, plain least squares, and what each kind of landmark brings."""
    squares = groma.adjust(start, groma.AdjustOptions(loss="none", lines=False, planes=False)).scene
    cells = [scores(start, survey), scores(squares, survey)]
    for kinds in KINDS.values():
        options = replace(result.adjusted_with, **kinds)
        cells.append(scores(groma.adjust(result.before, options).scene, survey))
    scene = result.before.replace(relations=Relations())
    told = [
        f"{1e3 * predicted(scene, survey, replace(result.adjusted_with, **kinds)):.2f}"
        for kinds in (KINDS["points"], KINDS["+ lines"])
    ]
    excess = misfit(result.before, survey, result.sigma_px["points"])
    print(f"| {folder.name} | " + " | ".join(cells) + f" | {' / '.join(told)} | {excess:.0f} |", flush=True)


def tell_scales(folder: Path, survey: Scene, result: MapResult, scales: list[float]) -> None:
    """Print a row: the centres' error for each scale of the last loss."""
    cells = []
    for scale in scales:
        found = groma.adjust(result.before, replace(result.adjusted_with, loss_scale=scale))
        cells.append(f"{1e3 * evaluate_poses(found.scene, survey).center_rmse:.2f}")
    print(f"| {folder.name} | " + " | ".join(cells) + " |", flush=True)


def tell_noise(name: str, survey: Scene, result: MapResult) -> None:
    """Print a row: the centres with one noise for all points, with each point's own, and with shared errors too."""
    one, cells = with_one_noise(result.before), []
    own = one.replace(point_observations=with_point_noise(with_one_noise(result.scene)).point_observations)
    plain = replace(result.adjusted_with, point_sigma_px=noise_px(with_one_noise(result.scene), "points"))
    weighings = ((one, plain), (own, result.adjusted_with), (result.before, result.adjusted_with))
    for kinds in (KINDS["points"], KINDS["+ planes"]):
        cells += [scores(groma.adjust(scene, replace(options, **kinds)).scene, survey) for scene, options in weighings]
    print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def tell_subsets(folder: Path, survey: Scene, result: MapResult, count: int) -> None:
    """Print a row: the centres' error over subsets of the images, and how often lines and planes help."""
    found = []
    for images in subsets(result.before, count):
        scene = without_unused(result.before.subset(images, min_observations=2))[0]
        options = [replace(result.adjusted_with, **kinds) for kinds in KINDS.values()]
        found.append([evaluate_poses(groma.adjust(scene, one).scene, survey).center_rmse for one in options])
    table = 1e3 * np.array(found)
    better = [int((table[:, k + 1] < table[:, k]).sum()) for k in (0, 1)]
    cells = [*(f"{mean:.2f}" for mean in table.mean(axis=0)), *(f"{wins} of {len(table)}" for wins in better)]
    print(f"| {folder.name} | " + " | ".join(cells) + " |", flush=True)


def tell_draws(folder: Path, survey: Scene, result: MapResult, count: int) -> None:
    """Print a row: errors with all landmarks, and their mean and deviation over draws of most of them."""
    scene, options = result.before.replace(relations=Relations()), replace(result.adjusted_with, planes=False)

    def errors(scene: Scene, **kinds: bool) -> tuple[float, float]:
        found = evaluate_poses(groma.adjust(scene, replace(options, **kinds)).scene, survey)
        return 1e3 * found.center_rmse, found.rotation_deg_max

    rng, rows = np.random.default_rng(0), []
    for _ in range(count):
        lines, points = rng.random(scene.num_lines) < DRAWN, rng.random(scene.num_points) < DRAWN
        fewer = scene.keep(points=points)
        rows.append([errors(scene.keep(lines=lines)), errors(fewer.keep(lines=lines)), errors(fewer, lines=False)])
    table = np.array(rows)
    table = np.concatenate([table, table[:, 1:2] - table[:, 2:]], axis=1)
    mean, spread = table.mean(axis=0), table.std(axis=0, ddof=1)
    whole = [errors(scene, lines=False), errors(scene)]
    for name, digits, k in (("centres", 2, 0), ("largest rotation", 3, 1)):
        cells = [f"{one[k]:.{digits}f}" for one in whole]
        cells += [f"{m[k]:.{digits}f} ± {s[k]:.{digits}f}" for m, s in zip(mean, spread, strict=True)]
        print(f"| {folder.name}, {name} | " + " | ".join(cells) + " |", flush=True)


def subsets(scene: Scene, count: int) -> list[np.ndarray]:
    """Images of random subsets in which all are connected by common points; of few images, all but one."""
    every = np.arange(scene.num_images)
    if len(every) < MANY_IMAGES:
        return [np.delete(every, k) for k in every]
    table, rng = scene.point_observations, np.random.default_rng(0)
    seen = csr_array((np.ones(len(table)), (table.image_idx, table.point_idx)), (len(every), scene.num_points))
    common = (seen @ seen.T).toarray() >= SHARED_POINTS
    found: list[np.ndarray] = []
    for _ in range(1000 * count):
        size = int(rng.integers((len(every) + 1) // 2, 2 * len(every) // 3 + 1))
        chosen = np.sort(rng.permutation(len(every))[:size])
        if connected_components(common[np.ix_(chosen, chosen)])[0] == 1:
            found.append(chosen)
        if len(found) == count:
            break
    return found


def tell_deviations(name: str, truth: Scene, result: MapResult) -> None:
    """Print a row: errors of the centres and their deviations (thousandths), stated and by leaving out landmarks."""
    found = groma.adjust(result.before, replace(result.adjusted_with, gauge="free"))
    problem, scores = found.problem, evaluate_poses(found.scene, truth)
    assert problem is not None
    alone = Covariances(observations_alone(problem), "inner", datum={"frames": [1, 1, 1, 0, 0, 0]})
    row = {image: k for k, image in enumerate(truth.images.names)}
    true = truth.cam_centers_in_world[[row[image] for image in found.scene.images.names]]
    errors = np.linalg.norm(found.scene.transformed(scores.alignment).cam_centers_in_world - true, axis=1)
    sigmas = [
        scores.alignment.scale * position_sigma(one[found.scene.images.frame_idx, :3, :3])
        for one in landmark_jackknife(alone)
    ]
    cells = [f"{1e3 * np.sqrt(np.mean(x**2)):.2f} / {1e3 * np.median(x):.2f}" for x in (errors, *sigmas)]
    cells += [f"{np.sqrt(np.mean((errors / sigma) ** 2)):.2f}" for sigma in sigmas]
    print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def tell_rendered(seed: int, tell: Callable[[str, Scene, MapResult], None], options: MapOptions) -> None:
    """Print a row for a rendered room of boxes, whose cameras are known exactly."""
    settings = BoxSettings(seed=seed, num_images=30, num_boxes=10, texture=25.0, blotches=400, noise=3.0)
    room = render_boxes(settings)
    camera = (settings.focal, settings.focal, settings.width / 2, settings.height / 2)
    with tempfile.TemporaryDirectory() as work:
        images = Path(work) / "images"
        images.mkdir()
        for name, image in zip(room.scene.images.names, room.images, strict=True):
            cv2.imwrite(str(images / name), image)
        result = map_images(
            images, Path(work) / "map", None, replace(options, camera_model="PINHOLE", camera_params=camera)
        )
    tell(f"boxes {seed}", room.scene, result)


def tell_limits(folder: Path, survey: Scene, result: MapResult) -> None:
    """Print a row: how near the survey these photographs can come."""
    row = {name: k for k, name in enumerate(survey.images.names)}
    at = [row[name] for name in result.before.images.names]
    centers, poses = survey.cam_centers_in_world[at], survey.cam_from_world[at]
    options = replace(result.adjusted_with, planes=False)
    scene = groma.adjust(result.before.replace(relations=Relations()), options).scene
    scene = scene.transformed(align_points(scene.cam_centers_in_world, centers))
    away = one_among_surveyed(scene.with_poses(poses), replace(options, lines=False))
    worst = scene.images.names[int(np.argmax(away))]
    alone = f"{1e3 * np.sqrt(np.mean(away**2)):.2f} / {1e3 * away.max():.1f} ({worst})"
    bought = " / ".join(f"{1e3 * rms:.2f}" for rms in nearest_at(scene, centers, options))
    found, gain = calibrated(scene, replace(options, lines=False))
    k1, k2 = found.cameras.params[0, 4:6]
    tails = " / ".join(f"{tail_freedom(one):.1f}" for one in (with_one_noise(result.scene), result.scene))
    cells = [alone, bought, scores(found, survey), f"{k1:.4f}, {k2:.4f}", f"{gain:.0f}", tails]
    print(f"| {folder.name} | " + " | ".join(cells) + " |", flush=True)


def with_one_noise(scene: Scene) -> Scene:
    """The scene with all observations of points equally good."""
    table = scene.point_observations
    return scene.replace(point_observations=table.replace(sigma=np.ones(len(table))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="*", type=Path)
    parser.add_argument("--scales", nargs="+", type=float, metavar="S", help="scales of the last loss to compare")
    parser.add_argument("--subsets", type=int, metavar="N", help="the same over so many subsets of the images")
    parser.add_argument("--draws", type=int, metavar="N", help="the same over so many draws of the landmarks")
    parser.add_argument("--limits", action="store_true", help="how near the survey these photographs can come")
    parser.add_argument("--noise", action="store_true", help="one noise for all, each point's own, shared errors")
    parser.add_argument("--deviations", action="store_true", help="errors against the deviations that maps state")
    parser.add_argument("--rendered", nargs="+", type=int, metavar="SEED", default=[], help="rooms of boxes too")
    arguments = parser.parse_args()
    print("centres: rms / largest, thousandths of the survey's unit; rotations: mean, degrees\n")
    columns = ["start", "squares", *KINDS, "predicted", "misfit"]
    if arguments.scales:
        columns = [f"{scale:g}" for scale in arguments.scales]
    if arguments.subsets:
        columns = SUBSETS
    if arguments.draws:
        columns = DRAWS
    if arguments.limits:
        columns = LIMITS
    if arguments.noise or arguments.rendered:
        columns = NOISES
    if arguments.deviations:
        columns = DEVIATIONS
    # All lines take part in the adjustment; the improbable ones are left out after it.
    options = MapOptions(min_confidence=0.0)
    tell = tell_deviations if arguments.deviations else tell_noise
    print("| scene | " + " | ".join(columns) + " |\n|---|" + "--:|" * len(columns))
    for folder in arguments.scenes:
        survey = groma.read_scene(folder / "sparse_gt")
        start = groma.read_scene(folder / "sparse_inc") if (folder / "sparse_inc").is_dir() else survey
        with tempfile.TemporaryDirectory() as work:
            result = map_images(folder / "images", work, start, options)
        if arguments.scales:
            tell_scales(folder, survey, result, arguments.scales)
        elif arguments.draws:
            tell_draws(folder, survey, result, arguments.draws)
        elif arguments.subsets:
            tell_subsets(folder, survey, result, arguments.subsets)
        elif arguments.deviations or arguments.noise or arguments.rendered:
            tell(folder.name, survey, result)
        elif arguments.limits:
            tell_limits(folder, survey, result)
        else:
            tell_kinds(folder, start, survey, result)
    for seed in arguments.rendered:
        tell_rendered(seed, tell, options)


if __name__ == "__main__":
    main()
