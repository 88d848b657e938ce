# SPDX-License-Identifier: BSD-3-Clause
r"""Lines in space from image segments and a depth image.

Along an image segment from t = 0 to t = 1 the inverse depth of a line is linear, and on a flat surface beside it, at
the signed distance d across, it is

.. math:: \rho(t, d) = (1 - t)\,\rho_1 + t\,\rho_2 + \gamma\, d .

Depth at the edge itself is the worst there is: a mixture of both sides, or a hole. It is therefore sampled at some
distances on either side, each side is fitted on its own, and :math:`\rho_1, \rho_2` extrapolate to the segment.

* Both sides agree in :math:`\rho_1, \rho_2`, and in the slope across: the line is drawn on a surface, and all samples
  are used.
* They agree, but not in the slope: a crease; its two surfaces share the line.
* They do not agree: an edge where one surface hides another. It belongs to the nearer one.
* One side has no depth: the other is used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray, FloatArray
from groma.errors import InputError, ShapeError
from groma.features.depth.line_fit import CREASE, LEFT, NONE, RIGHT, SURFACE, fit_all
from groma.features.depth.noise import DepthNoise, as_depth, as_pinhole
from groma.gates import KINECT, NORMAL, chi_square_gate, gate


@dataclass(frozen=True)
class DepthLineGates:
    """Where depth is sampled beside a segment, and what the samples must agree on."""

    near: float = gate(1.5, "px", "depth is sampled from this distance on", "chosen on Kinect images: smeared edges")
    far: float = gate(6.5, "px", "and up to this distance", "chosen on Kinect images")
    min_share: float = gate(0.35, "share", "share of the samples of a side on its fit", "chosen on Kinect images")
    max_relative_sigma: float = gate(0.05, "share", "noise at an end, of its depth", KINECT)
    shares: tuple[float, ...] = gate(
        (0.04, 0.015, 0.006, 0.0), "share", "added to the noise round by round, of the inverse depth", KINECT
    )
    agree_share: float = gate(0.006, "share", "on top of noise, of the inverse depth", "chosen on Kinect images")
    slope_share: float = gate(0.0015, "share / px", "the same for the slope", "chosen on Kinect images")
    min_length: float = gate(4.0, "px", "shorter segments have no line", "derived from two samples a half")
    min_inliers: int = gate(8, "samples", "samples on the fit of a side", "derived from 3 unknowns")


#: The defaults.
DEPTH_LINES = DepthLineGates()


@dataclass(frozen=True, eq=False)
class DepthLines:
    """Lines in the camera frame, one row per segment; rows without depth are zero."""

    #: (N,) whether there is a line.
    good: BoolArray
    #: (N,) the fitted part: ``NONE``, ``SURFACE``, ``CREASE``, or one side of the segment, ``LEFT``, ``RIGHT``.
    support: npt.NDArray[np.int8]
    #: (N, 2, 3) the points of the line at the ends of the segment, metres.
    end_points: FloatArray
    #: (N, 6, 6) their covariance, of rank 4: depth at both ends, and the position of the segment across itself.
    covariances: FloatArray
    #: (N, 2) inverse depths at the ends and (N, 2, 2) their covariance, one over metres.
    inverse_depth: FloatArray
    inverse_depth_covariances: FloatArray
    #: (N,) share of the samples, of one side or of both, that lie on the fit.
    inlier_share: FloatArray

    def __len__(self) -> int:
        return len(self.good)

    @property
    def plucker(self) -> FloatArray:
        """(N, 6) lines (m, d), d from the first to the second end point, of any scale; zero where there is none."""
        first, second = self.end_points[:, 0], self.end_points[:, 1]
        return np.hstack([np.cross(first, second), second - first])


def fit_depth_lines(
    ends: npt.ArrayLike,
    depth: npt.NDArray[np.floating],
    pinhole: npt.ArrayLike,
    noise: DepthNoise | None = None,
    sigma: npt.ArrayLike = 0.3,
    gates: DepthLineGates = DEPTH_LINES,
) -> DepthLines:
    r"""Fit lines in space to image segments by the depth on both of their sides.

    .. math:: X_i = r_i / \rho_i, \qquad
        \mathrm{d}X_i = -\frac{r_i}{\rho_i^2}\, \mathrm{d}\rho_i + \frac{\nu}{\rho_i}\, \mathrm{d}s_i

    with the rays :math:`r_i` of the ends, and :math:`\nu` the change of a ray for a pixel across the segment.

    Parameters
    ----------
    ends : (N, 4) float
        Segments u1 v1 u2 v2, pixels; the first pixel's centre is (0.5, 0.5).
    depth : (H, W) float
        Depth, metres; 0 where unknown.
    pinhole : (4,) float
        fx, fy, cx, cy.
    noise : DepthNoise, optional
        Errors of depth.
    sigma : float or (N,) float
        Standard deviation of the ends across the segments, pixels.
    gates : DepthLineGates
        Where depth is sampled, and what the samples must agree on.

    Returns
    -------
    DepthLines
        One row per segment.

    Raises
    ------
    ShapeError, InputError
        If arguments are not usable.

    Notes
    -----
    A segment whose nearer side has no depth takes that of the farther one; one image cannot show the error.
    """
    segments = np.ascontiguousarray(ends, np.float64)
    if segments.ndim != 2 or segments.shape[1] != 4:
        raise ShapeError(f"ends must have shape (N, 4): u1 v1 u2 v2; got {segments.shape}.")
    if not np.isfinite(segments).all() or not 0 <= gates.near < gates.far:
        raise InputError(f"ends must be finite and 0 <= near < far; got near {gates.near}, far {gates.far}.")
    image, camera, noise = as_depth(depth), as_pinhole(pinhole), noise or DepthNoise()
    across = np.broadcast_to(np.asarray(sigma, np.float64), (len(segments),))
    count = len(segments)
    inverse_depth, covariance = np.empty((count, 2)), np.empty((count, 2, 2))
    support, share = np.empty(count, np.int8), np.empty(count)
    own = (
        (gates.near, gates.far), gates.min_share, gates.min_length, NORMAL.far, float(gates.min_inliers),
        (chi_square_gate(NORMAL.gross, 2), NORMAL.far**2, gates.agree_share, gates.slope_share),
    )  # fmt: skip
    fit_all(
        segments, image, noise.numbers, noise.correlation, own, np.array(gates.shares), inverse_depth, covariance,
        support, share,
    )  # fmt: skip
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    good = (support > 0) & (inverse_depth > 1.0 / noise.max_depth).all(axis=1)
    good &= (variance < (gates.max_relative_sigma * inverse_depth) ** 2).all(axis=1)
    support[~good] = NONE
    for values in (inverse_depth, covariance, share):
        values[~good] = 0.0

    z = np.where(good[:, None], 1.0 / np.where(good[:, None], inverse_depth, 1.0), 0.0)
    pixels = segments.reshape(-1, 2, 2)
    rays = np.concatenate([(pixels - camera[2:]) / camera[:2], np.ones((count, 2, 1))], axis=2)
    points = rays * z[:, :, None]
    # What is common to all depths: a shift of both ends, and a tilt about the middle; both zero where there is no line.
    half = 0.5 * np.linalg.norm(points[:, 1] - points[:, 0], axis=1, keepdims=True)
    for common in (noise.shift * inverse_depth**2, noise.tilt * half * inverse_depth**2 * [-1.0, 1.0]):
        covariance += common[:, :, None] * common[:, None, :]
    return DepthLines(
        good=good,
        support=support,
        end_points=points,
        covariances=_end_covariances(pixels, camera, rays, z, covariance, across),
        inverse_depth=inverse_depth,
        inverse_depth_covariances=covariance,
        inlier_share=share,
    )


def _end_covariances(
    pixels: FloatArray, camera: FloatArray, rays: FloatArray, z: FloatArray, covariance: FloatArray, across: FloatArray
) -> FloatArray:
    """Return the covariances (N, 6, 6) of end points, from those of inverse depths and the noise across segments."""
    count = len(pixels)
    direction = pixels[:, 1] - pixels[:, 0]
    direction = direction / np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    normal = np.column_stack([direction[:, 1], -direction[:, 0]]) / camera[:2]
    motion = np.zeros((count, 2, 3, 4))  # of an end by both inverse depths and by both shifts across
    for end in range(2):
        motion[:, end, :, end] = -rays[:, end] * (z[:, end] ** 2)[:, None]
        motion[:, end, :2, 2 + end] = normal * (z[:, end] * across)[:, None]
    flat = motion.reshape(count, 6, 4)
    inner = np.zeros((count, 4, 4))
    inner[:, :2, :2] = covariance
    inner[:, 2, 2] = inner[:, 3, 3] = 1.0
    return flat @ inner @ flat.transpose(0, 2, 1)


__all__ = ["CREASE", "LEFT", "NONE", "RIGHT", "SURFACE", "DepthLineGates", "DepthLines", "fit_depth_lines"]
