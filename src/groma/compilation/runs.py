# SPDX-License-Identifier: BSD-3-Clause
"""The small runs of ``groma warmup``: scenes that are adjusted, mapped and tracked only to be compiled for."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from groma.cameras import model
from groma.scene import Scene, synthetic
from groma.scene.camera import Cameras

#: Camera models that are compiled for: calibration held, and calibration estimated.
HELD = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE")
ESTIMATED = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
#: Factors of a track that its synthetic sequences may not meet.
TRACK_FACTORS = ("orthogonal_planes", "parallel_planes", "pose_between", "pose_prior", "plane_observation")
#: Photographs of the packaged scene that are mapped.
NUM_PHOTOGRAPHS = 14
#: Frames of each tracked sequence, pixels that the camera moves in between.
NUM_FRAMES, MOTION = 24, 10

Steps = Iterator[tuple[str, Callable[[], Any]]]


def _adjust_steps() -> Steps:
    from groma.adjustment.adjust import AdjustOptions, adjust

    few = AdjustOptions(max_iterations=4)
    start = synthetic.holistic(8, seed=1).start

    def step(scene: Scene, **changes: Any) -> Callable[[], Any]:
        return lambda: adjust(scene, replace(few, **changes))

    yield "projection", _project
    for name in HELD:
        yield f"{name}, calibration held", step(with_model(start, name))
    yield "landmarks alone", step(start, refine_poses=False)
    yield "points alone", step(start.points_only())
    for solver in ("sparse", "pcg"):
        yield f"{solver} solver", step(start, linear_solver=solver)
    yield "relations in pixels", step(start, structure_form="pixels")
    for name in ESTIMATED:
        yield f"{name}, calibration estimated", step(with_model(start, name), refine_intrinsics=True)
    own = with_own_cameras(start.points_only(), "BAL")
    for solver in ("dense", "pcg"):
        yield f"BAL, {solver} solver", step(own, loss="none", linear_solver=solver)


def _project() -> None:
    """Project a point and back, by each model."""
    for name in (*HELD, "BAL"):
        camera, params = model(name), _cameras(name, 1).params
        pixels = camera.project(params[0], np.array([[0.1, 0.2, 2.0]]))
        camera.unproject(params[0], pixels)


def with_model(scene: Scene, name: str) -> Scene:
    """Return a scene whose one camera has another model, without distortion."""
    return scene.replace(cameras=_cameras(name, 1))


def with_own_cameras(scene: Scene, name: str) -> Scene:
    """Return a scene in which each image has a camera of its own."""
    return Scene.from_images(
        _cameras(name, scene.num_images),
        scene.images.names,
        np.arange(scene.num_images),
        scene.cam_from_world,
        points=scene.points,
        point_observations=scene.point_observations,
    )


def _cameras(name: str, count: int) -> Cameras:
    camera = model(name)
    params = np.zeros(camera.num_parameters)
    params[list(camera.focal_indices)] = synthetic.FOCAL
    if camera.principal_point_indices:
        params[list(camera.principal_point_indices)] = synthetic.WIDTH / 2, synthetic.HEIGHT / 2
    sizes = np.full(count, synthetic.WIDTH), np.full(count, synthetic.HEIGHT)
    return Cameras(np.arange(count) + 1, (name,) * count, np.tile(params, (count, 1)), *sizes)


def _map_steps() -> Steps:
    from groma.evaluation import cabinet as _cabinet
    from groma.io import read_scene
    from groma.mapping.map import map_images
    from groma.mapping.options import MapOptions

    cabinet = _cabinet.folder()
    scene = read_scene(cabinet / "model").subset(np.arange(NUM_PHOTOGRAPHS), min_observations=3)

    def run(options: MapOptions) -> None:
        with tempfile.TemporaryDirectory() as place:
            images = Path(place) / "images"
            images.mkdir()
            for name in scene.images.names:
                shutil.copyfile(cabinet / "images" / name, images / name)
            map_images(images, Path(place) / "work", scene, options)

    yield "photographs of a cabinet", lambda: run(MapOptions())
    yield "the same, poses held", lambda: run(MapOptions(refine_poses=False))


def _track_steps() -> Steps:
    from groma.factors.contract import registered
    from groma.io.sequences.frame import Frame, SequenceCamera
    from groma.problem.problem import Problem
    from groma.problem.variables import Variables
    from groma.solver.options import SolverOptions
    from groma.solver.solve import solve
    from groma.tracking import Tracker, TrackOptions

    def relate() -> None:
        """Solve small instances of the relations that a track finds only in a room."""
        for name in TRACK_FACTORS:
            example = registered()[name].example(np.random.default_rng(0))
            variables = {group: Variables(*pair) for group, pair in example.variables.items()}
            solve(Problem(variables, [example.factor]), SolverOptions(max_iterations=2))
            if name == "pose_between":  # long loops are closed by a sparse factorisation
                solve(Problem(variables, [example.factor]), SolverOptions(max_iterations=2, linear_solver="sparse"))

    def run(kind: str) -> None:
        camera = SequenceCamera("PINHOLE", np.array([400.0, 400.0, 320.0, 240.0]), 640, 480,
                                baseline=0.1 if kind == "stereo" else None)  # fmt: skip
        tracker = Tracker(camera, TrackOptions(keyframe_motion=0.05))
        for number, (gray, depth, right) in enumerate(_frames()):
            extra = {"rgbd": {"depth": depth}, "stereo": {"right": right}, "mono": {}}[kind]
            tracker.process(Frame(number / 30, gray, name=str(number), **extra))
        tracker.finish()

    yield "relations", relate
    for kind in ("rgbd", "stereo", "mono"):
        yield f"{kind} sequence", lambda kind=kind: run(kind)


def _frames() -> Iterator[tuple[Any, Any, Any]]:
    """Give grey image, depth and right image of a camera that moves along a wall with a step in it."""
    rng = np.random.default_rng(0)
    width = 640 + 2 * NUM_FRAMES * MOTION + 80
    near, far = _wall(rng, width), _wall(rng, width)
    columns = np.arange(640)
    for frame in range(NUM_FRAMES):
        # 400 px of focal length, 2 m and 4 m away: 20 and 10 px of disparity with a right camera 0.1 m beside
        shift = frame * MOTION
        edge = 400 - 2 * shift
        is_near = columns < edge
        gray = np.where(is_near, near[:, 2 * shift : 2 * shift + 640], far[:, shift : shift + 640])
        right = np.where(
            columns < edge - 20, near[:, 2 * shift + 20 : 2 * shift + 660], far[:, shift + 10 : shift + 650]
        )
        depth = np.broadcast_to(np.where(is_near, np.float32(2.0), np.float32(4.0)), (480, 640)).copy()
        yield np.ascontiguousarray(gray), depth, np.ascontiguousarray(right)


def _wall(rng: np.random.Generator, width: int) -> npt.NDArray[np.uint8]:
    """Return a grey wall with rectangles on it, (480, width) uint8."""
    image = np.full((480, width), 120, dtype=np.uint8)
    for _ in range(width // 6):
        x, y = int(rng.integers(0, width - 20)), int(rng.integers(0, 460))
        w, h = (int(size) for size in rng.integers(8, 90, 2))
        image[y : y + h, x : x + w] = rng.integers(20, 235)
    return (image.astype(np.int16) + rng.integers(-4, 5, image.shape)).clip(0, 255).astype(np.uint8)


RUNS: dict[str, Callable[[], Steps]] = {"adjust": _adjust_steps, "map": _map_steps, "track": _track_steps}
