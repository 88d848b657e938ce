# SPDX-License-Identifier: BSD-3-Clause
r"""Motions between pairs of images from their matches alone, each with its uncertainty.

A match with the unit rays :math:`x, y` in the first and the second camera leaves, for the motion
:math:`T_{21} = (R, t)` with :math:`\lVert t \rVert = 1`, the angle

.. math:: r = \frac{y^\top (t \times R x)}{\sqrt{\lVert P E x \rVert^2 + \lVert P E^\top y \rVert^2}},

with :math:`E = [t]_\times R` and P the projection across the ray (Sampson's distance, in angles). Motions are refined
by reweighted Gauss-Newton steps in the three angles of R and the two of t; the covariance is the inverse of the normal
matrix at the noise that the residuals show.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.gates import SIGMA_OF_MEDIAN, gate
from groma.geometry import quaternion
from groma.io.colmap.at_poses import MatchedPair


@dataclass(frozen=True)
class MotionGates:
    """How motions between two images are refined and trusted."""

    noise_px: float = gate(1.0, "px", "least noise of a match: SIFT's, and calibrations'", "convention: COLMAP")
    steps: int = gate(5, "steps", "of refinement; two suffice near a solution", "cost: the joint adjustment follows")
    floor: float = gate(np.radians(0.1), "rad", "least error of a motion, common to matches", "chosen on fountain-P11")
    weakest: float = gate(np.radians(20.0), "rad", "of a motion that tells nothing", "convention: a third of a radian")


GATES = MotionGates()


@dataclass(frozen=True, eq=False)
class Motions:
    """Motions between E pairs of images."""

    #: (E,) rows of the two images.
    first: IntArray
    second: IntArray
    #: (E, 4) rotation of the second camera from the first.
    rotation: FloatArray
    #: (E, 3) unit direction from the second camera to the first, in the second camera.
    direction: FloatArray
    #: (E,) standard deviations of a coordinate of the rotation and of the direction, radians.
    rotation_sigma: FloatArray
    direction_sigma: FloatArray
    #: (E,) matches.
    count: IntArray

    def __len__(self) -> int:
        return len(self.first)


def motions_of(pairs: Iterable[MatchedPair]) -> Motions:
    """Return the motions of pairs of images, refined and with their uncertainty; hopeless pairs are left out."""
    rows = [(pair, *_refined(pair)) for pair in pairs]
    rows = [row for row in rows if row[2] < GATES.weakest]
    pose = np.array([row[1] for row in rows]).reshape(-1, 7)
    return Motions(
        first=np.array([row[0].first for row in rows], np.int64),
        second=np.array([row[0].second for row in rows], np.int64),
        rotation=pose[:, :4],
        direction=pose[:, 4:],
        rotation_sigma=np.array([row[2] for row in rows], float),
        direction_sigma=np.array([row[3] for row in rows], float),
        count=np.array([len(row[0].first_rays) for row in rows], np.int64),
    )


def _refined(pair: MatchedPair) -> tuple[FloatArray, float, float]:
    """Return the refined motion and the standard deviations of its rotation and of its direction."""
    pose, least = pair.second_from_first, GATES.noise_px / pair.focal
    noise, normal = least, np.eye(5)
    for _ in range(GATES.steps):
        residual, jacobian, basis = _linearised(pose, pair.first_rays, pair.second_rays)
        noise = max(least, SIGMA_OF_MEDIAN * float(np.median(np.abs(residual))))
        weight = 1.0 / (1.0 + (residual / (2.0 * noise)) ** 2)
        normal = (jacobian * weight[:, None]).T @ jacobian
        step = -np.linalg.solve(normal + 1e-9 * np.trace(normal) * np.eye(5), jacobian.T @ (weight * residual))
        if np.linalg.norm(step) > 1.0:
            break
        shift = pose[4:] + basis @ step[3:]
        pose = np.concatenate([quaternion.multiply(quaternion.exp(step[:3]), pose[:4]), shift / np.linalg.norm(shift)])
    covariance = noise**2 * np.linalg.inv(normal + 1e-12 * np.trace(normal) * np.eye(5))
    turn, way = np.trace(covariance[:3, :3]) / 3.0, np.trace(covariance[3:, 3:]) / 2.0
    return pose, float(np.hypot(np.sqrt(turn), GATES.floor)), float(np.hypot(np.sqrt(way), GATES.floor))


def _linearised(pose: FloatArray, first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return residuals (M,), their derivatives (M, 5) and the (3, 2) basis of changes of the direction."""
    turned, shift = quaternion.rotate(pose[:4], first), pose[4:]
    _, _, vt = np.linalg.svd(shift[None])
    basis = vt[1:].T
    across = np.cross(shift, turned)  # E x
    back = np.cross(second, shift)  # R E^T y
    value = np.einsum("ij,ij->i", second, across)
    size = np.sqrt(
        np.maximum(np.sum(across**2, axis=1) - value**2, 0.0)
        + np.maximum(np.sum(back**2, axis=1) - np.einsum("ij,ij->i", back, turned) ** 2, 0.0)
    )
    size = np.maximum(size, 1e-6)
    # y . (t x (w x Rx)) = w . (Rx x (y x t)), and y . (dt x Rx) = dt . (Rx x y).
    wrt_turn, wrt_shift = np.cross(turned, back), np.cross(turned, second) @ basis
    return value / size, np.hstack([wrt_turn, wrt_shift]) / size[:, None], basis
