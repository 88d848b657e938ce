# SPDX-License-Identifier: BSD-3-Clause
r"""The kinds of motion, as groups of 4x4 matrices with one chart.

.. math:: H \leftarrow \mathrm{Exp}\Big(\sum_k \xi_k G_k\Big)\, H

Rigid motions have the generators of translations and rotations :math:`(\rho, \omega)`, similarities that of the scale
:math:`\sigma` besides, projective ones five stretches and three that move the plane at infinity besides. So tangents
are those of :mod:`groma.geometry.se3` and :mod:`groma.geometry.sim3`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy.linalg import expm

from groma._typing import FloatArray

#: What is allowed to a motion.
Kind = Literal["rigid", "similarity", "projective"]
#: Degrees of freedom of each kind.
FREEDOM: dict[str, int] = {"rigid": 6, "similarity": 7, "projective": 15}


def _generators() -> FloatArray:
    out = np.zeros((15, 4, 4))
    for k in range(3):
        out[k, k, 3] = 1.0
        i, j = (k + 1) % 3, (k + 2) % 3
        out[3 + k, j, i], out[3 + k, i, j] = 1.0, -1.0
        out[9 + k, i, j] = out[9 + k, j, i] = 1.0
        out[12 + k, 3, k] = 1.0
    out[6, :3, :3] = np.eye(3)
    out[7, :3, :3] = np.diag([1.0, -1.0, 0.0])
    out[8, :3, :3] = np.diag([1.0, 1.0, -2.0])
    return out


_GENERATORS = _generators()


def generators(kind: Kind) -> FloatArray:
    """Return the generators (k, 4, 4) of a kind of motion."""
    return _GENERATORS[: FREEDOM[kind]]


def moved(kind: Kind, motion: FloatArray, tangent: FloatArray) -> FloatArray:
    """Return a motion (4, 4) after a tangent vector (k,)."""
    out = np.asarray(expm(np.tensordot(tangent, generators(kind), 1))) @ motion
    return out / np.linalg.norm(out) if kind == "projective" else out


def tangent_between(kind: Kind, motion: FloatArray, other: FloatArray) -> FloatArray:
    """Return the tangent (k,) that takes a motion to one near it, to first order."""
    return _coordinates(kind, other @ np.linalg.inv(motion))


def changed_frame(kind: Kind, c_from_b: FloatArray) -> FloatArray:
    """Return the matrix (k, k) that takes tangents of motions into b to those of the same motions into c."""
    back = np.linalg.inv(c_from_b)
    return np.stack([_coordinates(kind, np.eye(4) + c_from_b @ one @ back) for one in generators(kind)], axis=1)


def _coordinates(kind: Kind, near_identity: FloatArray) -> FloatArray:
    """Coordinates (k,) of a matrix (4, 4) near a multiple of the identity."""
    basis = generators(kind).reshape(-1, 16)
    if kind == "projective":
        near_identity = near_identity * (4.0 / np.trace(near_identity))  # derived from the identity
        basis = np.concatenate([basis, np.eye(4).reshape(1, 16)])
    found = np.linalg.lstsq(basis.T, (near_identity - np.eye(4)).ravel(), rcond=None)[0]
    return np.asarray(found[: FREEDOM[kind]], np.float64)
