# SPDX-License-Identifier: BSD-3-Clause
"""What depth maps bring to a map: lines, right angles, poses and the unit of length, with and without.

    python benchmarks/depth.py DATA --scenes cabinet kitchen chair --work FOLDER [--confidence 0.5]

DATA holds ``rgbd_tum_fr3_cabinet`` (a Kinect around a filing cabinet, motion capture), ``rgbd_7scenes_redkitchen``
(a Kinect, poses by fusion of its depths, every fourth frame) and ``nerf_chair`` (rendered, exact cameras; its depths
have 8 bits, steps of 0.031 units). Each is mapped without depth, with metric depth, and with *relative* depth: every
map multiplied by a number of its own between 1/2 and 2, as maps guessed from one photograph are. The cabinet begins at
the model of ``groma demo``, the kitchen at photographs, the chair at points triangulated with the exact cameras, which
the adjustment leaves.

Columns: lines and planes; edges of the cabinet with a line, or lines that leave the chair's silhouette by 3 px in some
view; right angles among planes and directions within 2 degrees, and how far they are off on average; camera centres
after alignment by a similarity, rotations after the turn that suits them best; ``unit`` is the scale of that alignment
(1: the map has the true unit).
"""

import argparse
import json
import shutil
import time
from pathlib import Path

import cv2
import numpy as np

from groma.evaluation import evaluate_poses
from groma.evaluation.cabinet import folder as demo
from groma.evaluation.cabinet import right_angles, score_cabinet
from groma.evaluation.silhouettes import evaluate_silhouettes, read_silhouettes
from groma.geometry import quaternion, se3
from groma.io import read_scene
from groma.io.depth_maps import DepthMaps
from groma.io.sequences import open_sequence
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions
from groma.scene import Cameras, Scene

KINDS = ("none", "metric", "relative")


def cabinet(data: Path, work: Path) -> dict:
    """The scene of the demo, with the depths of the original."""
    source = data / "rgbd_tum_fr3_cabinet" / "depth"
    maps = {path.stem: cv2.imread(str(path), cv2.IMREAD_UNCHANGED) / 5000.0 for path in sorted(source.glob("*.png"))}
    truth = read_scene(demo() / "motion_capture")
    return {"images": demo() / "images", "model": read_scene(demo() / "model"), "truth": truth, "maps": maps}


def kitchen(data: Path, work: Path) -> dict:
    """Every fourth frame, depth moved to the colour camera."""
    sequence = open_sequence(data / "rgbd_7scenes_redkitchen", stride=4)
    reference = sequence.reference
    images, maps, names, poses = work / "kitchen" / "images", {}, [], []
    images.mkdir(parents=True, exist_ok=True)
    world_from_cam = dict(zip(np.round(reference.timestamps, 3), reference.world_from_cam, strict=True))
    for frame in sequence:
        stem = Path(frame.name).name.split(".")[0]
        cv2.imwrite(str(images / f"{stem}.png"), frame.gray)
        maps[stem] = frame.depth
        names.append(f"{stem}.png")
        poses.append(se3.inverse(world_from_cam[np.round(frame.timestamp, 3)]))
    camera = sequence.camera
    cameras = Cameras(np.array([1]), (camera.model,), np.array([camera.params]), [camera.width], [camera.height])
    truth = Scene.from_images(cameras, names, np.zeros(len(names), int), np.array(poses))
    lens = {"camera_model": camera.model, "camera_params": tuple(camera.params)}
    return {"images": images, "model": None, "truth": truth, "maps": maps, "options": lens}


def chair(data: Path, work: Path) -> dict:
    """Rendered; depth along the axis is close to 7.893 - 0.0309 v of the 8-bit files."""
    source = data / "nerf_chair"
    raw = {path.stem: cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., 0] for path in (source / "depth").glob("*.png")}
    maps = {stem: np.where(v > 0, 7.893 - 0.0309 * v, 0.0) for stem, v in raw.items()}
    truth = read_scene(source / "sparse_gt")
    masks = read_silhouettes(source / "silhouette", truth.images.names)
    return {"images": source / "images", "model": truth, "truth": truth, "maps": maps, "masks": masks}


SCENES = {"cabinet": cabinet, "kitchen": kitchen, "chair": chair}


