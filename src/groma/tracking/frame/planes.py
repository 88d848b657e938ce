# SPDX-License-Identifier: BSD-3-Clause
"""Planes that one frame sees, as the tracker wants them: for factors, and with places for telling them apart."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.factors.contract import Ref
from groma.factors.observations.plane_observation import PlaneObservation
from groma.features.depth.noise import DepthNoise
from groma.features.depth.planes import PlaneSearchOptions, find_depth_planes
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.depth import DepthImage
from groma.tracking.gates import DEFAULT, TrackingGates


@dataclass(frozen=True)
class FramePlanes:
    """Planes seen by one frame, in its camera."""

    #: (K, 4) unit normal towards the camera, and offset.
    plane: FloatArray
    #: (K, 3, 3) square root information in the basis of ``PlaneObservation``.
    sqrt_information: FloatArray
    #: (K,) pixels on it.
    support: FloatArray
    #: (C, 3) places on planes, and the plane of each (C,).
    places: FloatArray
    place_plane: IntArray

    def __len__(self) -> int:
        return len(self.plane)

    @cached_property
    def means(self) -> FloatArray:
        """(K, 3) mean places of the planes."""
        count = np.bincount(self.place_plane, minlength=len(self))
        sums = [np.bincount(self.place_plane, self.places[:, k], len(self)) for k in range(3)]
        return np.stack([each / np.maximum(count, 1) for each in sums], axis=1)

    @cached_property
    def place_rows(self) -> tuple[IntArray, IntArray]:
        """Rows of the places, plane by plane, and their bounds (K + 1,)."""
        rows = np.argsort(self.place_plane, kind="stable")
        return rows, np.searchsorted(self.place_plane[rows], np.arange(len(self) + 1))

    def places_of(self, row: int) -> FloatArray:
        """Places (c, 3) on one plane."""
        return self.places[self.place_plane == row]


def frame_planes(
    camera: TrackCamera, depth: DepthImage, max_depth: float, gates: TrackingGates = DEFAULT
) -> FramePlanes:
    """Find the planes of a depth image, largest first."""
    own = gates.frame_planes
    noise = DepthNoise(
        gates.depth.min_sigma, gates.depth.inverse_sigma, 0.0,
        correlation=own.correlation, tilt=own.tilt, shift=gates.depth.min_sigma, max_depth=max_depth,
    )  # fmt: skip
    options = PlaneSearchOptions(min_share=own.min_share, max_planes=own.max_planes)
    found = find_depth_planes(depth, camera.params, noise, options)
    planes, step = found.planes, found.step
    every = max(gates.depth.grid // step, 1)
    labels = found.labels[every // 2 :: every, every // 2 :: every]
    row, column = np.nonzero(labels >= 0)
    of = labels[row, column].astype(np.int64)
    at = np.column_stack([column, row]) * every + every // 2
    rays = camera.bearings(np.asarray(at * step + step // 2 + 0.5, np.float64))
    # Where the ray meets the plane, which is less noisy than the depth there.
    places = rays * (-planes[of, 3] / (planes[of, :3] * rays).sum(axis=1))[:, None]
    support = found.num_samples.astype(np.float64) * step**2
    kept = np.flatnonzero(np.bincount(of, minlength=len(planes)) >= own.min_places)
    renumbered = np.full(len(planes), -1)
    renumbered[kept] = np.arange(len(kept))
    on = renumbered[of] >= 0
    root = _sqrt_information(planes, found.covariances_hesse)
    return FramePlanes(planes[kept], root[kept], support[kept], places[on], renumbered[of[on]])


def _sqrt_information(planes: FloatArray, covariances: FloatArray) -> FloatArray:
    """Square roots (K, 3, 3) of the information on residuals, from covariances (K, 4, 4) of (n, w)."""
    none = np.zeros(len(planes), np.int64)
    basis = np.zeros((len(planes), 4, 3))
    basis[:, :3, :2] = PlaneObservation(pose=Ref("p", none), plane=Ref("q", none), planes_in_cam=planes).basis
    basis[:, 3, 2] = 1.0
    own = basis.transpose(0, 2, 1) @ covariances @ basis
    return np.asarray(np.linalg.cholesky(np.linalg.inv(own)), np.float64).transpose(0, 2, 1)
