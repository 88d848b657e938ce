# SPDX-License-Identifier: BSD-3-Clause
r"""What was measured of the lines and planes of a model, carried to those that are found anew.

Inverse depth changes linearly along a segment without distortion. A new segment on a measured one, whose ends are at
the parts :math:`t_i` of that, has

.. math:: q_i = (1 - t_i)\, \tilde q_0 + t_i\, \tilde q_1, \qquad
    \sigma_i^2 = c_{ii} + |c_{01}|, \quad C = A\, \mathrm{diag}(\tilde\sigma^2)\, A^\top,

since a diagonal matrix of these is nowhere less than C. Planes that were measured in cameras stay; a plane that is
found where one of them is takes over its measurements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from groma import cameras as camera_models
from groma._counted import counted
from groma._typing import FloatArray
from groma.features.segments import SEGMENTS, Segments
from groma.gates import NORMAL, chi_square_gate
from groma.geometry import quaternion
from groma.geometry.charts.plane_normal_offset import NormalOffsetPlane
from groma.geometry.segment2 import segments_apart
from groma.mapping.carried.kept_lines import with_lines_of
from groma.mapping.result import MapResult
from groma.mapping.structure.find import Structure
from groma.scene import Planes, Scene

#: Measurements that may be of planes; and of lines, planes or directions.
_OF_PLANES = ("plane_observations", "distances", "known_planes", "known_directions")
_OF_LANDMARKS = ("line_depths", *_OF_PLANES)


def ready_to_map(model: Scene) -> Scene:
    """Return a model without lines and planes but for those that were measured in cameras, and without directions."""
    measured = np.zeros(model.num_line_observations, bool)
    measured[model.line_depths.observation_idx] = True
    lines = np.unique(model.line_observations.line_idx[measured])
    planes = np.unique(model.plane_observations.plane_idx)
    return model.keep(lines=lines, planes=planes, directions=[], line_observations=measured)


def carried_depths(model: Scene, segments: Sequence[Segments]) -> FloatArray | None:
    """Return inverse depths of segments (S, 5), those of the measured ones that they lie on; None where there are none.

    The columns are those of :func:`groma.mapping.depth.segments.segment_depths`.
    """
    table, seen = model.line_depths, model.line_observations
    if not len(table):
        return None
    image, ends = seen.image_idx[table.observation_idx], seen.segment[table.observation_idx]
    found = [np.zeros((0, 5))]
    for number, own in enumerate(segments):
        rows, values = np.flatnonzero(image == number), np.zeros((len(own), 5))
        if len(rows) and len(own):
            there, here = (_undistorted(model, number, one) for one in (ends[rows], own.ends))
            apart = np.nan_to_num(segments_apart(here, there), nan=np.inf)
            nearest = apart.argmin(axis=1)
            on = np.flatnonzero(apart[np.arange(len(own)), nearest] < SEGMENTS.on)
            nearest = nearest[on]
            measured = table.inverse_depth[rows[nearest]], table.sigma[rows[nearest]]
            values[on] = _depths_on(there[nearest], *measured, here[on])
        found.append(values)
    return np.concatenate(found)


def _depths_on(measured: FloatArray, q: FloatArray, sigma: FloatArray, segments: FloatArray) -> FloatArray:
    """Inverse depths of segments (n, 4) on measured ones, and their variances: rows (n, 5) of the module's formula."""
    start, ends = measured[:, None, :2], segments.reshape(-1, 2, 2)
    step = measured[:, None, 2:] - start
    t = ((ends - start) * step).sum(axis=2) / (step**2).sum(axis=2)
    A = np.stack([1.0 - t, t], axis=2)
    C = np.einsum("nij,nj,nkj->nik", A, sigma**2, A)
    common = np.abs(C[:, 0, 1])
    value = np.einsum("nij,nj->ni", A, q)
    out = np.column_stack([value, C[:, 0, 0] + common, np.zeros(len(q)), C[:, 1, 1] + common])
    return np.where((value > 0.0).all(axis=1)[:, None], out, 0.0)


