# SPDX-License-Identifier: BSD-3-Clause
r"""A line lies on a plane.

With the Plücker line (m, d), the plane (n, w), unit vectors :math:`\hat d, \hat n`, and the point of the line closest
to an *anchor* a,

.. math:: c(a) = \frac{d \times m + (a \cdot d)\,d}{\lVert d\rVert^2}, \qquad
          h(a) = \frac{n \cdot c(a) + w}{\lVert n \rVert},

there are two forms, each with two rows:

:class:`LineOnPlane`
    :math:`r = [\,\hat d \cdot \hat n,\; h(a)\,]`: the sine of the angle and a distance.
:class:`SegmentOnPlane`
    :math:`r = [\,h(a_1),\; h(a_2)\,]`: the distances of the two ends of a segment; both rows in scene units, so no
    weight between angle and distance has to be chosen.

The anchor matters. Without one, h is taken at the foot point of the world origin, which may lie far from the segment
that was seen: a tiny angle then moves it by a lot, and moving the world changes the adjustment. Give the middle of the
segment, or use the second form with its ends. Anchors are constants, so they need not lie on the line.

Constants of the world do not move with it: a line that is a little askew then lies better on its plane if the whole
world slides along it. Where poses and landmarks may move together, give the ends e in the frame of a camera (R, t),

.. math:: a = R^\top (e - t), \qquad \frac{\partial h}{\partial (\rho, \omega)} = \left[-(Rg)^\top,\;
          -(e \times Rg)^\top\right], \qquad g = \frac{(\hat n \cdot d)\, d}{\lVert d\rVert^2}.

.. math:: \frac{\partial \hat d\cdot\hat n}{\partial d} = \frac{(\hat n - r_1 \hat d)^\top}{\lVert d\rVert}, \quad
          \frac{\partial \hat d\cdot\hat n}{\partial n} = \frac{(\hat d - r_1 \hat n)^\top}{\lVert n\rVert}

.. math:: \frac{\partial h}{\partial m} = \frac{(\hat n \times d)^\top}{\lVert d\rVert^2}, \quad
          \frac{\partial h}{\partial d} = \frac{(m \times \hat n + (a \cdot d)\,\hat n + (\hat n \cdot d)\,a
          - 2 (\hat n \cdot c)\, d)^\top}{\lVert d\rVert^2}, \quad
          \frac{\partial h}{\partial (n, w)} = \frac{[\,(c - h \hat n)^\top,\; 1\,]}{\lVert n\rVert}
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import kernel, loop
from groma._typing import Columns, FloatArray, Inputs
from groma.factors._examples import indices, make_example, random_poses
from groma.factors._measured import set_rows
from groma.factors._record import put_block, put_residual
from groma.factors.contract import WORLD_FIXED, Example, Factor, Invariance, Measurement, Ref, Slot, register


# ------------------------------------------------------------------------------------------------------------ Kernels
@kernel
def _angle_row(line, plane, r, J_line, J_plane):
    """Write row 0: sine of the angle between line and plane."""
    kd = 1.0 / math.sqrt(line[3] * line[3] + line[4] * line[4] + line[5] * line[5])
    kn = 1.0 / math.sqrt(plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2])
    sine = (line[3] * plane[0] + line[4] * plane[1] + line[5] * plane[2]) * kd * kn
    r[0] = sine
    for j in range(3):
        J_line[0, j] = 0.0
        J_line[0, 3 + j] = (plane[j] * kn - sine * line[3 + j] * kd) * kd
        J_plane[0, j] = (line[3 + j] * kd - sine * plane[j] * kn) * kn
    J_plane[0, 3] = 0.0


@kernel
def _distance_row(row, line, plane, a, r, J_line, J_plane):
    """Write row ``row``: distance from the plane of the line's point closest to the anchor ``a``."""
    m0, m1, m2, d0, d1, d2 = line[0], line[1], line[2], line[3], line[4], line[5]
    k2 = 1.0 / (d0 * d0 + d1 * d1 + d2 * d2)
    kn = 1.0 / math.sqrt(plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2])
    n0, n1, n2 = plane[0] * kn, plane[1] * kn, plane[2] * kn
    ad = a[0] * d0 + a[1] * d1 + a[2] * d2
    nd = n0 * d0 + n1 * d1 + n2 * d2
    c0 = (d1 * m2 - d2 * m1 + ad * d0) * k2
    c1 = (d2 * m0 - d0 * m2 + ad * d1) * k2
    c2 = (d0 * m1 - d1 * m0 + ad * d2) * k2
    nc = n0 * c0 + n1 * c1 + n2 * c2
    h = nc + plane[3] * kn
    r[row] = h
    J_line[row, 0] = (n1 * d2 - n2 * d1) * k2
    J_line[row, 1] = (n2 * d0 - n0 * d2) * k2
    J_line[row, 2] = (n0 * d1 - n1 * d0) * k2
    J_line[row, 3] = (m1 * n2 - m2 * n1 + ad * n0 + nd * a[0] - 2.0 * nc * d0) * k2
    J_line[row, 4] = (m2 * n0 - m0 * n2 + ad * n1 + nd * a[1] - 2.0 * nc * d1) * k2
    J_line[row, 5] = (m0 * n1 - m1 * n0 + ad * n2 + nd * a[2] - 2.0 * nc * d2) * k2
    J_plane[row, 0] = (c0 - h * n0) * kn
    J_plane[row, 1] = (c1 - h * n1) * kn
    J_plane[row, 2] = (c2 - h * n2) * kn
    J_plane[row, 3] = kn


