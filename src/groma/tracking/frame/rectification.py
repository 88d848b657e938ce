# SPDX-License-Identifier: BSD-3-Clause
r"""Pairs whose right camera is turned a little.

A pixel p of the rectified right image is seen at :math:`K\,\mathrm{Exp}(\omega)\,K^{-1} p`. With
:math:`x = (u - c_x)/f_x,\ y = (v - c_y)/f_y` small angles :math:`\omega` (pitch, yaw, roll: about x, y, z) shift it by

.. math:: \delta u = f_x \big(\omega_y (1 + x^2) - \omega_x x y - \omega_z y\big), \qquad
          \delta v = f_y \big(\omega_z x - \omega_x (1 + y^2) + \omega_y x y\big).

The rows of points found in both images tell pitch and roll from a single pair. The keystone :math:`x y` is left to a
number of its own and not taken for yaw: wrong principal points and what is left of lens distortion make one, too, far
larger than the yaw of real pairs. Yaw shifts all columns alike, which only motion tells from depth
(:mod:`groma.tracking.backend.stereo_calibration`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.features.images import GrayImage
from groma.features.point_tracks import POINT_TRACKS, follow
from groma.gates import NORMAL, SIGMA_OF_MEDIAN
from groma.geometry import so3
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.frame.stereo import Disparities
from groma.tracking.gates import DEFAULT, FeatureGates, RectificationGates

#: Least median size of residuals that rows are weighted by, pixels.
_LEAST_SCALE = 0.02


@dataclass(frozen=True)
class RightTurn:
    """How the right camera is turned from where a rectified one looks, and how well that is known."""

    #: (3,) angles about x, y and z (pitch, yaw, roll), radians; the camera sees Exp(angles) times a direction.
    angles: FloatArray
    #: (3, 3) their covariance.
    covariance: FloatArray

    @classmethod
    def unknown(cls, gates: RectificationGates = DEFAULT.rectification) -> RightTurn:
        """Return the prior of a rectified pair."""
        return cls(np.zeros(3), np.eye(3) * np.radians(gates.sigma_deg) ** 2)

    def joined(self, other: FloatArray, information: FloatArray) -> RightTurn:
        """Return the estimate that takes independent angles into account."""
        own = np.linalg.inv(self.covariance)
        covariance = np.asarray(np.linalg.inv(own + information), np.float64)
        return RightTurn(covariance @ (own @ self.angles + information @ other), covariance)

    def is_as_sure_as(self, other: RightTurn, gates: RectificationGates = DEFAULT.rectification) -> bool:
        """Whether yaw, the least determined angle, is known as well as in an earlier estimate."""
        return bool(self.covariance[1, 1] <= gates.as_sure * other.covariance[1, 1])

    def confirming(self, assumed: RightTurn) -> RightTurn:
        """Return the estimate with the uncertainty that tracked points leave: in part they follow the assumed rotation.

        Up to half of an error stayed where it was measured; then as much is left as was found.
        """
        covariance = self.covariance.copy()
        covariance[1, 1] += (self.angles[1] - assumed.angles[1]) ** 2
        return RightTurn(self.angles, covariance)

    def numbers(self, camera: TrackCamera) -> dict[str, list[float]]:
        """Return angles (pitch, yaw, roll) and standard deviations as plain numbers.

        In pixels, pitch and yaw are shifts in the middle of the image and roll is one at its left and right border.
        """
        sigma = np.sqrt(np.diag(self.covariance))
        pixels = np.array([camera.fy, camera.fx, 0.5 * camera.width])
        return {
            "angles_deg": np.degrees(self.angles).tolist(),
            "sigma_deg": np.degrees(sigma).tolist(),
            "shift_px": (self.angles * pixels).tolist(),
            "sigma_px": (sigma * pixels).tolist(),
        }


class RightCamera:
    """The right camera of all pairs, and how it is turned as far as that is known."""

    def __init__(
        self, camera: TrackCamera, gates: RectificationGates, features: FeatureGates, turn: RightTurn | None = None
    ) -> None:
        self._camera, self._gates, self._features = camera, gates, features
        self.turn = turn or RightTurn.unknown(gates)
        self._looks = gates.looks if turn is None else 0

    def rows_aligned(self, left: GrayImage, right: GrayImage) -> GrayImage:
        """Return a right image with the rows of the left one; pitch and roll are estimated from the first pairs.

        Raises
        ------
        InputError
            If the first pairs seem to be exchanged.
        """
        if self._looks > 0:
            self._looks -= 1
            if are_exchanged(self._camera, left, right, self._gates, self._features):
                raise InputError(
                    "Expected a left and a right image; most points lie farther right in the second one, so that they "
                    "seem to be exchanged. Exchange them."
                )
            here, there = find_pairs(self._camera, left, right, self._gates, self._features)
            angles, information = fit_rows(self._camera, here, there, self._gates)
            if information.any():
                self.turn, self._looks = self.turn.joined(angles, information), 0
        return rows_turned_back(self._camera, right, self.turn.angles)


def rows_turned_back(camera: TrackCamera, right: GrayImage, angles: FloatArray) -> GrayImage:
    """Move the pixels of a right image to their rows in the left one.

    Columns stay, so that nothing is resampled along rows: that would shift disparities by hundredths of a pixel.
    """
    if not angles.any():
        return np.ascontiguousarray(right)
    height, width = right.shape
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    x, y = (u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy
    pitch, yaw, roll = angles.astype(np.float32)
    row = v + camera.fy * (roll * x - pitch * (1 + y * y) + yaw * x * y)
    moved = cv2.remap(right, u, row.astype(np.float32), cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.uint8)


def turned_disparities(camera: TrackCamera, disparities: Disparities, angles: FloatArray) -> Disparities:
    """Disparities (H, W) as a right camera that is not turned would give them; 0 where unknown."""
    if not angles.any():
        return disparities
    height, width = disparities.shape
    x = (np.arange(width, dtype=np.float32) + 0.5 - disparities - camera.cx) / camera.fx
    y = (np.arange(height, dtype=np.float32)[:, None] + 0.5 - camera.cy) / camera.fy
    pitch, yaw, roll = angles.astype(np.float32)
    turned = disparities + camera.fx * (yaw * (1 + x * x) - pitch * x * y - roll * y)
    return np.where((disparities > 0) & (turned > 0), turned, np.float32(0.0)).astype(np.float32)


def turned_pixels(camera: TrackCamera, pixels: FloatArray, rotation: FloatArray) -> FloatArray:
    """Pixels (N, 2) as a camera sees them that is turned by a rotation (3, 3)."""
    rays = camera.bearings(pixels) @ rotation.T
    return rays[:, :2] / rays[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def retargeted(camera: TrackCamera, pixels: FloatArray, old: FloatArray, new: FloatArray) -> FloatArray:
    """Pixels (N, 2) of right images turned back by some angles, in those turned back by others."""
    return turned_pixels(camera, pixels, so3.exp(-new[None])[0] @ so3.exp(old[None])[0])


def retargeted_depths(
    camera: TrackCamera, pixels: FloatArray, depth: FloatArray, old: FloatArray, new: FloatArray
) -> FloatArray:
    """Depths (N,) at pixels of the left image from disparities, as :func:`retargeted`; NaN where none is left."""
    inverse = _retargeted_inverse(camera, pixels, 1.0 / depth, old, new)
    with np.errstate(invalid="ignore"):
        return 1.0 / np.where(inverse > 0, inverse, np.nan)


def retargeted_ends(
    camera: TrackCamera, ends: FloatArray, inverse: FloatArray, old: FloatArray, new: FloatArray
) -> FloatArray:
    """Inverse depths (L, 2) at the ends (L, 4) of segments from disparities, as :func:`retargeted`."""
    return _retargeted_inverse(camera, ends.reshape(-1, 2), inverse.ravel(), old, new).reshape(-1, 2)


def _retargeted_inverse(
    camera: TrackCamera, pixels: FloatArray, inverse: FloatArray, old: FloatArray, new: FloatArray
) -> FloatArray:
    scale = camera.fx * camera.baseline
    right = pixels - np.column_stack([scale * inverse, np.zeros(len(pixels))])
    return (pixels[:, 0] - retargeted(camera, right, old, new)[:, 0]) / scale


def find_pairs(
    camera: TrackCamera,
    left: GrayImage,
    right: GrayImage,
    gates: RectificationGates = DEFAULT.rectification,
    features: FeatureGates = DEFAULT.features,
) -> tuple[FloatArray, FloatArray]:
    """Points (N, 2) of the left image and where they are in the right one, pixels, in a wide band about their rows."""
    here, guess = _alike(camera, left, right, -_band(camera, gates), gates, features)
    if not len(here):
        return here, guess
    there, good = follow(left, right, here, guess, levels=0, round_trip=None, max_shift=POINT_TRACKS.max_shift)
    return here[good], there[good]


def are_exchanged(
    camera: TrackCamera,
    left: GrayImage,
    right: GrayImage,
    gates: RectificationGates = DEFAULT.rectification,
    features: FeatureGates = DEFAULT.features,
) -> bool:
    """Whether most points lie farther right in the right image, by more than a turn of that camera explains."""
    here, there = _alike(camera, left, right, -gates.max_disparity * camera.width, gates, features)
    behind = int((here[:, 0] - there[:, 0] < -_band(camera, gates)).sum())
    return len(here) >= gates.min_pairs and 2 * behind > len(here)


def _band(camera: TrackCamera, gates: RectificationGates) -> float:
    """Pixels by which a right camera may be turned."""
    return float(camera.fx * np.radians(gates.band_deg))


def _alike(
    camera: TrackCamera, left: GrayImage, right: GrayImage, least: float, gates: RectificationGates,
    features: FeatureGates,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Described features (N, 2) of both images that are most alike, near their rows, with disparities from some on."""
    orb = cv2.ORB.create(nfeatures=gates.num_features, fastThreshold=features.fast_threshold)
    places, bits = [], []
    for image in (left, right):
        found, descriptors = orb.detectAndCompute(image, None)  # pyright: ignore[reportCallIssue, reportArgumentType]
        if not found:
            return np.zeros((0, 2)), np.zeros((0, 2))
        places.append(np.asarray(cv2.KeyPoint.convert(found), np.float64) + 0.5)
        bits.append(np.unpackbits(np.asarray(descriptors, np.uint8), axis=1).astype(np.float32))
    here, there = places
    disparity, row = here[:, None, 0] - there[None, :, 0], there[None, :, 1] - here[:, None, 1]
    differ = bits[0].sum(axis=1)[:, None] + bits[1].sum(axis=1) - 2.0 * bits[0] @ bits[1].T
    far = gates.max_disparity * camera.width
    differ[(np.abs(row) > _band(camera, gates)) | (disparity < least) | (disparity > far)] = np.inf
    best = differ.argmin(axis=1)
    rows = np.arange(len(here))
    good = (differ[rows, best] <= features.max_bits) & (differ.argmin(axis=0)[best] == rows)
    return here[good], there[best[good]]


