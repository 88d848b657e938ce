# SPDX-License-Identifier: BSD-3-Clause
r"""A line seen between two pixels of a camera with any lens, whose parameters are estimated.

The residual is that of :mod:`groma.factors.observations.line_bearing` in pixels: the sines of the angles between the
rays of the two pixels and the plane through camera centre and line, times the focal length :math:`\phi` (the mean of
both; 1 for models without one). Here rays and focal length follow the parameters of the camera:

.. math:: r_i = \phi(\theta)\, f_i(\theta) \cdot \hat m_c, \qquad
          \frac{\partial r_i}{\partial \theta} = \phi\, \hat m_c^\top \frac{\partial f_i}{\partial \theta}
          + (f_i \cdot \hat m_c) \frac{\partial \phi}{\partial \theta}

The derivative of a unit ray is that of the implicit function :math:`\pi(\theta, f) = u`, :math:`f \cdot f = 1`:

.. math:: \begin{bmatrix} \partial \pi / \partial f \\ f^\top \end{bmatrix} \frac{\partial f}{\partial \theta}
          = \begin{bmatrix} -\partial \pi / \partial \theta \\ 0 \end{bmatrix}

Rays that are made once would hold the calibration that they were made with, and an estimate of it would seem to be
known far better than it is. And angles alone would shrink as the focal length grows, whatever was measured.

Source: Plücker notes, eqs. (65) and (76), on the unit sphere; the implicit function theorem.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, Columns, FloatArray, Inputs
from groma.factors._examples import indices
from groma.factors._pixels import INTRINSICS, PixelFactor, pixel_example
from groma.factors._rig import EXTRINSICS, MOTION, POSE, clear_record, put_line, put_line_pose, transform_line
from groma.factors.contract import Example, Measurement, Ref, Slot, register
from groma.factors.observations.line_bearing import bearing_sine

#: Determinants of the equations for the derivative of a ray, in units of a pixel squared, below which there is none.
_SINGULAR = 1e-9


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _linearize_all(
    poses, pose_index, lines, line_index, rays, by_params, focal, focal_by_params, begin, end,
    pose_column, line_column, lens_column, record,
):  # fmt: skip
    L, out = np.empty(6), np.empty(4)
    degenerate, last = 0, record.shape[2] - 1
    for i in range(begin, end):
        k, c = i - begin, pose_index[i]
        valid = transform_line(poses, c, lines, line_index[i], L)
        norm = math.sqrt(L[0] * L[0] + L[1] * L[1] + L[2] * L[2])
        seen = math.isfinite(rays[0, k, 0]) and math.isfinite(rays[1, k, 0])
        if valid and seen and norm < math.inf:
            for row in range(2):
                bearing_sine(L, 1.0 / norm, rays[row], k, out)
                sine = out[0]
                for j in range(4):
                    out[j] *= focal[k]
                record[k, row, last] = out[0]
                if pose_column >= 0:
                    put_line_pose(out[1], out[2], out[3], 0.0, 0.0, 0.0, L, record, k, row, pose_column)
                if line_column >= 0:
                    put_line(out[1], out[2], out[3], 0.0, 0.0, 0.0, poses, c, record, k, row, line_column)
                if lens_column >= 0:
                    for j in range(by_params.shape[3]):
                        total = 0.0
                        for axis in range(3):
                            total += L[axis] * by_params[row, k, axis, j]
                        record[k, row, lens_column + j] = total * focal[k] / norm + sine * focal_by_params[j]
        else:
            clear_record(record, k, pose_column, line_column, 6, lens_column, by_params.shape[3])
            degenerate += 1
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("line_unprojection")
@dataclass(frozen=True, kw_only=True)
class LineUnprojection(PixelFactor):
    """Lines seen between two pixels, any camera, its parameters estimated too; residual in pixels near the axis.

    Degenerate: lines through the camera centre (to 1e-9 of the lengths involved), and pixels outside the range of the
    camera model.
    """

    #: Lines in the world, any scale of (m, d).
    line: Ref
    #: (N, 4) first and second end, pixels.
    segments: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("line", "line"), INTRINSICS, EXTRINSICS, MOTION)
    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("segments", (4,)),)
    rows: ClassVar[int] = 2

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        _, poses, pose_index, lines, intrinsics, line_index, camera_index = self.arguments(inputs, self.line)
        params, segments = intrinsics[camera_index[begin:end]], self.segments[begin:end]
        ends = [self._rays(params, np.ascontiguousarray(segments[:, k : k + 2]), columns[2] >= 0) for k in (0, 2)]
        rays, by_params = (np.stack(parts) for parts in zip(*ends, strict=True))
        focal, by_focal = np.ones(len(params)), np.zeros(params.shape[1])
        if self.camera.is_planar:
            focal = self.camera.focal_length(params)
            by_focal[list(self.camera.focal_indices)] = 1.0 / len(self.camera.focal_indices)
        seen = (poses, pose_index, lines, line_index, rays, by_params, focal, by_focal)
        return _linearize_all(*seen, begin, end, *columns, record)

    def _rays(self, params: FloatArray, pixels: FloatArray, wanted: bool) -> tuple[FloatArray, FloatArray]:
        """Rays (n, 3) of pixels, NaN where there are none, and if wanted their derivatives (n, 3, k)."""
        rays = self.camera.unproject(params, pixels)
        if not wanted:
            return rays, np.zeros((len(rays), 3, 0))
        _, by_ray, by_params = self.camera.project_jacobian(params, rays)
        equations = np.concatenate([by_ray, rays[:, None]], axis=1)
        known = np.concatenate([-by_params, np.zeros((len(rays), 1, by_params.shape[2]))], axis=1)
        good: BoolArray = np.asarray(np.isfinite(np.concatenate([equations, known], axis=2)).all(axis=(1, 2)))
        good[good] = np.abs(np.linalg.det(equations[good])) > _SINGULAR
        rays[~good], equations[~good], known[~good] = np.nan, np.eye(3), 0.0
        return rays, np.asarray(np.linalg.solve(equations, known), np.float64)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            line=Ref("lines", indices(rng, 4)),
            intrinsics=Ref("intrinsics", indices(rng, 2)),
            camera_model="RADIAL",
            segments=rng.uniform(100.0, 500.0, (6, 4)),
        )
        return pixel_example(factor, rng)
