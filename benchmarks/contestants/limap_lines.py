# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP's global line triangulation: ``limap_lines.py IN.npz OUT.npz``.

Reads posed pinhole images with points, segments and matches, as ``lines.py`` writes them; writes the end points and the
tracks of the lines, before and after LIMAP's own refinement with poses held. Needs pylimap 2, not groma.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
from pathlib import Path

import limap
import numpy as np
import pycolmap
from _common import Clock, report
from limap import sfm
from limap.estimators import bundle_adjustment
from limap.geometry import Line2d
from limap.scene import HolisticReconstruction, Structure2d, StructureDatabase, StructureDatabaseCache, Wireframe2d


def build(data: dict[str, np.ndarray]) -> pycolmap.Reconstruction:
    """Return the model: every image with a camera of its own; image ids count from 1."""
    model = pycolmap.Reconstruction()
    image_of, point_of, pixels = data["observation_image"], data["observation_point"], data["observation_pixel"]
    place = np.empty(len(image_of), dtype=int)
    for i, (intrinsics, size, pose) in enumerate(zip(data["intrinsics"], data["size"], data["pose"], strict=True)):
        rows = np.flatnonzero(image_of == i)
        place[rows] = np.arange(len(rows))
        width, height = (int(value) for value in size)
        model.add_camera_with_trivial_rig(
            pycolmap.Camera(model="PINHOLE", width=width, height=height, params=intrinsics, camera_id=i + 1)
        )
        image = pycolmap.Image(name=f"{i}", keypoints=pixels[rows], camera_id=i + 1, image_id=i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4]), pose[4:]))
    order = np.argsort(point_of, kind="stable")
    first = np.searchsorted(point_of[order], np.arange(len(data["point"]) + 1))
    for p, xyz in enumerate(data["point"]):
        track = pycolmap.Track()
        for row in order[first[p] : first[p + 1]]:
            track.add_element(int(image_of[row]) + 1, int(place[row]))
        model.add_point3D(xyz, track)
    return model


def structures(model: pycolmap.Reconstruction, data: dict[str, np.ndarray]) -> StructureDatabaseCache:
    """Return LIMAP's tables of segments and matches."""
    start = data["segment_start"]
    with contextlib.ExitStack() as stack:
        folder = stack.enter_context(tempfile.TemporaryDirectory())
        database = stack.enter_context(StructureDatabase.open(str(Path(folder) / "structures.db")))
        for i in range(len(start) - 1):
            lines = [Line2d(s[:2], s[2:]) for s in data["segments"][start[i] : start[i + 1]]]
            database.write_structure2d(i + 1, Structure2d(lines, [], Wireframe2d(), model.images[i + 1].num_points2D()))
        bounds = data["match_start"]
        for (i, j), begin, end in zip(data["match_images"], bounds[:-1], bounds[1:], strict=True):
            database.write_line_matches(int(i) + 1, int(j) + 1, data["match_pairs"][begin:end].astype(np.uint32))
        return StructureDatabaseCache.create(database)


def result(holistic: HolisticReconstruction) -> dict[str, np.ndarray]:
    """Return the end points, and image and segment of every observation."""
    found = holistic.structure_recon.lines3D
    tracks = [
        (n, element.image_id - 1, element.point2D_idx)
        for n, line in enumerate(found.values())
        for element in line.track.elements
    ]
    ends = np.array([[line.start, line.end] for line in found.values()]).reshape(-1, 2, 3)
    return {"ends": ends, "track": np.array(tracks, dtype=int).reshape(-1, 3)}


def refine(holistic: HolisticReconstruction) -> None:
    """Adjust the lines alone."""
    options = bundle_adjustment.PointLineBundleAdjustmentOptions()
    for name in ("focal_length", "principal_point", "extra_params", "rig_from_world", "sensor_from_rig", "points"):
        setattr(options, f"refine_{name}", False)
    options.print_summary = False
    config = bundle_adjustment.PointLineBundleAdjustmentConfig()
    for image_id in holistic.point_recon.images:
        config.add_image(image_id)
    for line_id in holistic.structure_recon.line3D_ids():
        config.add_variable_line(line_id)
    bundle_adjustment.create_point_line_bundle_adjuster(options, config, holistic).solve()


def main() -> None:
    source, target = sys.argv[1:]
    with np.load(source) as archive:
        data = {name: archive[name] for name in archive.files}
    pycolmap.logging.minloglevel = 2
    model = build(data)
    holistic, cache = HolisticReconstruction(model), structures(model, data)
    options = sfm.GlobalLineTriangulationOptions()
    options.num_threads = 1
    options.min_length_2d = float(data["min_length"])
    options.use_vp_assisted_triangulation = False  # no vanishing points are given
    clock = Clock()
    holistic.structure_recon.load(cache)
    holistic.structure_recon.initialize_all_wireframes(options.wireframe2d_th)
    graph = cache.structure_correspondence_graph.line_graph
    every = {i + 1: [int(j) + 1 for j in row if j >= 0] for i, row in enumerate(data["neighbors"])}
    sfm.global_line_triangulation(options, holistic, graph, {} if len(data["match_images"]) else every)
    times = clock.read()
    raw = result(holistic)
    refine(holistic)
    refined = result(holistic)
    np.savez(target, **raw, **{f"refined_{name}": values for name, values in refined.items()})
    report(contestant="limap", version=limap.__version__, **times, num_lines=len(raw["ends"]))


if __name__ == "__main__":
    main()