@kernel
def _place_in_world(pose, e, a):
    """Write the place in the world ``a`` of one in the camera ``e``."""
    x, y, z = e[0] - pose[3], e[1] - pose[7], e[2] - pose[11]
    for j in range(3):
        a[j] = pose[j] * x + pose[4 + j] * y + pose[8 + j] * z


@kernel
def _put_pose(row, line, plane, pose, e, out, c):
    """Write row ``row`` of the block of the pose that carries the anchor."""
    d0, d1, d2 = line[3], line[4], line[5]
    nn = plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]
    k = (plane[0] * d0 + plane[1] * d1 + plane[2] * d2) / (math.sqrt(nn) * (d0 * d0 + d1 * d1 + d2 * d2))
    h0 = k * (pose[0] * d0 + pose[1] * d1 + pose[2] * d2)
    h1 = k * (pose[4] * d0 + pose[5] * d1 + pose[6] * d2)
    h2 = k * (pose[8] * d0 + pose[9] * d1 + pose[10] * d2)
    out[row, c], out[row, c + 1], out[row, c + 2] = -h0, -h1, -h2
    out[row, c + 3], out[row, c + 4] = h1 * e[2] - h2 * e[1], h2 * e[0] - h0 * e[2]
    out[row, c + 5] = h0 * e[1] - h1 * e[0]


@loop
def _linearize_in_cameras(ends, rows, indices, begin, end, columns, record):
    lines, planes, poses = rows
    a, r, J_line, J_plane = np.empty(3), np.empty(2), np.empty((2, 6)), np.empty((2, 4))
    degenerate, c = 0, columns[2]
    for i in range(begin, end):
        line, plane, pose = lines[indices[0][i]], planes[indices[1][i]], poses[indices[2][i]]
        out = record[i - begin]
        dd = line[3] * line[3] + line[4] * line[4] + line[5] * line[5]
        nn = plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]
        if dd > 1e-200 and nn > 1e-200:
            for k in range(2):
                _place_in_world(pose, ends[i, k], a)
                _distance_row(k, line, plane, a, r, J_line, J_plane)
                if c >= 0:
                    _put_pose(k, line, plane, pose, ends[i, k], out, c)
        else:
            r[:], J_line[:], J_plane[:] = 0.0, 0.0, 0.0
            degenerate += 1
            if c >= 0:
                out[:, c : c + 6] = 0.0
        put_block(J_line, out, columns[0])
        put_block(J_plane, out, columns[1])
        put_residual(r, out)
    return degenerate