def fit_rows(
    camera: TrackCamera, left: FloatArray, right: FloatArray, gates: RectificationGates = DEFAULT.rectification
) -> tuple[FloatArray, FloatArray]:
    """Angles (3,) that explain the rows of points (N, 2) found in both images, and their information (3, 3).

    Nothing is known of yaw. Errors of neighbouring points are alike in all pairs, since most are what the lens model
    left; so cells of the image count as samples, not points.
    """
    ray = camera.bearings(right)
    x, y = ray[:, 0], ray[:, 1]
    basis = camera.fy * np.column_stack([-(1.0 + y * y), x * y, x])
    offset = right[:, 1] - left[:, 1]
    cells = cells_of(camera, left, gates)
    count = len(np.unique(cells))
    if len(left) < gates.min_pairs or count <= gates.min_cells:
        return np.zeros(3), np.zeros((3, 3))
    angles, error, share = np.zeros(3), offset, np.zeros(len(left))
    loose = np.eye(3) / np.radians(gates.keystone_deg) ** 2
    for _ in range(gates.iterations):
        weighted = basis / (1.0 + share[:, None]) ** 2
        angles = np.linalg.solve(weighted.T @ basis + loose, weighted.T @ offset)
        error = offset - basis @ angles
        scale = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(error))), _LEAST_SCALE)
        share = (error / (NORMAL.far * scale)) ** 2
    # The covariance of a robust estimate from independent sums: how they push, by how the push changes with the angles.
    push = basis * (error / (1.0 + share) ** 2)[:, None]
    pushes = np.stack([np.bincount(cells, weights=column) for column in push.T], axis=1)
    slope = (1.0 - 3.0 * share) / (1.0 + share) ** 3  # derived from the push, by the error
    inverse = np.linalg.inv((basis * slope[:, None]).T @ basis + loose)
    covariance = inverse @ (pushes.T @ pushes) @ inverse * count / (count - 3)
    kept = [0, 2]
    information = np.zeros((3, 3))
    information[np.ix_(kept, kept)] = np.linalg.inv(covariance[np.ix_(kept, kept)])
    return np.array([angles[0], 0.0, angles[2]]), information


def cells_of(camera: TrackCamera, pixels: FloatArray, gates: RectificationGates = DEFAULT.rectification):
    """The cell (N,) of the image in which each pixel lies."""
    size = camera.width / gates.cells
    column, row = np.clip((pixels / size).astype(np.int64), 0, (gates.cells - 1, 10_000)).T
    return row * gates.cells + column
