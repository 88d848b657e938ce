# SPDX-License-Identifier: BSD-3-Clause
r"""What all factors seen by a camera share: the pose of the camera, alone or in a rig, at once or row by row.

Such a factor has a slot ``pose``. Alone it is ``cam_from_world``, :math:`T_{cw}`. With the optional slot
``extrinsics``, which holds ``cam_from_body``, :math:`T_{cb}`, the slot ``pose`` is ``body_from_world``, and

.. math:: T_{cw} = T_{cb}\, T_{bw}, \qquad
          J_{cb} = J_{cw}, \qquad J_{bw} = J_{cw}\, \mathrm{Ad}(T_{cb}), \qquad
          \mathrm{Ad}(T) = \begin{bmatrix} R & [t]_\times R \\ 0 & R \end{bmatrix}

for left increments in the order :math:`(\rho, \omega)`. So the concrete factors know :math:`T_{cw}` only:
:meth:`CameraFactor.prepare` composes it once per pair of body and sensor that occurs, and
:meth:`CameraFactor.linearize` applies the chain rule to the finished records. So it does for cameras that move while
their images are read (slot ``motion``, :mod:`groma.factors._rolling`): each factor then has poses of its own.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs, IntArray
from groma.errors import InputError, ShapeError
from groma.factors._rolling import compose_rows, move_back, split_rows
from groma.factors.contract import Factor, Ref, Slot
from groma.geometry.se3 import compose_kernel

POSE = Slot("pose", "pose")
EXTRINSICS = Slot("extrinsics", "pose", optional=True, in_world=False)
#: How the camera moves while an image is read: six numbers, see :mod:`groma.factors._rolling`.
MOTION = Slot("motion", "vector", optional=True, in_world=False)
_NOT_MOUNTED, _NOWHERE = np.zeros((0, 12)), np.zeros(0, np.int32)


# ------------------------------------------------------------------------------------------------------------ Kernels
# Numba counts references to the arrays that a kernel passes on or branches around, with atomic instructions (5 ns
# each). It drops the counting in straight kernels that call nothing. So these have no branches, and the loops call them
# one by one: that took the linearisation of a point from 150 ns to 17 ns. What clears the rare degenerate records has
# branches, and is a function that is called, not a kernel that is inlined.


@kernel
def transform_point(poses, c, points, p, P):
    """Write P = R X + t (3,) for row ``c`` of ``poses`` (M, 12) and row ``p`` of ``points`` (P, 3)."""
    x, y, z = points[p, 0], points[p, 1], points[p, 2]
    P[0] = poses[c, 0] * x + poses[c, 1] * y + poses[c, 2] * z + poses[c, 3]
    P[1] = poses[c, 4] * x + poses[c, 5] * y + poses[c, 6] * z + poses[c, 7]
    P[2] = poses[c, 8] * x + poses[c, 9] * y + poses[c, 10] * z + poses[c, 11]


@kernel
def put_point_pose(a0, a1, a2, P, record, i, row, column):
    """Write the pose block [a, P x a] of one residual row with derivative ``a`` by the point ``P`` in the camera."""
    record[i, row, column] = a0
    record[i, row, column + 1] = a1
    record[i, row, column + 2] = a2
    record[i, row, column + 3] = P[1] * a2 - P[2] * a1
    record[i, row, column + 4] = P[2] * a0 - P[0] * a2
    record[i, row, column + 5] = P[0] * a1 - P[1] * a0


@kernel
def put_point(a0, a1, a2, poses, c, record, i, row, column):
    """Write the point block a R of one residual row with derivative ``a`` by the point in the camera."""
    record[i, row, column] = a0 * poses[c, 0] + a1 * poses[c, 4] + a2 * poses[c, 8]
    record[i, row, column + 1] = a0 * poses[c, 1] + a1 * poses[c, 5] + a2 * poses[c, 9]
    record[i, row, column + 2] = a0 * poses[c, 2] + a1 * poses[c, 6] + a2 * poses[c, 10]


@kernel
def transform_line(poses, c, lines, j, L):
    """Write L = (m, d) (6,) in the camera frame; False if the line passes through the camera centre, to rounding.

    m_c = R m + t x R d, d_c = R d. The limit is 1e-9 of the two terms of m_c.
    """
    m0, m1, m2, d0, d1, d2 = lines[j, 0], lines[j, 1], lines[j, 2], lines[j, 3], lines[j, 4], lines[j, 5]
    t0, t1, t2 = poses[c, 3], poses[c, 7], poses[c, 11]
    L[3] = poses[c, 0] * d0 + poses[c, 1] * d1 + poses[c, 2] * d2
    L[4] = poses[c, 4] * d0 + poses[c, 5] * d1 + poses[c, 6] * d2
    L[5] = poses[c, 8] * d0 + poses[c, 9] * d1 + poses[c, 10] * d2
    L[0] = poses[c, 0] * m0 + poses[c, 1] * m1 + poses[c, 2] * m2 + (t1 * L[5] - t2 * L[4])
    L[1] = poses[c, 4] * m0 + poses[c, 5] * m1 + poses[c, 6] * m2 + (t2 * L[3] - t0 * L[5])
    L[2] = poses[c, 8] * m0 + poses[c, 9] * m1 + poses[c, 10] * m2 + (t0 * L[4] - t1 * L[3])
    terms = m0 * m0 + m1 * m1 + m2 * m2 + (t0 * t0 + t1 * t1 + t2 * t2) * (d0 * d0 + d1 * d1 + d2 * d2)
    return L[0] * L[0] + L[1] * L[1] + L[2] * L[2] > 1e-18 * terms


@kernel
def put_line_pose(g0, g1, g2, h0, h1, h2, L, record, i, row, column):
    """Write the pose block [d x g, m x g + d x h] of one row with derivatives g, h by m, d of ``L`` in the camera."""
    record[i, row, column] = L[4] * g2 - L[5] * g1
    record[i, row, column + 1] = L[5] * g0 - L[3] * g2
    record[i, row, column + 2] = L[3] * g1 - L[4] * g0
    record[i, row, column + 3] = L[1] * g2 - L[2] * g1 + L[4] * h2 - L[5] * h1
    record[i, row, column + 4] = L[2] * g0 - L[0] * g2 + L[5] * h0 - L[3] * h2
    record[i, row, column + 5] = L[0] * g1 - L[1] * g0 + L[3] * h1 - L[4] * h0


@kernel
def put_line(g0, g1, g2, h0, h1, h2, poses, c, record, i, row, column):
    """Write the line block [gᵀ R, (g x t + h)ᵀ R] of one row with derivatives g, h by m, d in the camera."""
    t0, t1, t2 = poses[c, 3], poses[c, 7], poses[c, 11]
    k0, k1, k2 = g1 * t2 - g2 * t1 + h0, g2 * t0 - g0 * t2 + h1, g0 * t1 - g1 * t0 + h2
    record[i, row, column] = g0 * poses[c, 0] + g1 * poses[c, 4] + g2 * poses[c, 8]
    record[i, row, column + 1] = g0 * poses[c, 1] + g1 * poses[c, 5] + g2 * poses[c, 9]
    record[i, row, column + 2] = g0 * poses[c, 2] + g1 * poses[c, 6] + g2 * poses[c, 10]
    record[i, row, column + 3] = k0 * poses[c, 0] + k1 * poses[c, 4] + k2 * poses[c, 8]
    record[i, row, column + 4] = k0 * poses[c, 1] + k1 * poses[c, 5] + k2 * poses[c, 9]
    record[i, row, column + 5] = k0 * poses[c, 2] + k1 * poses[c, 6] + k2 * poses[c, 10]


@loop
def clear_block(record, i, column, size):
    """Write zeros to a block of all rows of record ``i``; -1 means it is not wanted."""
    if column >= 0:
        for row in range(record.shape[1]):
            for j in range(size):
                record[i, row, column + j] = 0.0


@loop
def clear_record(record, i, pose_column, landmark_column, landmark_size, intrinsics_column, intrinsics_size):
    """Write zeros to the residual and to the blocks of record ``i`` that are wanted (columns of -1 are not)."""
    for row in range(record.shape[1]):
        record[i, row, record.shape[2] - 1] = 0.0
        if pose_column >= 0:
            for j in range(6):
                record[i, row, pose_column + j] = 0.0
        if landmark_column >= 0:
            for j in range(landmark_size):
                record[i, row, landmark_column + j] = 0.0
        if intrinsics_column >= 0:
            for j in range(intrinsics_size):
                record[i, row, intrinsics_column + j] = 0.0


@loop
def _compose_all(extrinsics, bodies, extrinsics_index, body_index, out):
    for i in range(out.shape[0]):
        compose_kernel(extrinsics[extrinsics_index[i]], bodies[body_index[i]], out[i])


@loop
def _split_all(record, begin, extrinsics, extrinsics_index, source, pose_column, extrinsics_column):
    """Turn the block J_cw, found at ``source``, into J_cb = J_cw and J_bw = J_cw Ad(T_cb)."""
    for i in range(record.shape[0]):
        T = extrinsics[extrinsics_index[begin + i]]
        for row in range(record.shape[1]):
            line = record[i, row]
            if extrinsics_column >= 0 and extrinsics_column != source:
                for j in range(6):
                    line[extrinsics_column + j] = line[source + j]
            if pose_column >= 0:
                move_back(line, source, T, pose_column)


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, kw_only=True)
class CameraFactor(Factor):
    """A factor that reads the pose of a camera first; subclasses list :data:`POSE` first, :data:`EXTRINSICS` last.

    Those that may be seen by a rolling shutter list :data:`MOTION` behind it.
    """

    #: Poses cam_from_world; body_from_world where ``extrinsics`` are given.
    pose: Ref
    #: Poses cam_from_body of the cameras in their rig, or None.
    extrinsics: Ref | None = None
    #: Motions of the cameras while their images are read, or None; with ``offsets``.
    motion: Ref | None = None
    #: (N, 1) or (N, m) when in the readout, from -1/2 to 1/2, a factor or each row of its residual was seen; or None.
    offsets: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check the offsets too."""
        super().__post_init__()
        if self.motion is not None:
            self._check_offsets()

    def _check_offsets(self) -> None:
        offsets = np.ascontiguousarray(self.offsets, dtype=np.float64)
        if MOTION not in self.slots:
            raise InputError(f"{type(self).__name__} knows no rolling shutter. Leave its motion out.")
        if offsets.ndim != 2 or len(offsets) != len(self) or offsets.shape[1] not in (1, self.residual_size):
            raise ShapeError(
                f"{type(self).__name__}.offsets must have shape ({len(self)}, 1) or ({len(self)}, "
                f"{self.residual_size}), one row for each motion; got {offsets.shape}."
            )
        object.__setattr__(self, "offsets", offsets)
        if self.invariance is not None:  # the shift is a length
            object.__setattr__(self, "invariance", replace(self.invariance, scale=False))

    @cached_property
    def _pairs(self) -> tuple[IntArray, IntArray, IntArray]:
        """The pairs (extrinsics, pose) that occur, and for each factor its pair."""
        assert self.extrinsics is not None
        bodies = self.pose.index.astype(np.int64)
        key = self.extrinsics.index.astype(np.int64) * (bodies.max(initial=0) + 1) + bodies
        _, first, inverse = np.unique(key, return_index=True, return_inverse=True)
        return self.extrinsics.index[first], self.pose.index[first], inverse.astype(np.int32)

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:
        """Return (extrinsics or None, cam_from_world (M, 12), its index (N,), the other ambient arrays...)."""
        ambients = tuple(np.ascontiguousarray(ambient, dtype=np.float64) for ambient in ambients)
        if self.motion is not None:
            return self._prepare_rows(ambients)
        if self.extrinsics is None:
            return None, ambients[0], self.pose.index, *ambients[1:]
        extrinsics_index, pose_index, index = self._pairs
        cam_from_world = np.empty((len(pose_index), 12))
        _compose_all(ambients[-1], ambients[0], extrinsics_index, pose_index, cam_from_world)
        return ambients[-1], cam_from_world, index, *ambients[1:-1]

    def _prepare_rows(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:
        """Return ((mounted, motions), poses of the rows (K N, 12), the first of each factor (N,), others...)."""
        assert self.motion is not None and self.offsets is not None
        mounted = _NOT_MOUNTED if self.extrinsics is None else ambients[-2]
        index = _NOWHERE if self.extrinsics is None else self.extrinsics.index
        poses, motions = np.empty((self.offsets.size, 12)), ambients[-1]
        compose_rows(motions, self.motion.index, self.offsets, mounted, index, ambients[0], self.pose.index, poses)
        others = ambients[1:-1] if self.extrinsics is None else ambients[1:-2]
        return (mounted, motions), poses, np.arange(len(self), dtype=np.int32), *others

    def residuals(self, inputs: tuple[Any, ...], begin: int, end: int, out: FloatArray) -> int:
        """See :meth:`Factor.residuals`."""
        return self._evaluate_rows(inputs, begin, end, self._nothing_wanted, out[:, :, None])

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:
        """See :meth:`Factor.linearize`."""
        if self.motion is not None:
            return self._linearize_rows(inputs, begin, end, columns, record)
        if self.extrinsics is None:
            return self.evaluate(inputs[1:], begin, end, columns, record)
        pose_column, extrinsics_column = columns[0], columns[-1]
        source = pose_column if pose_column >= 0 else extrinsics_column
        degenerate = self.evaluate(inputs[1:], begin, end, (source, *columns[1:-1]), record)
        if source >= 0:
            _split_all(record, begin, inputs[0], self.extrinsics.index, source, pose_column, extrinsics_column)
        return degenerate

    def _linearize_rows(
        self, inputs: tuple[Any, ...], begin: int, end: int, columns: tuple[int, ...], record: FloatArray
    ) -> int:
        """Linearise at the poses of the rows, and apply the chain rule to motion, extrinsics and pose."""
        assert self.motion is not None and self.offsets is not None
        alone = self.extrinsics is None
        pose, mounted, motion = columns[0], -1 if alone else columns[-2], columns[-1]
        source, middle = max(pose, mounted, motion), columns[1:-1] if alone else columns[1:-2]
        degenerate = self._evaluate_rows(inputs, begin, end, (source, *middle), record)
        if source >= 0:
            index = _NOWHERE if self.extrinsics is None else self.extrinsics.index
            split_rows(
                record, begin, source, inputs[0][1], self.motion.index, self.offsets, inputs[0][0], index,
                pose, mounted, motion,
            )  # fmt: skip
        return degenerate

    def _evaluate_rows(
        self, inputs: tuple[Any, ...], begin: int, end: int, columns: tuple[int, ...], record: FloatArray
    ) -> int:
        """Evaluate once, or once for each row of the residual where rows were seen at different times."""
        degenerate = self.evaluate(inputs[1:], begin, end, columns, record)
        times = 1 if self.offsets is None else self.offsets.shape[1]
        for row in range(1, times):
            again, later = record.copy(), inputs[2] + np.int32(row * len(self))
            found = self.evaluate((inputs[1], later, *inputs[3:]), begin, end, columns, again)
            record[:, row], degenerate = again[:, row], max(degenerate, found)
        return degenerate

    @cached_property
    def _nothing_wanted(self) -> tuple[int, ...]:
        return (-1,) * sum(slot not in (EXTRINSICS, MOTION) for slot in self.slots)

    @abstractmethod
    def evaluate(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:
        """Write the records as :meth:`Factor.linearize` does, for poses of single cameras.

        ``inputs`` are cam_from_world (M, 12), its index (N,), and the other ambient arrays; ``columns`` belong to all
        slots but the extrinsics. With a record of width one only the residual is written.
        """
