# SPDX-License-Identifier: BSD-3-Clause
r"""A plane measured in the camera, as a normal and an offset: the metric form.

With the landmark (n, w), :math:`\hat n = n/\lVert n\rVert`, the prediction :math:`n_c = s R \hat n` and
:math:`w_c = s\,(w - t \cdot R n)/\lVert n\rVert`, the measured unit normal :math:`\tilde n` and offset :math:`\tilde w`
in the camera frame, and an orthonormal basis :math:`B = [b_1, b_2]` of the plane normal to :math:`\tilde n`,

.. math:: r = [\, B^\top n_c \,;\; w_c - \tilde w \,] \qquad \text{(sines of angles, scene units).}

The sign s = +-1 makes :math:`\tilde n \cdot n_c \ge 0`, because (n, w) and -(n, w) are one plane. For the left twist
:math:`(\rho, \omega)`, with :math:`f = w_c/s`

.. math:: \frac{\partial r}{\partial \xi} =
          \begin{bmatrix} 0 & -B^\top [n_c]_\times \\ -n_c^\top & 0 \end{bmatrix}, \qquad
          \frac{\partial r}{\partial (n, w)} = \frac{s}{\lVert n\rVert} \begin{bmatrix}
          B^\top R\,(I - \hat n \hat n^\top) & 0 \\ -(R^\top t + f \hat n)^\top & 1 \end{bmatrix} .

The noise is stated where it arises, in the camera: angles of the normal, and the distance. So the weight does not
depend on the origin of the world, unlike in :mod:`groma.factors.observations.plane_quaternion`. The offset is the
distance of the plane from the camera, so where the seen part lies aside of the foot point, errors of normal and offset
are correlated: pass the (3, 3) square root information in the basis B (:attr:`PlaneObservation.basis`).

Source: the measurement of Point-line-plane notes, section IV, with another residual. It jumps where the angle between
the normals reaches 90 degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example, visible_scene
from groma.factors._record import put_block, put_residual
from groma.factors._rig import EXTRINSICS, POSE, CameraFactor
from groma.factors.contract import Example, Measurement, Ref, Slot, register
from groma.geometry.charts.chart import perpendicular_kernel


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _linearize(T, plane, measured, B, r, J_pose, J_plane):
    """Write ``r`` (3,), ``J_pose`` (3, 6), ``J_plane`` (3, 4); False for the plane at infinity."""
    n0, n1, n2 = plane[0], plane[1], plane[2]
    nn = n0 * n0 + n1 * n1 + n2 * n2
    if not 1e-200 < nn < math.inf:
        return False
    k = 1.0 / math.sqrt(nn)
    c0 = (T[0] * n0 + T[1] * n1 + T[2] * n2) * k
    c1 = (T[4] * n0 + T[5] * n1 + T[6] * n2) * k
    c2 = (T[8] * n0 + T[9] * n1 + T[10] * n2) * k
    if c0 * measured[0] + c1 * measured[1] + c2 * measured[2] < 0.0:
        k, c0, c1, c2 = -k, -c0, -c1, -c2  # k is s/|n| from here on
    offset = plane[3] * k - (T[3] * c0 + T[7] * c1 + T[11] * c2)
    r[2] = offset - measured[3]
    if not abs(r[2]) < math.inf:
        return False
    perpendicular_kernel(measured[0], measured[1], measured[2], B)
    # n k = s n/|n| is the unit normal with the sign s
    for i in range(2):
        b0, b1, b2 = B[i, 0], B[i, 1], B[i, 2]
        r[i] = b0 * c0 + b1 * c1 + b2 * c2
        J_pose[i, 0], J_pose[i, 1], J_pose[i, 2] = 0.0, 0.0, 0.0
        J_pose[i, 3], J_pose[i, 4], J_pose[i, 5] = c1 * b2 - c2 * b1, c2 * b0 - c0 * b2, c0 * b1 - c1 * b0
        for j in range(3):
            J_plane[i, j] = k * (T[j] * b0 + T[4 + j] * b1 + T[8 + j] * b2 - r[i] * plane[j] * k)
        J_plane[i, 3] = 0.0
    J_pose[2, 0], J_pose[2, 1], J_pose[2, 2] = -c0, -c1, -c2
    J_pose[2, 3], J_pose[2, 4], J_pose[2, 5] = 0.0, 0.0, 0.0
    for j in range(3):
        J_plane[2, j] = -k * (T[j] * T[3] + T[4 + j] * T[7] + T[8 + j] * T[11] + offset * plane[j] * k)
    J_plane[2, 3] = k
    return True


@loop
def _linearize_all(poses, pose_index, planes, plane_index, measured, begin, end, pose_column, plane_column, record):
    r, B, J_pose, J_plane = np.empty(3), np.empty((2, 3)), np.empty((3, 6)), np.empty((3, 4))
    degenerate = 0
    for i in range(begin, end):
        if not _linearize(poses[pose_index[i]], planes[plane_index[i]], measured[i], B, r, J_pose, J_plane):
            r[:], J_pose[:], J_plane[:] = 0.0, 0.0, 0.0
            degenerate += 1
        row = record[i - begin]
        put_block(J_pose, row, pose_column)
        put_block(J_plane, row, plane_column)
        put_residual(r, row)
    return degenerate


@loop
def _basis_all(measured, out):
    B = np.empty((2, 3))
    for i in range(measured.shape[0]):
        perpendicular_kernel(measured[i, 0], measured[i, 1], measured[i, 2], B)
        for a in range(3):
            out[i, a, 0], out[i, a, 1] = B[0, a], B[1, a]


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, kw_only=True)
class PlaneInCamera(CameraFactor):
    """Planes measured in the camera: the base of this factor and of
    :mod:`groma.factors.observations.plane_quaternion`.
    """

    #: Planes in the world, any scale of (n, w).
    plane: Ref
    #: (N, 4) measured planes (n, w), camera frame; scaled on construction.
    planes_in_cam: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (POSE, Slot("plane", "plane"), EXTRINSICS)
    rows: ClassVar[int] = 3

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        factor = cls(
            pose=Ref("poses", indices(rng, 3)),
            plane=Ref("planes", indices(rng, 3)),
            planes_in_cam=rng.normal(size=(6, 4)),
        )
        return make_example(factor, rng, states={"poses": visible_scene(rng)["poses"]})


@register("plane_observation")
class PlaneObservation(PlaneInCamera):
    """Planes measured in the camera; residual: two sines of angles of the normal, and the offset in scene units.

    Degenerate: the plane at infinity, n = 0. The rows have different units: pass square root information matrices
    (N, 3, 3).
    """

    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("planes_in_cam", (4,), num_normalized=3),)

    @property
    def basis(self) -> FloatArray:
        """(N, 3, 2), the basis B of each measured normal, in which the first two rows of the residual are given."""
        out = np.empty((len(self), 3, 2))
        _basis_all(self.planes_in_cam, out)
        return out

    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        return _linearize_all(*inputs, self.plane.index, self.planes_in_cam, begin, end, *columns, record)
