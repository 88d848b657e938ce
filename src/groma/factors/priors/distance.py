# SPDX-License-Identifier: BSD-3-Clause
r"""The distance between two objects is known: a scale bar, a tape, the base of a stereo head, the height above a floor.

From a place q on the first, a camera's centre, a point, or the foot on a line or plane
(:mod:`groma.factors.priors._places`), the shortest way to the second, :math:`r = \delta - \tilde d` with

.. math:: \delta = \lVert q - q' \rVert, \qquad
          \delta = \frac{\lVert q \times d - m \rVert}{\lVert d \rVert}, \qquad
          \delta = \frac{|n \cdot q + w|}{\lVert n \rVert}

to a camera or point q', to a line and to a plane. With the unit vectors :math:`u = (q-q')/\delta`,
:math:`v = (q\times d - m)/(\delta\lVert d\rVert)`, :math:`\hat n` and the side :math:`\sigma = \pm 1`

.. math:: \frac{\partial r}{\partial q} = u^\top,\; \frac{(d\times v)^\top}{\lVert d\rVert},\;
          \sigma\hat n^\top, \qquad
          \frac{\partial r}{\partial (m, d)} = \frac{1}{\lVert d\rVert}\left[-v^\top,\;
          \Big(v\times q - \delta\frac{d}{\lVert d\rVert}\Big)^{\!\top}\right], \qquad
          \frac{\partial r}{\partial (n, w)} = \frac{\sigma}{\lVert n\rVert}
          \left[(q - \sigma\delta\hat n)^\top,\; 1\right].

Between two lines it is that from the place on the first, which has a meaning for parallel ones; of skew lines it is
the shortest of all, from where the first is nearest to the second,

.. math:: q = \frac{k \cdot m'\, d - m \times (d' \times k)}{\lVert k\rVert^2}, \qquad k = d \times d' .

The derivatives are those above: the way is at right angles to both lines, so it does not matter to first order that q
moves along the first. Where two objects touch the direction of the way is not defined, and the factor is degenerate.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from groma._numba import loop
from groma._typing import BoolArray, Columns, FloatArray, Inputs
from groma.errors import ShapeError
from groma.factors._examples import make_example, random_poses
from groma.factors.contract import Example, Factor, Measurement, Ref, Slot, register
from groma.factors.priors._places import KINDS, place_on, put_place


# ------------------------------------------------------------------------------------------------------------ Kernels
@loop
def _to_second(kind, row, arm, q, p, u, out, c):
    """Return the distance of q from the second object, with u its derivative by q; write the block of the second."""
    size = 0.0
    if kind <= 1:
        place_on(kind, row, arm, p)
        for j in range(3):
            u[j] = q[j] - p[j]
        size = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])
        if not 0.0 < size < math.inf:
            return 0.0
        for j in range(3):
            u[j] /= size
            p[j] = -u[j]
        if c >= 0:
            put_place(kind, row, arm, q, p, out, c)
    elif kind == 2:
        m0, m1, m2, d0, d1, d2 = row[0], row[1], row[2], row[3], row[4], row[5]
        length = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        v0, v1, v2 = q[1] * d2 - q[2] * d1 - m0, q[2] * d0 - q[0] * d2 - m1, q[0] * d1 - q[1] * d0 - m2
        moment = math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
        if not (length > 1e-100 and 0.0 < moment < math.inf):
            return 0.0
        size, v0, v1, v2 = moment / length, v0 / moment, v1 / moment, v2 / moment
        u[0], u[1], u[2] = (d1 * v2 - d2 * v1) / length, (d2 * v0 - d0 * v2) / length, (d0 * v1 - d1 * v0) / length
        if c >= 0:
            shrink = size / (length * length)
            out[c], out[c + 1], out[c + 2] = -v0 / length, -v1 / length, -v2 / length
            out[c + 3] = (v1 * q[2] - v2 * q[1]) / length - shrink * d0
            out[c + 4] = (v2 * q[0] - v0 * q[2]) / length - shrink * d1
            out[c + 5] = (v0 * q[1] - v1 * q[0]) / length - shrink * d2
    else:
        length = math.sqrt(row[0] * row[0] + row[1] * row[1] + row[2] * row[2])
        if not length > 1e-100:
            return 0.0
        signed = (row[0] * q[0] + row[1] * q[1] + row[2] * q[2] + row[3]) / length
        side = 1.0 if signed > 0.0 else -1.0
        size = side * signed
        for j in range(3):
            u[j] = side * row[j] / length
        if c >= 0:
            for j in range(3):
                out[c + j] = side * (q[j] - signed * row[j] / length) / length
            out[c + 3] = side / length
    return size


@loop
def _nearest_place(one, two, q):
    """Write the place q on the first line that is nearest to the second; return whether there is one."""
    m0, m1, m2, d0, d1, d2 = one[0], one[1], one[2], one[3], one[4], one[5]
    e0, e1, e2 = two[3], two[4], two[5]
    k0, k1, k2 = d1 * e2 - d2 * e1, d2 * e0 - d0 * e2, d0 * e1 - d1 * e0
    kk = k0 * k0 + k1 * k1 + k2 * k2
    if not kk > 1e-16 * (d0 * d0 + d1 * d1 + d2 * d2) * (e0 * e0 + e1 * e1 + e2 * e2):
        return False
    c0, c1, c2 = e1 * k2 - e2 * k1, e2 * k0 - e0 * k2, e0 * k1 - e1 * k0
    along = k0 * two[0] + k1 * two[1] + k2 * two[2]
    q[0] = (along * d0 - m1 * c2 + m2 * c1) / kk
    q[1] = (along * d1 - m2 * c0 + m0 * c2) / kk
    q[2] = (along * d2 - m0 * c1 + m1 * c0) / kk
    return True


@loop
def _linearize_all(rows, index, kinds, first_arm, second_arm, is_shortest, distances, begin, end, columns, record):
    q, p, u = np.empty(3), np.empty(3), np.empty(3)
    degenerate, last = 0, record.shape[2] - 1
    for i in range(begin, end):
        out = record[i - begin, 0]
        first, second, a, b = rows[0][index[0][i]], rows[1][index[1][i]], first_arm[i], second_arm[i]
        if is_shortest[i]:
            found, a = _nearest_place(first, second, q), q
        else:
            found = place_on(kinds[0], first, a, q)
        size = _to_second(kinds[1], second, b, q, p, u, out, columns[1]) if found else 0.0
        if size > 0.0:
            out[last] = size - distances[i]
            if columns[0] >= 0:
                put_place(kinds[0], first, a, q, u, out, columns[0])
            continue
        degenerate += 1
        out[last] = 0.0
        for k in range(2):
            if columns[k] >= 0:
                for j in range((6, 3, 6, 4)[kinds[k]]):
                    out[columns[k] + j] = 0.0
    return degenerate


# ------------------------------------------------------------------------------------------------------------- Public
@register("distance")
@dataclass(frozen=True, kw_only=True)
class Distance(Factor):
    """Known distances between two objects, one of each of two kinds; residual in scene units.

    Exactly one of the four references of each side is given; the second is of the same kind or a larger one, in the
    order camera, point, line, plane.
    """

    first_camera: Ref | None = None
    first_point: Ref | None = None
    first_line: Ref | None = None
    first_plane: Ref | None = None
    second_camera: Ref | None = None
    second_point: Ref | None = None
    second_line: Ref | None = None
    second_plane: Ref | None = None
    #: (N,) measured distances, scene units.
    distances: FloatArray
    #: (N, 3) of cameras the centre in the body, zero for cameras alone; of lines and planes a place whose foot is where
    #: the distance is measured from; of points any numbers.
    first_arm: FloatArray
    second_arm: FloatArray
    #: (N,) of two lines: whether it is the shortest between them, wherever that is; None: never.
    is_shortest: BoolArray | None = None

    slots: ClassVar[tuple[Slot, ...]] = tuple(
        Slot(f"{side}_{name}", kind, optional=True)
        for side in ("first", "second")
        for name, kind in zip(("camera", "point", "line", "plane"), KINDS, strict=True)
    )
    measurements: ClassVar[tuple[Measurement, ...]] = (
        Measurement("distances", ()),
        Measurement("first_arm", (3,)),
        Measurement("second_arm", (3,)),
    )
    rows: ClassVar[int] = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        shortest = np.zeros(len(self), bool) if self.is_shortest is None else np.asarray(self.is_shortest, bool)
        if shortest.shape != (len(self),) or (shortest.any() and (self.first_line is None or self.second_line is None)):
            raise ShapeError(f"Distance.is_shortest must be ({len(self)},) flags of two lines; got {shortest.shape}.")
        object.__setattr__(self, "is_shortest", shortest)

    def prepare(self, ambients: tuple[FloatArray, ...]) -> tuple[Any, ...]:  # noqa: D102
        return tuple(np.ascontiguousarray(ambient) for ambient in ambients)

    def linearize(self, inputs: Inputs, begin: int, end: int, columns: Columns, record: FloatArray) -> int:  # noqa: D102
        (one, first), (two, second) = self.references()
        kinds = KINDS.index(one.kind), KINDS.index(two.kind)
        return _linearize_all(
            (inputs[0], inputs[1]), (first.index, second.index), kinds, self.first_arm, self.second_arm,
            self.is_shortest, self.distances, begin, end, columns, record,
        )  # fmt: skip

    @classmethod
    def example(cls, rng: np.random.Generator) -> Example:  # noqa: D102
        return cls.between(rng, "camera", "camera")

    @classmethod
    def between(cls, rng: np.random.Generator, first: str, second: str) -> Example:
        """Return an example of two kinds: ``camera``, ``point``, ``line`` or ``plane``."""
        index = np.arange(6) % 4
        refs = {f"first_{first}": Ref("first", index), f"second_{second}": Ref("second", rng.integers(0, 4, 6))}
        numbers = {name: rng.normal(size=(6, 3)) for name in ("first_arm", "second_arm")}
        factor = cls(**refs, **numbers, distances=rng.uniform(1.0, 3.0, 6))  # type: ignore[arg-type]
        names = (("first", first), ("second", second))
        poses = {group: random_poses(rng, 4, rotation=0.7) for group, name in names if name == "camera"}
        return make_example(factor, rng, states=poses)
