# SPDX-License-Identifier: BSD-3-Clause
"""Localised photographs against the truth, beside the peers on the same matches.

    python benchmarks/localize.py stairs DATA                     one query with given matches, 20 seeds, and peers;
                                                                  and what other features of it say
    python benchmarks/localize.py held-out MAP IMAGES TRUTH       photographs that are not in a map

``DATA`` is ``localization_stairs/query_1.npz``; ``TRUTH`` a scene with the poses of all photographs in ``IMAGES``. Maps
whose world is not that of the truth are aligned by the poses of their own images (``--align``). Photographs are
placed by points alone, and with lines. Times are process times; those beside features are by the wall clock.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import cv2
import numpy as np

from groma.geometry import quaternion, se3, so3
from groma.io import read_scene
from groma.localization.features import find_features
from groma.localization.line_matching import SeenLines, lines_near
from groma.localization.localizer import LocalizeOptions, Localizer
from groma.localization.pose.absolute_pose import PoseOptions, estimate_absolute_pose
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.matches import Matches
from groma.localization.pose.refinement import refine

#: Shares of queries within these distances (metres) and angles (degrees) are told.
LIMITS = ((0.01, 1.0), (0.02, 2.0), (0.05, 5.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("stairs").add_argument("data", type=Path)
    held_of = commands.add_parser("held-out")
    held_of.add_argument("map", type=Path)
    held_of.add_argument("images", type=Path)
    held_of.add_argument("truth", type=Path)
    held_of.add_argument("--align", action="store_true")
    held_of.add_argument("--every", type=int, default=1, help="take every N-th query")
    given = parser.parse_args()
    if given.command == "stairs":
        told = stairs(given.data)
    else:
        told = held_out(given.map, given.images, given.truth, given.align, given.every)
    print(json.dumps(told, indent=1))


# ----------------------------------------------------------------------------------------------------------- stairs


def stairs(path: Path, seeds: int = 20) -> dict[str, object]:
    """Median errors (cm, degrees) over seeds, and seconds, of groma and of peers on the same matches."""
    data = np.load(path)
    width, height = map(int, data["size"])
    camera = QueryCamera(str(data["camera_model"]), data["camera_params"], width, height)
    lines = data["match_segment2d"], data["map_lines3d"][data["match_line3d"]]
    points = data["points2d"], data["points3d"]
    true = np.concatenate([data["qvec_true"][[1, 2, 3, 0]], data["tvec_true"]])

    def ours(seed: int, *more: np.ndarray) -> np.ndarray | None:
        return estimate_absolute_pose(camera, *points, *more, options=PoseOptions(seed=seed)).cam_from_world

    told: dict[str, object] = {}
    every = []
    for name, method in (
        ("groma, points", ours),
        ("groma, points and lines", lambda seed: ours(seed, *lines)),
        ("PoseLib, points", lambda seed: _poselib(camera, points, None, seed)),
        ("PoseLib, points and lines", lambda seed: _poselib(camera, points, lines, seed)),
        ("pycolmap, points", lambda seed: _pycolmap(camera, points, seed)),
    ):
        method(0)
        start = time.process_time()
        poses = [method(seed + 1) for seed in range(seeds)]
        seconds = (time.process_time() - start) / seeds
        errors = np.array([_errors(pose, true) for pose in poses if pose is not None])
        every.append([pose for pose in poses if pose is not None][np.argsort(errors[:, 0])[len(errors) // 2]])
        told[name] = {
            "cm": 100 * float(np.median(errors[:, 0])),
            "deg": float(np.median(errors[:, 1])),
            "seconds": seconds,
        }
    found = estimate_absolute_pose(camera, *points, *lines)
    assert found.cam_from_world is not None and found.covariance is not None and found.center_sigma is not None
    told["stated cm"] = 100 * float(np.linalg.norm(found.center_sigma))
    told["stated deg"] = found.rotation_sigma_deg
    told["verdict"] = f"{found.status}: {found.sentence}"
    difference = se3.log(se3.compose(true[None], se3.inverse(found.cam_from_world[None])))[0]
    told["squared error, six degrees"] = float(difference @ np.linalg.solve(found.covariance, difference))
    told["farthest pose of the others: cm, deg"] = _told(max(_errors(pose, found.cam_from_world) for pose in every))
    gray = cv2.cvtColor(data["image_rgb"], cv2.COLOR_RGB2GRAY)
    for name, start in (("the truth", true), ("the pose", found.cam_from_world)):
        agree, pose = _by_all_lines(camera, gray, data["map_lines3d"], start)
        told[f"segments of the photograph and all lines of the map, from {name}"] = {
            "segments that agree": agree,
            "cm, deg from the truth": _told(_errors(pose, true)),
            "cm, deg from the pose": _told(_errors(pose, found.cam_from_world)),
        }
    return told


def _told(errors: tuple[float, float]) -> tuple[float, float]:
    return 100.0 * errors[0], errors[1]


def _by_all_lines(camera, gray, lines, pose, reach=12.0, rounds=6) -> tuple[int, np.ndarray]:
    """A pose by segments found anew: of all lines of the map any that is within so many pixels may be theirs."""
    found = find_features(gray, camera, True, 15.0).segments
    alike = np.ones((len(lines), 1), np.float32)  # no descriptors: place and direction decide
    seen = SeenLines(np.arange(len(lines)), alike, lines)
    agree = 0
    for _ in range(rounds):
        line, segment = lines_near(camera, pose, seen, found, alike[: len(found)], reach).T
        matches = Matches(segments2d=found.ends.reshape(-1, 2, 2)[segment], segments3d=lines[line]).with_sigma(1.0)
        fit = refine(camera, matches, pose, (reach, reach))
        agree, pose = int(fit.line_inliers.sum()), fit.pose
    return agree, pose


def _poselib(camera, points, lines, seed):
    import poselib

    K = {"model": camera.model, "width": camera.width, "height": camera.height, "params": camera.params.tolist()}
    options = {"max_reproj_error": 6.8, "max_epipolar_error": 6.8, "seed": seed}
    points2d, points3d = points
    if lines is None:
        found, _ = poselib.estimate_absolute_pose(points2d, points3d, K, options, {})
    else:
        ends, ends3d = lines
        found, _ = poselib.estimate_absolute_pose_pnpl(
            points2d, points3d, ends[:, 0], ends[:, 1], ends3d[:, 0], ends3d[:, 1], K, options, {}
        )
    return np.concatenate([found.q[[1, 2, 3, 0]], found.t])


def _pycolmap(camera, points, seed):
    import pycolmap

    pycolmap.set_random_seed(seed)
    K = pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=camera.params.tolist())
    points2d, points3d = points
    found = pycolmap.estimate_and_refine_absolute_pose(points2d, points3d, K)
    if found is None:
        return None
    pose = found["cam_from_world"]
    return np.concatenate([pose.rotation.quat, pose.translation])


def _errors(pose: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Distance of the centres, and angle in degrees."""
    R, R_true = (quaternion.to_matrix(one[None, :4])[0] for one in (pose, true))
    shift = -R.T @ pose[4:] + R_true.T @ true[4:]
    return float(np.linalg.norm(shift)), float(np.rad2deg(np.linalg.norm(so3.log((R @ R_true.T)[None])[0])))


