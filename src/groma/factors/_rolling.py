# SPDX-License-Identifier: BSD-3-Clause
r"""Cameras with a rolling shutter: the pose of the row at which something was seen.

While an image is read the camera moves by c and turns by :math:`\omega`, in the axes that it has in the middle. At the
fraction s of the readout, from -1/2 to 1/2, a point :math:`X_c` in the frame of the middle is

.. math:: X_s = R_s\,(X_c - s\,c), \qquad R_s = \mathrm{Exp}(-s\,\omega), \qquad
          T_s = \begin{bmatrix} R_s & -s\,R_s\,c \end{bmatrix}, \qquad T_{cw}(s) = T_s\, T_{cw} .

With the derivative :math:`[\,a^\top, b^\top\,]` of a residual by the left twist of :math:`T_{cw}(s)`,

.. math:: J_{cw} = [\,a^\top, b^\top\,]\, \mathrm{Ad}(T_s), \qquad
          J_c = -s\, a^\top R_s, \qquad J_\omega = -s\, b^\top\, \mathbf{J}_l(-s\,\omega)

with the left Jacobian :math:`\mathbf{J}_l` of SO(3), because turning moves what was shifted before. The fraction is
that of the row where something was **observed**, not of the row where it is predicted: the difference is the residual,
some tenths of a pixel, times the motion of one row.
"""

from __future__ import annotations

import numpy as np

from groma._numba import kernel, loop
from groma.geometry.se3 import compose_kernel
from groma.geometry.so3 import exp_kernel, left_jacobian_kernel


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _pose_of_row(motion, s, R, T):
    """Write R_s (9,) and T_s (12,), row-major."""
    exp_kernel(-s * motion[3], -s * motion[4], -s * motion[5], R)
    for i in range(3):
        T[4 * i], T[4 * i + 1], T[4 * i + 2] = R[3 * i], R[3 * i + 1], R[3 * i + 2]
        T[4 * i + 3] = -s * (R[3 * i] * motion[0] + R[3 * i + 1] * motion[1] + R[3 * i + 2] * motion[2])


@kernel
def move_back(line, source, T, column):
    """Write the derivative at ``source``, by the left twist of T A, as that by the left twist of A: times Ad(T)."""
    a0, a1, a2 = line[source], line[source + 1], line[source + 2]
    # the lever arm: aᵀ [t]x = (a x t)ᵀ
    b0 = line[source + 3] + a1 * T[11] - a2 * T[7]
    b1 = line[source + 4] + a2 * T[3] - a0 * T[11]
    b2 = line[source + 5] + a0 * T[7] - a1 * T[3]
    for j in range(3):
        line[column + j] = a0 * T[j] + a1 * T[4 + j] + a2 * T[8 + j]
        line[column + 3 + j] = b0 * T[j] + b1 * T[4 + j] + b2 * T[8 + j]


@loop
def compose_rows(motions, motion_index, offsets, mounted, mounted_index, bodies, body_index, out):
    """Write the poses (K N, 12) of the rows of each factor: first those at ``offsets[:, 0]``, then [:, 1], ...

    ``mounted`` are cam_from_body, or of length zero where bodies are cameras.
    """
    R, T, A = np.empty(9), np.empty(12), np.empty(12)
    count = offsets.shape[0]
    for k in range(offsets.shape[1]):
        for i in range(count):
            _pose_of_row(motions[motion_index[i]], offsets[i, k], R, T)
            if mounted.shape[0] == 0:
                compose_kernel(T, bodies[body_index[i]], out[k * count + i])
            else:
                compose_kernel(mounted[mounted_index[i]], bodies[body_index[i]], A)
                compose_kernel(T, A, out[k * count + i])


@loop
def split_rows(
    record, begin, source, motions, motion_index, offsets, mounted, mounted_index,
    pose_column, mounted_column, motion_column,
):  # fmt: skip
    """Turn the block by T_cw(s), found at ``source``, into those by motion, cam_from_body and body_from_world."""
    R, T, w, J, S = np.empty(9), np.empty(12), np.empty(3), np.empty((3, 3)), np.empty(6)
    ends = offsets.shape[1]
    for i in range(record.shape[0]):
        m = motion_index[begin + i]
        for row in range(record.shape[1]):
            line, s = record[i, row], offsets[begin + i, min(row, ends - 1)]
            _pose_of_row(motions[m], s, R, T)
            for j in range(3):
                w[j] = -s * motions[m, 3 + j]
            left_jacobian_kernel(w, J)
            for j in range(6):
                S[j] = line[source + j]
            if motion_column >= 0:
                for j in range(3):
                    line[motion_column + j] = -s * (S[0] * R[j] + S[1] * R[3 + j] + S[2] * R[6 + j])
                    line[motion_column + 3 + j] = -s * (S[3] * J[0, j] + S[4] * J[1, j] + S[5] * J[2, j])
            move_back(S, 0, T, 0)
            if mounted_column >= 0:
                for j in range(6):
                    line[mounted_column + j] = S[j]
            if pose_column >= 0:
                if mounted.shape[0] > 0:
                    move_back(S, 0, mounted[mounted_index[begin + i]], 0)
                for j in range(6):
                    line[pose_column + j] = S[j]
