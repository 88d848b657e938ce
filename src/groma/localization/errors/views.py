# SPDX-License-Identifier: BSD-3-Clause
"""What the observations of the landmarks of a map tell about its frames, cameras and landmarks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.localization.pose.records import LANDMARK_LOSS, landmark_rows, motions_of_lines, records, times
from groma.scene import Scene


@dataclass(frozen=True, eq=False)
class Views:
    """Observations of the landmarks of one kind, whitened and weighted by a robust loss, with what they tell about."""

    #: (n,) landmark, frame and camera; (n, 2, 6) derivatives by the left twist of the frame, (n, 2, p) by the
    #: parameters of the camera, (n, 2, m) by what the landmark can do; (n, 2) residuals.
    landmark: IntArray
    frame: IntArray
    camera: IntArray
    by_frame: FloatArray
    by_camera: FloatArray
    by_landmark: FloatArray
    residual: FloatArray
    #: (L, k, m) what each landmark can do.
    free: FloatArray

    def determined(self) -> tuple[FloatArray, BoolArray]:
        """Information (L, m, m) of the landmarks, and which (n,) views are of those that it determines."""
        information = np.zeros((len(self.free), *2 * self.by_landmark.shape[2:]))
        np.add.at(information, self.landmark, np.swapaxes(self.by_landmark, 1, 2) @ self.by_landmark)
        values = np.linalg.eigvalsh(information) if len(information) else np.zeros((0, 1))
        return information, (values[:, 0] > 1e-12 * values[:, -1])[self.landmark]


def views_of(scene: Scene, kind: str, parameters: int) -> Views:
    """Return the observations of the landmarks of one kind, with so many parameters of each camera."""
    size, total = (3 if kind == "points" else 6), len(getattr(scene, kind))
    options = AssemblyOptions(refine_intrinsics=True, drop_behind=False, point_chart="euclidean", gauge="free")
    problem = assemble(scene, options).problem
    free = np.broadcast_to(np.eye(3), (total, 3, 3))
    if kind == "lines":
        free = motions_of_lines(problem.variables[kind].ambient()[:total]) if total else np.zeros((0, 6, 4))
    cameras = {f"intrinsics/{name}": rows for name, rows in scene.cameras.by_model().items()}
    parts = []
    for factor in problem.factors:
        landmark = landmark_rows(factor, kind)
        if landmark is None:
            continue
        refs = {slot.name: ref for slot, ref in factor.references()}
        lens = refs.get("intrinsics") if parameters else None
        count = 0 if lens is None else problem.variables[lens.group].state.shape[1]
        wanted = {"pose": 6, **({"intrinsics": count} if count else {}), kind[:-1]: size}
        white = times(factor.sqrt_information, records(problem, factor, wanted))
        white /= 1.0 + (white[..., -1:] ** 2).sum(axis=1, keepdims=True) / LANDMARK_LOSS.scale**2  # root of its weight
        by_camera = np.zeros((len(factor), 2, parameters))
        by_camera[..., :count] = white[..., 6 : 6 + count]
        camera = np.zeros(len(factor), np.int64) if lens is None else cameras[lens.group][lens.index]
        by_landmark = white[..., 6 + count : -1] @ free[landmark]
        parts.append((landmark, refs["pose"].index, camera, white[..., :6], by_camera, by_landmark, white[..., -1]))
    if not parts:
        none, shapes = np.zeros(0, np.int64), (6, parameters, free.shape[2])
        parts = [(none, none, none, *(np.zeros((0, 2, width)) for width in shapes), np.zeros((0, 2)))]
    landmark, frame, camera, *derivatives, residual = (np.concatenate(part) for part in zip(*parts, strict=True))
    by_frame, by_camera, by_landmark = derivatives
    return Views(landmark, frame, camera, by_frame, by_camera, by_landmark, residual, free)
