# SPDX-License-Identifier: BSD-3-Clause
"""Records of point and line reprojections written on a CUDA device, one thread per observation.

The formulas are those of :mod:`groma.factors.point_reprojection` and :mod:`groma.factors.line_reprojection`: the loops
here call the same kernels, and differ from the loops there only in where their small arrays lie. What is written is
the same record, ``[pose 6 | landmark 3 or 6 | intrinsics k | r]`` in two rows.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np

from groma._cuda import device_loop
from groma._typing import FloatArray
from groma.cameras import CameraModel, _dispatch
from groma.factors._rig import (
    put_line,
    put_line_pose,
    put_point,
    put_point_pose,
    transform_line,
    transform_point,
)
from groma.factors.line_reprojection import LineReprojection, endpoint_distance, image_line_norm
from groma.factors.point_reprojection import PointReprojection

# Filled in when a loop is turned; here so that the loops read as they run.
cuda: Any = None
project_jacobian: Any = None
pinhole_parameters: Any = None
pinhole_parameters_jacobian: Any = None
NUM_PARAMETERS = 0
FLOAT = np.float64


# ------------------------------------------------------------------------------------------------------------ Kernels
def _point(smallest_depth, poses, pose_index, points, point_index, intrinsics, intrinsics_index, pixels, record):
    i = cuda.grid(1)
    if i >= pixels.shape[0]:
        return
    P, uv = cuda.local.array(3, FLOAT), cuda.local.array(2, FLOAT)
    A, J_params = cuda.local.array((2, 3), FLOAT), cuda.local.array((2, NUM_PARAMETERS), FLOAT)
    params = cuda.local.array(NUM_PARAMETERS, FLOAT)
    c, last = pose_index[i], record.shape[2] - 1
    for j in range(NUM_PARAMETERS):
        params[j] = intrinsics[intrinsics_index[i], j]
    transform_point(poses, c, points, point_index[i], P)
    valid = P[2] > smallest_depth
    if valid:
        valid = project_jacobian(params, P, uv, A, J_params)
    for row in range(2):
        residual = uv[row] - pixels[i, row]
        if valid and abs(residual) < np.inf:
            record[i, row, last] = residual
            put_point_pose(A[row, 0], A[row, 1], A[row, 2], P, record, i, row, 0)
            put_point(A[row, 0], A[row, 1], A[row, 2], poses, c, record, i, row, 6)
            for j in range(NUM_PARAMETERS):
                record[i, row, 9 + j] = J_params[row, j]
        else:
            for j in range(last + 1):
                record[i, row, j] = 0.0


def _line(poses, pose_index, lines, line_index, intrinsics, intrinsics_index, segments, record):
    i = cuda.grid(1)
    if i >= segments.shape[0]:
        return
    L, K, out = cuda.local.array(6, FLOAT), cuda.local.array(4, FLOAT), cuda.local.array((2, 8), FLOAT)
    J_K, params = cuda.local.array((4, NUM_PARAMETERS), FLOAT), cuda.local.array(NUM_PARAMETERS, FLOAT)
    c, last = pose_index[i], record.shape[2] - 1
    for j in range(NUM_PARAMETERS):
        params[j] = intrinsics[intrinsics_index[i], j]
    pinhole_parameters(params, K)
    pinhole_parameters_jacobian(params, J_K)
    valid = transform_line(poses, c, lines, line_index[i], L)
    h = image_line_norm(L[0], L[1], L[2], K)
    if valid and h > 0.0:
        valid = endpoint_distance(L[0], L[1], L[2], K, h, segments[i, 0], segments[i, 1], out, 0)
        if valid:
            valid = endpoint_distance(L[0], L[1], L[2], K, h, segments[i, 2], segments[i, 3], out, 1)
    else:
        valid = False
    for row in range(2):
        if valid:
            g0, g1, g2 = out[row, 1], out[row, 2], out[row, 3]
            record[i, row, last] = out[row, 0]
            put_line_pose(g0, g1, g2, 0.0, 0.0, 0.0, L, record, i, row, 0)
            put_line(g0, g1, g2, 0.0, 0.0, 0.0, poses, c, record, i, row, 6)
            for j in range(NUM_PARAMETERS):
                total = 0.0
                for k in range(4):
                    total += out[row, 4 + k] * J_K[k, j]
                record[i, row, 12 + j] = total
        else:
            for j in range(last + 1):
                record[i, row, j] = 0.0


# ------------------------------------------------------------------------------------------------------------- Public
@lru_cache(maxsize=16)
def _loop(kind: str, camera: CameraModel):
    """Return the loop of one kind for one camera model."""
    length = len(camera.tag)
    names: dict[str, Any] = {"NUM_PARAMETERS": camera.num_parameters}
    if kind == "point":
        return device_loop(_point, {**names, "project_jacobian": _dispatch._PROJECT_JACOBIAN[length]})
    names["pinhole_parameters"] = _dispatch._PINHOLE[length]
    names["pinhole_parameters_jacobian"] = _dispatch._PINHOLE_JACOBIAN[length]
    return device_loop(_line, names)


def linearize_on_device(factor: PointReprojection | LineReprojection, ambients: tuple[FloatArray, ...]) -> FloatArray:
    """Write the records of all factors of a group on a CUDA device.

    Parameters
    ----------
    factor : PointReprojection or LineReprojection
        Without a rig.
    ambients : tuple of arrays
        Poses (M, 12), landmarks (P, 3) or (L, 6), and intrinsics (C, k), as :meth:`Factor.prepare` takes them.

    Returns
    -------
    (N, 2, width) float64
        Rows ``[pose 6 | landmark | intrinsics k | residual]``; zero for degenerate factors.

    Raises
    ------
    InputError
        Without ``numba-cuda`` or a device.
    """
    poses, landmarks, intrinsics = (np.ascontiguousarray(array, dtype=np.float64) for array in ambients)
    camera = factor.camera
    record = np.empty((len(factor), 2, 6 + landmarks.shape[1] + camera.num_parameters + 1))
    cameras = (intrinsics, factor.intrinsics.index)
    if isinstance(factor, PointReprojection):
        depth = factor.smallest_depth if factor.require_in_front else -np.inf
        observed = (poses, factor.pose.index, landmarks, factor.point.index, *cameras, factor.pixels)
        _loop("point", camera)(len(factor), depth, *observed, record)
    else:
        observed = (poses, factor.pose.index, landmarks, factor.line.index, *cameras, factor.segments)
        _loop("line", camera)(len(factor), *observed, record)
    return record