# --------------------------------------------------------------------------------------------------------- held out


def held_out(map_: Path, images: Path, truth: Path, align: bool, every: int = 1) -> dict[str, object]:
    """Errors of the photographs that a map does not have."""
    true = read_scene(truth)
    poses = dict(zip(true.images.names, true.cam_from_world, strict=True))
    told: dict[str, object] = {}
    for name, lines in (("points", False), ("points and lines", True)):
        localizer = Localizer(map_, images, options=LocalizeOptions(lines=lines))
        known = localizer.scene
        moved = _alignment(known, poses) if align else np.eye(4)
        names = sorted(set(poses) - set(known.images.names))[::every]
        rows = []
        for query in names:
            path = next(path for path in (images / query, *images.rglob(Path(query).name)) if path.is_file())
            start = time.process_time()
            found = localizer.localize(path)
            seconds = time.process_time() - start
            covariance = found.pose.covariance
            if found.pose.cam_from_world is None or found.pose.center_sigma is None or covariance is None:
                rows.append((query, found.pose.status, None, None, None, None, seconds, found.seconds))
                continue
            pose = se3.from_matrix(se3.to_matrix(found.pose.cam_from_world) @ np.linalg.inv(moved))
            sigma = float(np.linalg.norm(found.pose.center_sigma))
            way = se3.log(se3.compose(poses[query][None], se3.inverse(pose[None])))[0]
            square = float(way @ np.linalg.solve(covariance, way)) / 6.0
            rows.append((query, found.pose.status, *_errors(pose, poses[query]), sigma, square, seconds, found.seconds))
        told[name] = _summary(rows)
    return told


def _summary(rows: list[tuple]) -> dict[str, object]:
    right = np.array([row[2:6] for row in rows if row[1] == "localized"], float).reshape(-1, 4)
    within = {
        f"{100 * far:g} cm, {angle:g} deg": float(((right[:, 0] <= far) & (right[:, 1] <= angle)).sum() / len(rows))
        for far, angle in LIMITS
    }
    told: dict[str, object] = {"queries": len(rows), "localized": len(right), "shares": within}
    if len(right):
        told |= {
            "median m": float(np.median(right[:, 0])), "worst m": float(right[:, 0].max()),
            "median deg": float(np.median(right[:, 1])), "worst deg": float(right[:, 1].max()),
            "median error over stated": float(np.median(right[:, 0] / right[:, 2])),
            "mean squared error over stated, of six degrees": float(right[:, 3].mean()),
        }  # fmt: skip
    told["process seconds"] = float(np.median([row[6] for row in rows]))
    told["milliseconds beside features"] = float(1e3 * np.median([row[7] for row in rows]))
    told["each"] = [[row[0], row[1], *(None if x is None else round(x, 4) for x in row[2:6])] for row in rows]
    return told


def _alignment(scene, poses: dict[str, np.ndarray]) -> np.ndarray:
    """The motion (4, 4) from the world of a map to that of the truth: mean turn, mean shift."""
    true = np.linalg.inv(se3.to_matrix(np.array([poses[name] for name in scene.images.names])))
    U, _, Vt = np.linalg.svd((true @ se3.to_matrix(scene.cam_from_world))[:, :3, :3].sum(axis=0))
    moved = np.eye(4)
    moved[:3, :3] = U @ Vt
    moved[:3, 3] = (true[:, :3, 3] - scene.cam_centers_in_world @ moved[:3, :3].T).mean(axis=0)
    return moved


if __name__ == "__main__":
    main()