def depth_of(maps: dict, kind: str, folder: Path) -> DepthMaps | None:
    """Write the maps as they are, or each in a unit of its own."""
    if kind == "none":
        return None
    folder.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(1)
    for stem, depth in sorted(maps.items()):
        unit = 2.0 ** rng.uniform(-1.0, 1.0) if kind == "relative" else 1.0
        np.save(folder / f"{stem}.npy", (unit * depth).astype(np.float32))
    return DepthMaps(folder, 1.0, kind == "relative")


def turned_deg(scene: Scene, truth: Scene) -> np.ndarray:
    """Angles between the rotations of cameras and the true ones, after the turn of the world that suits them best."""
    row = {name: i for i, name in enumerate(truth.images.names)}
    first = quaternion.to_matrix(scene.cam_from_world[:, :4])
    second = quaternion.to_matrix(truth.cam_from_world[[row[name] for name in scene.images.names], :4])
    U, _, Vt = np.linalg.svd(np.einsum("nij,nik->jk", first, second))
    turn = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    cosine = 0.5 * (np.einsum("nij,jk,nik->n", first, turn, second) - 1.0)
    return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))


def row_of(name: str, kind: str, given: dict, work: Path, confidence: float) -> dict:
    """Map a scene and compare it."""
    options = MapOptions(min_confidence=confidence, threads=1, **given.get("options", {}))
    depth = depth_of(given["maps"], kind, work / name / kind)
    begun = time.process_time()
    shutil.rmtree(work / name / f"{kind}.work", ignore_errors=True)
    result = map_images(given["images"], work / name / f"{kind}.work", given["model"], options, depth=depth)
    seconds = time.process_time() - begun
    scene, scores = result.scene, evaluate_poses(result.scene, given["truth"])
    turns = turned_deg(scene, given["truth"])
    angles = np.abs(np.array(right_angles(scene)) - 90.0)
    row = {
        "scene": name, "depth": kind, "images": scene.num_images, "points": scene.num_points,
        "lines": scene.num_lines, "planes": scene.num_planes, "right_angles": len(angles),
        "off_deg": float(angles.mean()) if len(angles) else None, "centre_mm": 1000.0 * scores.center_rmse,
        "rotation_deg": float(turns.mean()), "worst_deg": float(turns.max()),
        "unit": scores.alignment.scale, "cpu_s": seconds, "warnings": list(result.warnings),
    }  # fmt: skip
    if name == "cabinet":
        found = score_cabinet(scene, scores.alignment)
        row |= {"edges": found["num_edges"], "edge_mm": 1000.0 * found["distance"]}
    if "masks" in given:
        moved = given["truth"].keep(points=[]).replace(lines=scene.transformed(scores.alignment).lines)
        row["outside_3px"] = evaluate_silhouettes(moved, given["masks"]).to_dict()["outside_px"]["3"]
    if result.depths is not None:
        row["found"] = result.depths.to_dict()
    return row


def markdown(rows: list[dict]) -> str:
    """The table of the evidence page."""
    head = ["scene", "depth", "lines", "on edges / outside", "planes", "right angles", "off, degrees", "centres, mm",
            "rotation, degrees", "unit", "CPU, s"]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for row in rows:
        extra = f"{row['edges']} of 12" if "edges" in row else str(row.get("outside_3px", ""))
        off = "" if row["off_deg"] is None else f"{row['off_deg']:.2f}"
        figures = (f"{row['centre_mm']:.1f}", f"{row['rotation_deg']:.3f}", f"{row['unit']:.4f}", f"{row['cpu_s']:.0f}")
        cells = (row["scene"], row["depth"], row["lines"], extra, row["planes"], row["right_angles"], off, *figures)
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=list(SCENES))
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--work", type=Path, required=True)
    parser.add_argument("--confidence", type=float, default=0.5)
    parser.add_argument("--json", type=Path)
    told = parser.parse_args()
    rows = []
    for name in told.scenes:
        given = SCENES[name](told.data, told.work)
        for kind in told.kinds:
            rows.append(row_of(name, kind, given, told.work, told.confidence))
            print(json.dumps(rows[-1]), flush=True)
    print(markdown(rows))
    if told.json is not None:
        told.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