def _undistorted(model: Scene, image: int, ends: FloatArray) -> FloatArray:
    camera = int(model.images.camera_idx[image])
    lens = camera_models.model(model.cameras.models[camera])
    pixels = np.ascontiguousarray(ends.reshape(-1, 2))
    return lens.undistort_pixels(model.cameras.params_of(camera), pixels).reshape(-1, 4)


def with_measured_lines(result: MapResult, model: Scene) -> MapResult:
    """Return a map with the lines of its model that have measured depths and were not found anew."""
    if not len(model.line_depths):
        return result
    names = ((model.images.names,), np.zeros((0, 2), np.int64), SEGMENTS.on)
    scenes = {name: with_lines_of(getattr(result, name), (model,), *names) for name in ("scene", "before")}
    return replace(result, **scenes)


def with_measured_planes(found: Structure, before: Scene) -> Scene:
    """Return a scene with the planes found in it and those of the scene before, which cameras measured.

    A measured plane is the found one from which its measurements differ, in the middle, by no more than the noise of
    that and of one of them: errors of one camera's measurements go together.
    """
    scene, planes = found.scene, found.planes
    if not before.num_planes:
        return scene
    row, limit = np.full(before.num_planes, -1), chi_square_gate(NORMAL.false_alarm, 3)
    if len(planes):
        away = _misfits(before, planes.planes, planes.covariance)
        for plane in range(len(row)):
            misfit = np.median(away[before.plane_observations.plane_idx == plane], axis=0)
            row[plane] = misfit.argmin() if misfit.min() < limit else -1
    alone = np.flatnonzero(row < 0)
    row[alone] = len(planes) + np.arange(len(alone))
    every = np.concatenate([planes.planes, before.planes.hesse[alone]])
    tables = {name: getattr(before, name).renumbered({"planes": row})[0] for name in _OF_PLANES}
    return scene.replace(planes=Planes(np.arange(len(every)) + 1, every), **tables)


def _misfits(scene: Scene, planes: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squared normalised differences (N, K) of measured planes from others, with covariances of (n, w) (K, 4, 4)."""
    table = scene.plane_observations
    pose = scene.cam_from_world[table.image_idx]
    moved = np.tile(np.eye(4), (len(table), 1, 1))
    moved[:, :3, :3] = quaternion.to_matrix(pose[:, :4])
    moved[:, 3, :3] = -np.einsum("ni,nij->nj", pose[:, 4:], moved[:, :3, :3])
    # The two angles and the offset of the measurement, from (n, w) in the world.
    measured_from_world = np.einsum("nki,nkj->nij", NormalOffsetPlane().basis(table.plane_in_cam), moved)
    root = np.linalg.inv(table.sqrt_information)
    noise = np.einsum("nij,nkj->nik", root, root)
    offset = np.array([0.0, 0.0, 1.0]) * table.plane_in_cam[:, 3:]
    out = np.empty((len(table), len(planes)))
    for k, (plane, own) in enumerate(zip(planes, covariance, strict=True)):
        sign = np.sign(np.einsum("ni,nij,j->n", table.plane_in_cam[:, :3], moved[:, :3, :3], plane[:3]))
        away = sign[:, None] * (measured_from_world @ plane) - offset
        both = noise + measured_from_world @ own @ measured_from_world.transpose(0, 2, 1)
        out[:, k] = np.einsum("ni,ni->n", away, np.linalg.solve(both, away[:, :, None])[:, :, 0])
    return out


def not_carried(model: Scene, result: Scene) -> list[str]:
    """Say which measurements of the lines, planes and directions of a model its map does not have."""
    lost = {name: len(getattr(model, name)) - len(getattr(result, name)) for name in _OF_LANDMARKS}
    words = [counted(count, name.replace("_", " ")) for name, count in lost.items() if count > 0]
    if not words:
        return []
    return [
        f"Measurements of the model that this map does not have: {', '.join(words)}. Their lines, planes or directions "
        "were not found again."
    ]
