# SPDX-License-Identifier: BSD-3-Clause
r"""The place on an object that a length is measured from, and how it moves with the object.

====================  ========================================================================================
a camera (R, t)       :math:`q = R^\top(a - t)`, a being the camera's centre in its body; zero for a camera alone
a point X             :math:`q = X`
a line (m, d)         the foot of a on it, :math:`q = (d \times m + d\,(d\cdot a))/\lVert d\rVert^2`
a plane (n, w)        the foot of a on it, :math:`q = a - s\,n,\; s = (n\cdot a + w)/\lVert n\rVert^2`
====================  ========================================================================================

With a derivative g by q, those by the coordinates of the objects are

.. math:: \left[-Rg,\; a\times(-Rg)\right], \qquad g, \qquad
          \frac{\left[g\times d,\; m\times g + g\,(d\cdot a) + (g\cdot d)\,a - 2(g\cdot q)\,d\right]}
          {\lVert d\rVert^2}, \qquad
          \left[-s\,g - \frac{g\cdot n}{\lVert n\rVert^2}(a - 2 s\,n),\; -\frac{g\cdot n}{\lVert n\rVert^2}\right] .
"""

from __future__ import annotations

from groma._numba import loop

CAMERA, POINT, LINE, PLANE = range(4)
#: Kinds of variables by these codes.
KINDS = ("pose", "point", "line", "plane")


@loop
def place_on(kind, row, a, q):
    """Write the place q (3,); return whether there is one."""
    if kind == 0:
        x, y, z = a[0] - row[3], a[1] - row[7], a[2] - row[11]
        for j in range(3):
            q[j] = row[j] * x + row[4 + j] * y + row[8 + j] * z
    elif kind == 1:
        for j in range(3):
            q[j] = row[j]
    elif kind == 2:
        m0, m1, m2, d0, d1, d2 = row[0], row[1], row[2], row[3], row[4], row[5]
        dd = d0 * d0 + d1 * d1 + d2 * d2
        if not dd > 1e-200:
            return False
        along = d0 * a[0] + d1 * a[1] + d2 * a[2]
        q[0] = (d1 * m2 - d2 * m1 + d0 * along) / dd
        q[1] = (d2 * m0 - d0 * m2 + d1 * along) / dd
        q[2] = (d0 * m1 - d1 * m0 + d2 * along) / dd
    else:
        nn = row[0] * row[0] + row[1] * row[1] + row[2] * row[2]
        if not nn > 1e-200:
            return False
        s = (row[0] * a[0] + row[1] * a[1] + row[2] * a[2] + row[3]) / nn
        for j in range(3):
            q[j] = a[j] - s * row[j]
    return True


@loop
def put_place(kind, row, a, q, g, out, c):
    """Write the block of one residual with the derivative g (3,) by the place q at column c of ``out``."""
    if kind == 0:
        h0 = row[0] * g[0] + row[1] * g[1] + row[2] * g[2]
        h1 = row[4] * g[0] + row[5] * g[1] + row[6] * g[2]
        h2 = row[8] * g[0] + row[9] * g[1] + row[10] * g[2]
        out[c], out[c + 1], out[c + 2] = -h0, -h1, -h2
        out[c + 3], out[c + 4], out[c + 5] = h1 * a[2] - h2 * a[1], h2 * a[0] - h0 * a[2], h0 * a[1] - h1 * a[0]
    elif kind == 1:
        for j in range(3):
            out[c + j] = g[j]
    elif kind == 2:
        m0, m1, m2, d0, d1, d2 = row[0], row[1], row[2], row[3], row[4], row[5]
        dd = d0 * d0 + d1 * d1 + d2 * d2
        along, turned = d0 * a[0] + d1 * a[1] + d2 * a[2], g[0] * d0 + g[1] * d1 + g[2] * d2
        length = 2.0 * (g[0] * q[0] + g[1] * q[1] + g[2] * q[2])
        out[c], out[c + 1] = (g[1] * d2 - g[2] * d1) / dd, (g[2] * d0 - g[0] * d2) / dd
        out[c + 2] = (g[0] * d1 - g[1] * d0) / dd
        out[c + 3] = (m1 * g[2] - m2 * g[1] + g[0] * along + turned * a[0] - length * d0) / dd
        out[c + 4] = (m2 * g[0] - m0 * g[2] + g[1] * along + turned * a[1] - length * d1) / dd
        out[c + 5] = (m0 * g[1] - m1 * g[0] + g[2] * along + turned * a[2] - length * d2) / dd
    else:
        nn = row[0] * row[0] + row[1] * row[1] + row[2] * row[2]
        s = (row[0] * a[0] + row[1] * a[1] + row[2] * a[2] + row[3]) / nn
        across = (g[0] * row[0] + g[1] * row[1] + g[2] * row[2]) / nn
        for j in range(3):
            out[c + j] = -s * g[j] - across * (a[j] - 2.0 * s * row[j])
        out[c + 3] = -across
