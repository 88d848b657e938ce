# SPDX-License-Identifier: BSD-3-Clause
"""How the time and the memory of ``groma map`` grow with the number of images.

A scene is repeated K times side by side in one model: copies of its poses, points and observations, moved apart, and
images that are links to the same files. Every image keeps its neighbours, so that the work per image stays the same,
and anything that grows faster than the number of images shows.

    python benchmarks/map_scaling.py IMAGES --model MODEL --copies 1 2 4 8

Each size runs in a process of its own, with one thread unless told otherwise. Columns: images, points, lines, planes,
seconds of processor time in all and per image, peak memory; then the same seconds of every stage per image, and the
peak memory up to the end of every stage, MB.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np


def repeat(scene, copies):
    """Return the scene K times side by side; images of copy k are named ``k/name``."""
    from groma.scene import PointObservations, Points, Scene

    xyz = scene.points.xyz
    low, high = np.quantile(np.vstack([xyz, scene.cam_centers_in_world]), [0.02, 0.98], axis=0)
    step = 20.0 * float(np.linalg.norm(high - low))
    names, camera_idx, poses, points, parts = [], [], [], [], []
    for k in range(copies):
        shift = np.array([k % 4, k // 4, 0.0]) * step
        pose = scene.cam_from_world.copy()
        rotation = rotations(pose[:, :4])
        pose[:, 4:] -= rotation @ shift
        names += [f"{k:03d}/{name}" for name in scene.images.names]
        camera_idx.append(scene.images.camera_idx)
        poses.append(pose)
        points.append(xyz + shift)
        seen = scene.point_observations
        parts.append(
            (seen.image_idx + k * scene.num_images, seen.point_idx + k * len(xyz), seen.pixel, seen.keypoint_idx)
        )
    image_idx, point_idx, pixel, keypoint_idx = (np.concatenate(column) for column in zip(*parts, strict=True))
    many = Scene.from_images(scene.cameras, names, np.concatenate(camera_idx), np.concatenate(poses))
    count = copies * len(xyz)
    return many.replace(
        points=Points(np.arange(count) + 1, np.concatenate(points), np.zeros((count, 3), np.uint8), np.zeros(count)),
        point_observations=PointObservations(image_idx, point_idx, pixel, keypoint_idx),
    )


def rotations(quaternions):
    """Rotation matrices (N, 3, 3)."""
    from groma.geometry import quaternion

    return quaternion.to_matrix(quaternions)


def measure(images, model, copies, threads):
    """Map K copies; return the numbers of one row."""
    from groma.io import read_scene
    from groma.mapping.map import map_images
    from groma.mapping.options import MapOptions

    scene = repeat(read_scene(model).points_only(), copies)
    seconds, peaks, last = {}, {}, ["reading", time.process_time()]

    def progress(stage, done, total):
        now = time.process_time()
        seconds[last[0]] = seconds.get(last[0], 0.0) + now - last[1]
        peaks[last[0]] = peak_mb()
        last[:] = stage, now

    with tempfile.TemporaryDirectory() as folder:
        photographs = Path(folder) / "images"
        for name in scene.images.names:
            link = photographs / name
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to((Path(images) / name.split("/", 1)[1]).resolve())
        start = last[1] = time.process_time()
        result = map_images(photographs, Path(folder) / "work", scene, MapOptions(threads=threads), progress)
        total = time.process_time() - start
    return {
        "images": scene.num_images,
        "points": result.scene.num_points,
        "lines": result.scene.num_lines,
        "planes": result.scene.num_planes,
        "seconds": total,
        "peak_mb": peak_mb(),
        "stages": seconds,
        "peaks": peaks,
    }


def peak_mb():
    """Return the largest memory that this process has had, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images")
    parser.add_argument("--model", required=True)
    parser.add_argument("--copies", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--row", action="store_true", help="print one row as JSON; used by the benchmark itself")
    arguments = parser.parse_args()
    if arguments.row:
        print(json.dumps(measure(arguments.images, arguments.model, arguments.copies[0], arguments.threads)))
        return
    rows = []
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), str(arguments.threads))
    for copies in [arguments.copies[0], *arguments.copies]:  # the first run compiles, and is not counted
        command = [sys.executable, __file__, arguments.images, "--model", arguments.model, "--row"]
        command += ["--threads", str(arguments.threads), "--copies", str(copies)]
        said = subprocess.run(command, check=True, capture_output=True, text=True, env=os.environ | limits).stdout
        rows.append(json.loads(said.splitlines()[-1]))
    print(f"{'images':>7} {'points':>8} {'lines':>7} {'planes':>7} {'seconds':>8} {'s/image':>8} {'peak MB':>8}")
    for row in rows[1:]:
        per_image = row["seconds"] / row["images"]
        print(
            f"{row['images']:7d} {row['points']:8d} {row['lines']:7d} {row['planes']:7d} {row['seconds']:8.1f} "
            f"{per_image:8.3f} {row['peak_mb']:8.0f}"
        )
    print("\nseconds of processor time per image, by stage")
    for stage in rows[-1]["stages"]:
        values = " ".join(f"{row['stages'].get(stage, 0.0) / row['images']:8.4f}" for row in rows[1:])
        print(f"{stage:32s} {values}")
    print("\npeak memory up to the end of a stage, MB")
    for stage in rows[-1]["peaks"]:
        print(f"{stage:32s} " + " ".join(f"{row['peaks'].get(stage, 0.0):8.0f}" for row in rows[1:]))


if __name__ == "__main__":
    main()
