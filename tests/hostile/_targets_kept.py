# SPDX-License-Identifier: BSD-3-Clause
"""Targets: what groma keeps for itself and others may hand on. Stages, parts, indices, covariances, running tracks."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from _targets import GRAY, Made, encoded, npz, one
from _targets_surveys import surveyed

import groma
from groma.adjustment.adjust import AdjustOptions, adjust
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.covariance_files import write_covariances
from groma.adjustment.parts import write_parts
from groma.adjustment.parts.checkpoint import Checkpoint
from groma.adjustment.parts.cut import parts_of
from groma.adjustment.parts.opened import open_parts
from groma.features.depth.noise import DepthNoise
from groma.io import read_scene, write_archive
from groma.localization.map_images import images_in_summary
from groma.localization.map_index import MapIndex, images_told, read_index
from groma.localization.stored import StoredImage, read_stored, unreadable
from groma.mapping.checkpoint_files import ADJUSTED, ARRAY, DEPTHS, LINE_MAP, REGISTERED, SEGMENTS
from groma.mapping.depth.points import MeasuredDepths
from groma.mapping.posed.registered import RegisteredPhotographs
from groma.scene import Cameras, Points, Scene, synthetic
from groma.solver.reduce.journal import Waypoint
from groma.solver.reduce.single import SingleProcess
from groma.solver.standing import Standing
from groma.tracking.saved import read_saved_map
from groma.viz.report.covariances import read_covariances
from groma.viz.viewer.glance import read_now, read_statuses, timeline
from groma.viz.viewer.live import read_frames

SMALL = synthetic.holistic(4, seed=1).start


def made(home: Path) -> Iterator[Made]:
    """Yield all targets of this module."""
    work = home / "work"
    work.mkdir()
    for yields in (_stages, _parts, _maps, _tracks):
        yield from yields(work)
    shutil.rmtree(work)


def _files(folder: Path) -> dict[str, bytes]:
    """Return the files of a folder by name, and empty it."""
    found = {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    shutil.rmtree(folder)
    folder.mkdir()
    return found


def _stages(work: Path) -> Iterator[Made]:
    """Yield the results of stages of a map, and an archive with every table."""
    rng = np.random.default_rng(1)
    ones = dict.fromkeys(("sigma", "strength", "contrast"), np.ones(3))
    kept = npz(counts=[1, 2], ends=rng.uniform(0, 9, (3, 4)), **ones)
    yield "kept_segments", {"s.npz": kept}, one(SEGMENTS.read, "s.npz")
    names = ("image_idx", "segment_idx", "line_idx", "residual", "num_images", "median_residual", "uncertainty")
    line_map = dict.fromkeys(names, np.zeros(1)) | {"lines": np.zeros((1, 6)), "segments": np.zeros((1, 2, 3))}
    line_map |= {
        "supporters": np.zeros((1, 2), np.int64),
        "rejection": np.zeros(1, np.int64),
        "depth_ratios": np.zeros((1, 2)),
    }
    line_map |= {f"{part}{end}": np.zeros(1, np.int64) for part in ("outcomes", "neighbors") for end in ("", ".counts")}
    yield "kept_line_map", {"l.npz": npz(**line_map)}, one(LINE_MAP.read, "l.npz")
    results = {
        "adjusted": (ADJUSTED, adjust(SMALL, AdjustOptions(max_iterations=2))),
        "registered": (REGISTERED, RegisteredPhotographs(SMALL.points_only(), ("a note",), ("a warning",))),
        "depths": (
            DEPTHS, MeasuredDepths(SMALL.points_only(), np.ones(4), DepthNoise(), 1.5, False, (0.2, 0.1), ("told",)),
        ),
        "array": (ARRAY, rng.normal(size=(4, 2))),
    }  # fmt: skip
    for name, (kind, result) in results.items():
        kind.write(result, work / "a.npz")  # type: ignore[attr-defined]
        yield f"kept_{name}", _files(work), one(kind.read, "a.npz")  # type: ignore[attr-defined]
    write_archive(surveyed(work), work / "a.npz")
    yield "archive_surveyed", _files(work), one(read_scene, "a.npz")


def _parts(work: Path) -> Iterator[Made]:
    """Yield a scene in parts, and the checkpoint of its adjustment."""
    write_parts(SMALL.points_only(), work, observations=60)
    parts = _files(work)
    yield "parts", parts, lambda folder: open_parts(parts_of(folder), AssemblyOptions(), SingleProcess())
    for name, content in parts.items():
        (work / name).write_bytes(content)
    opened = open_parts(parts_of(work), AssemblyOptions(), SingleProcess())
    checkpoint = Checkpoint(work / ".checkpoint", "key", opened, SingleProcess())
    standing = Standing(2.0, 1.0, (), None)
    states = {name: group.state for name, group in opened.variables.items()}
    checkpoint.keep(states, Waypoint(standing, 1e-4, 1.0, 1.0))
    yield (
        "parts_checkpoint",
        _files(work / ".checkpoint"),
        lambda folder: Checkpoint(folder, "key", opened, SingleProcess()).load(),
    )
    shutil.rmtree(work)
    work.mkdir()


def _maps(work: Path) -> Iterator[Made]:
    """Yield what is kept beside a map that photographs are localised in, and covariances."""
    rng = np.random.default_rng(2)
    count = np.array([0, 3, 5])
    shapes = {
        "xyz": (4, 3), "point_covariance": (4, 3, 3), "pixel": (5, 2), "line_covariance": (2, 6, 6),
        "segment_descriptor": (5, 72), "vocabulary": (2, 128), "image": (2, 256), "shared_error": (2,),
        "within": (4,), "telling": (4,), "common": (8, 8), "point_motion": (3, 3, 8), "line_motion": (2, 6, 8),
    }  # fmt: skip
    arrays = {name: rng.uniform(0.0, 9.0, shape) for name, shape in shapes.items()}
    for name in ("segment_descriptor", "vocabulary", "image", "point_motion", "line_motion"):
        arrays[name] = arrays[name].astype(np.float32)
    arrays |= {"begin": count, "segment_begin": count, "point": np.arange(5) % 4, "segment": np.arange(5) % 2}
    arrays["descriptor"] = rng.integers(0, 255, (5, 128)).astype(np.uint8)
    arrays |= {"point_seen": np.array([[0, 0, 0], [1, 0, 0], [3, 0, 0]]), "line_seen": np.array([[0, 0, 0], [1, 0, 0]])}
    index = MapIndex(**{item.name: arrays[item.name] for item in fields(MapIndex)})
    index.write(work / "i.npz", "digest", work)
    yield ("map_index", _files(work), _index)
    found = replace(
        unreadable("a.jpg", "a reason"), status="localized", pose=np.array([0.0, 0, 0, 1, 0, 0, 1]),
        covariance=np.eye(6), model="PINHOLE", params=np.array([9.0, 9.0, 5.0, 5.0]), size=np.array([10, 10]),
    )  # fmt: skip
    found.write(work / "p.npz", "digest")
    yield "stored_image", _files(work), _stored
    write_covariances(work / "c.npz", SMALL, groma.uncertainty(SMALL))
    yield "covariances", _files(work), functools.partial(_covariances, SMALL)
    yield "summary_images", {"summary.json": json.dumps({"images": "/nowhere"}).encode()}, images_in_summary


def _index(folder: Path) -> object:
    return read_index(folder / "i.npz", "digest"), images_told(folder / "i.npz")


def _stored(folder: Path) -> object:
    found: StoredImage | None = read_stored(folder / "p.npz", "digest")
    return None if found is None else (found.to_dict(), found.camera)


def _covariances(scene: Scene, folder: Path) -> object:
    return read_covariances(folder / "c.npz", scene)


def _tracks(work: Path) -> Iterator[Made]:
    """Yield what a running track writes, and the folder of one that another goes on in."""
    frames = b"".join(b"%d 1 2 3 0 0 0 1 0\n" % row for row in range(4))
    yield "frames_txt", {"f.txt": frames}, one(read_frames, "f.txt")
    statuses = b"".join(b"%d.5 %s 100 20 3 1\n" % (row, b"tracked" if row else b"weak") for row in range(4))
    yield "statuses", {"s.txt": statuses}, lambda folder: timeline(read_statuses(folder / "s.txt"))
    now = npz(picture=GRAY, points=np.ones((3, 2)), segments=np.ones((2, 4)))
    yield "now", {"now.npz": now}, one(read_now, "now.npz")
    camera = Cameras(np.array([1]), ("PINHOLE",), np.array([[30.0, 30, 16, 12]]), np.array([32]), np.array([24]))
    names = ("0.png", "1.png")
    scene = Scene.from_images(camera, names, np.zeros(2, int), np.tile([0.0, 0, 0, 1, 0, 0, 0], (2, 1)))
    scene = scene.replace(points=Points(np.array([1]), np.ones((1, 3)), np.zeros((1, 3), np.uint8), np.zeros(1)))
    write_archive(scene, work / "scene.npz")
    images = {f"images/{name}": encoded(".png") for name in names}

    def told(folder: Path) -> bytes:
        source = {"path": str(folder / "images"), "camera": "30 30 16 12", "kind": "mono", "depth_scale": None}
        return json.dumps({"sources": [{**source, "images": {name: name for name in names}}]}).encode()

    # The folder of a target has the target's name, beside this one.
    summary = told(work.parent / "saved_map")
    yield "saved_map", {"summary.json": summary, **_files(work), **images}, _saved


def _saved(folder: Path) -> object:
    saved = read_saved_map(folder)
    return [source.read() for source in saved.sources]