@loop
def _linearize_all(
    with_angle, anchors, lines, planes, line_index, plane_index, begin, end, line_column, plane_column, record
):
    r, J_line, J_plane = np.empty(2), np.empty((2, 6)), np.empty((2, 4))
    degenerate = 0
    for i in range(begin, end):
        line, plane = lines[line_index[i]], planes[plane_index[i]]
        dd = line[3] * line[3] + line[4] * line[4] + line[5] * line[5]
        nn = plane[0] * plane[0] + plane[1] * plane[1] + plane[2] * plane[2]
        if dd > 1e-200 and nn > 1e-200:
            if with_angle:
                _angle_row(line, plane, r, J_line, J_plane)
            else:
                _distance_row(0, line, plane, anchors[i, 0], r, J_line, J_plane)
            _distance_row(1, line, plane, anchors[i, -1], r, J_line, J_plane)
        else:
            r[:], J_line[:], J_plane[:] = 0.0, 0.0, 0.0
            degenerate += 1
        put_block(J_line, record[i - begin], line_column)
        put_block(J_plane, record[i - begin], plane_column)
        put_residual(r, record[i - begin])
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, kw_only=True)
class _LineAndPlane(Factor):
    """What both forms share."""

    #: The lines, any scale of (m, d).
    line: Ref
    #: The planes, any scale of (n, w).
    plane: Ref

    slots: ClassVar[tuple[Slot, ...]] = (Slot("line", "line"), Slot("plane", "plane"))
    invariance: ClassVar[Invariance] = WORLD_FIXED  # anchors and ends are world points
    is_incidence: ClassVar[bool] = True
    rows: ClassVar[int] = 2

    def _evaluate(
        self,
        with_angle: bool,
        anchors: FloatArray,
        inputs: tuple[Any, ...],
        begin: int,
        end: int,
        columns: tuple[int, ...],
        record: FloatArray,
    ) -> int:
        (lines, planes), (i, j), lines_of, planes_of = inputs, columns, self.line.index, self.plane.index
        return _linearize_all(with_angle, anchors, lines, planes, lines_of, planes_of, begin, end, i, j, record)


@register("line_on_plane")
@dataclass(frozen=True, kw_only=True)
class LineOnPlane(_LineAndPlane):
    """Lines on planes; rows: sine of the angle, distance at the anchor (scene units).

    Degenerate for a line or plane at infinity. Row 0 and row 1 have different units: pass square root information
    matrices (N, 2, 2), or use :class:`SegmentOnPlane`.
    """

    #: (N, 3) a world point near each segment, its middle for example; None takes the world origin.
    anchor: FloatArray | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.anchor is not None:
            set_rows(self, "anchor", 3)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        anchors = np.zeros((len(self), 1, 3)) if self.anchor is None else self.anchor[:, None]
        return self._evaluate(True, anchors, inputs, begin, end, columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        line, plane = Ref("lines", indices(rng, 5)), Ref("planes", indices(rng, 3))
        return make_example(cls(line=line, plane=plane, anchor=rng.normal(size=(6, 3))), rng)


@register("segment_on_plane")
@dataclass(frozen=True, kw_only=True)
class SegmentOnPlane(_LineAndPlane):
    """Line segments on planes; rows: distances of the line from the plane near both ends (scene units).

    Degenerate for a line or plane at infinity.
    """

    #: The cameras in whose frames the ends are; None: they are in the world.
    frame: Ref | None = None
    #: (N, 2, 3) places near the two ends of each segment.
    ends: FloatArray

    slots: ClassVar[tuple[Slot, ...]] = (*_LineAndPlane.slots, Slot("frame", "pose", optional=True))

    measurements: ClassVar[tuple[Measurement, ...]] = (Measurement("ends", (2, 3)),)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        if self.frame is None:
            return self._evaluate(False, self.ends, inputs, begin, end, columns, record)
        indices = self.line.index, self.plane.index, self.frame.index
        return _linearize_in_cameras(self.ends, inputs, indices, begin, end, columns, record)

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        line, plane = Ref("lines", indices(rng, 5)), Ref("planes", indices(rng, 3))
        return make_example(cls(line=line, plane=plane, ends=rng.normal(size=(6, 2, 3))), rng)

    @classmethod
    def in_cameras(cls, rng: np.random.Generator) -> Example:
        """Return an example whose ends are in the frames of cameras."""
        line, plane, frame = (Ref(name, indices(rng, 3)) for name in ("lines", "planes", "poses"))
        factor = cls(line=line, plane=plane, frame=frame, ends=rng.normal(size=(6, 2, 3)))
        return make_example(factor, rng, states={"poses": random_poses(rng, 3, rotation=0.7)})
