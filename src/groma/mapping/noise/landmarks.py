# SPDX-License-Identifier: BSD-3-Clause
r"""Covariances of points and lines from the noise of their observations, poses and intrinsics held.

With cameras held, landmarks are independent, and the covariance of each is the inverse of its information matrix
:math:`\sum J^\top J/\sigma^2`. A line has four parameters :math:`(a_1, b_1, a_2, b_2)`: the displacements of the two
ends of its segment across it, along two unit vectors. The point at the fraction :math:`\lambda` of the segment moves by
:math:`(1-\lambda)\delta_1 + \lambda\delta_2`. A measured end point corresponds to the point of the line that is closest
to its ray; only its displacement across the image line is measured. Any camera model can be used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import BoolArray, FloatArray, IntArray
from groma.execution import map_ranges
from groma.gates import SURVEYED, gate
from groma.geometry import quaternion
from groma.geometry.algebra import apply, cross, dot, norm, perpendicular, ratio, unit
from groma.scene import Scene
from groma.scene.line_intervals import shares_on_lines


@dataclass(frozen=True)
class LandmarkNoiseGates:
    """What is believed of the noise of a landmark."""

    min_sigma_px: float = gate(0.02, "px", "of a coordinate at least", "convention: synthetic scenes have none")
    max_share: float = gate(3.0, "1", "lengths from its middle where rays tell an end", SURVEYED)


GATES = LandmarkNoiseGates()
#: Observed segments per task, and lines whose noise it propagates (cost: time only).
_ROWS_AT_ONCE, _LINES_AT_ONCE = 8192, 1024


@dataclass(frozen=True)
class PointNoise:
    """Uncertainty of the points."""

    #: (P, 3, 3) covariances, scene units squared.
    covariance: FloatArray
    #: (P,) root mean square reprojection error over the degrees of freedom, in standard deviations.
    misfit: FloatArray
    #: Standard deviation of the usual measured coordinate, pixels; the observations' own are relative to it.
    sigma_px: float

    def widened(self, length: FloatArray) -> PointNoise:
        """Return the noise with a standard deviation (P,) in every direction added, scene units."""
        return replace(self, covariance=self.covariance + length[:, None, None] ** 2 * np.eye(3))


@dataclass(frozen=True)
class LineNoise:
    """Uncertainty of the lines."""

    #: (L, 2, 3) unit vectors across each line.
    across: FloatArray
    #: (L, 4, 4) covariances of where the two ends move along them, scene units squared.
    covariance: FloatArray
    #: (L,) as for points.
    misfit: FloatArray
    sigma_px: float

    def widened(self, length: FloatArray) -> LineNoise:
        """Return the noise with a standard deviation (L,) of both ends across the line added, scene units."""
        return replace(self, covariance=self.covariance + length[:, None, None] ** 2 * np.eye(4))

    def by_misfit(self) -> LineNoise:
        """Return the noise that each line shows in its own residuals where that is more than the usual one."""
        return replace(self, covariance=self.covariance * np.maximum(self.misfit, 1.0)[:, None, None] ** 2)

    def at(self, first_share: FloatArray, second_share: FloatArray, rows: IntArray) -> FloatArray:
        """Cross-covariance (N, 2, 2), along ``across``, of the points at two shares of the segments ``rows``."""
        first = np.stack([1.0 - first_share, first_share], axis=-1)
        second = np.stack([1.0 - second_share, second_share], axis=-1)
        found = np.empty((len(rows), 2, 2))

        def fill(part: slice) -> None:
            blocks = self.covariance[rows[part]].reshape(-1, 2, 2, 2, 2)
            np.einsum("ne,neafb,nf->nab", first[part], blocks, second[part], out=found[part])

        map_ranges(fill, len(rows), _LINES_AT_ONCE)
        return found

    def ends(self, rows: IntArray) -> FloatArray:
        """Covariances (N, 2, 3, 3) of the end points of some lines, with as much uncertainty along them as across."""
        blocks, across = self.covariance[rows].reshape(-1, 2, 2, 2, 2), self.across[rows]
        blocks, full = np.stack([blocks[:, 0, :, 0], blocks[:, 1, :, 1]], axis=1), np.empty((len(rows), 2, 3, 3))

        def fill(part: slice) -> None:
            np.einsum("lai,leab,lbj->leij", across[part], blocks[part], across[part], out=full[part])

        map_ranges(fill, len(rows), _LINES_AT_ONCE)
        along = cross(across[:, 0], across[:, 1])
        size = 0.5 * np.trace(blocks, axis1=2, axis2=3)
        return full + size[..., None, None] * (along[:, :, None] * along[:, None, :])[:, None]

    def directions(self, length: FloatArray) -> FloatArray:
        """Covariances (L, 3, 3) of the unit directions, square radians."""
        blocks = self.covariance.reshape(-1, 2, 2, 2, 2)
        turn = blocks[:, 0, :, 0] + blocks[:, 1, :, 1] - blocks[:, 0, :, 1] - blocks[:, 1, :, 0]
        turn = turn / np.maximum(length, 1e-300)[:, None, None] ** 2
        return np.einsum("lai,lab,lbj->lij", self.across, turn, self.across)


def point_noise(scene: Scene, sigma_px: float | None = None) -> PointNoise:
    """Return the covariances of the points; ``sigma_px`` None estimates it from the residuals.

    Columns in the right images of stereo pairs, and depths, are observations, too.
    """
    parts = _pixel_rows(scene), _column_rows(scene), _depth_rows(scene)
    point = np.concatenate([part[0] for part in parts])
    residual, by_world = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    good = np.asarray(np.isfinite(residual) & np.isfinite(by_world).all(axis=1))
    residual, by_world = np.where(good, residual, 0.0), np.where(good[:, None], by_world, 0.0)
    count = np.bincount(point[good], minlength=scene.num_points)
    squares = _sum(residual[:, None] ** 2, point, scene.num_points)[:, 0]
    sigma, misfit = _misfit(squares, count - 3, sigma_px)
    information = _sum(by_world[:, :, None] * by_world[:, None, :], point, scene.num_points) / sigma**2
    return PointNoise(_inverse(information, _extent(scene)), misfit, sigma)


def line_noise(scene: Scene, sigma_px: float | None = None) -> LineNoise:
    """Return the covariances of the lines; ``sigma_px`` None estimates it from the residuals."""
    table, ends = scene.line_observations, line_end_rows(scene)
    information = np.zeros((scene.num_lines, 4, 4))
    for share, row, good in zip(ends.share.T, np.swapaxes(ends.row, 0, 1), ends.good.T, strict=True):
        row = np.hstack([(1.0 - share)[:, None] * row, share[:, None] * row])
        row = np.where(good[:, None], row, 0.0) * (good / table.sigma)[:, None]
        information += _sum(row[:, :, None] * row[:, None, :], table.line_idx, scene.num_lines)
    sigma, misfit = _misfit(*_line_squares(scene, ends), sigma_px)
    return LineNoise(ends.across, _inverse(information / sigma**2, _extent(scene)), misfit, sigma)


def line_sigma_px(scene: Scene, ends: LineEndRows) -> float:
    """Return the standard deviation that :func:`line_noise` estimates, pixels."""
    return _misfit(*_line_squares(scene, ends), None)[0]


def _line_squares(scene: Scene, ends: LineEndRows) -> tuple[FloatArray, IntArray]:
    """Sums of the squared whitened residuals of each line (L,), and their degrees of freedom."""
    line, sigma = scene.line_observations.line_idx, scene.line_observations.sigma
    squares, count = np.zeros(scene.num_lines), np.zeros(scene.num_lines, dtype=np.int64)
    for residual, good in zip(ends.residual.T, ends.good.T, strict=True):
        whitened = np.where(good, residual, 0.0) * (good / sigma)
        squares += _sum(whitened[:, None] ** 2, line, scene.num_lines)[:, 0]
        count += np.bincount(line[good], minlength=scene.num_lines)
    return squares, count - 4


@dataclass(frozen=True)
class LineEndRows:
    """Places of the ends of observed segments on their lines, and distances; NaN for uninformative ends."""

    #: (L, 2, 3) unit vectors across each line.
    across: FloatArray
    #: (N, 2) places on the line: 0 is the first end of its segment, 1 the second.
    share: FloatArray
    #: (N, 2) signed distances from the projected line, pixels.
    residual: FloatArray
    #: (N, 2, 2) their derivatives by a displacement of the line there along its vectors across it.
    row: FloatArray

    @property
    def good(self) -> BoolArray:
        """(N, 2) whether an end is informative."""
        known = np.isfinite(self.residual) & np.isfinite(self.share) & np.isfinite(self.row).all(axis=2)
        return np.asarray(known, np.bool_)


def line_end_rows(scene: Scene) -> LineEndRows:
    """Return where both ends of all observed segments lie."""
    count, ends = len(scene.line_observations), scene.lines.segments
    direction = unit(ends[:, 1] - ends[:, 0])
    across = np.stack(perpendicular(direction), axis=1)
    found = LineEndRows(across, np.empty((count, 2)), np.empty((count, 2)), np.empty((count, 2, 2)))

    def fill(part: slice) -> None:
        for k in range(2):
            found.share[part, k], found.residual[part, k], found.row[part, k] = _end_rows(
                scene, part, slice(2 * k, 2 * k + 2), direction, across
            )

    map_ranges(fill, count, _ROWS_AT_ONCE)
    return found


def _end_rows(
    scene: Scene, part: slice, columns: slice, direction: FloatArray, across: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Where on its line (N,) an end of each segment lies, how far across it (N,), derivatives (N, 2) of that there."""
    table = scene.line_observations
    line, image_idx = table.line_idx[part], table.image_idx[part]
    measured = np.ascontiguousarray(table.segment[part, columns])
    share = _share_on_line(scene, image_idx, measured, scene.lines.segments[line])
    first, last = scene.lines.segments[line].transpose(1, 0, 2)
    pixels, by_world = project_points(scene, image_idx, first + share[:, None] * (last - first))
    tangent = unit(apply(by_world, direction[line]))
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
    residual = dot(normal, pixel_differences(scene, image_idx, pixels, measured))
    return share, residual, np.einsum("nk,nki,nai->na", normal, by_world, across[line])


def project_points(
    scene: Scene, image_idx: IntArray, places: FloatArray, baseline: FloatArray | float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) of points in the world and their derivatives (N, 2, 3) by them; NaN behind the camera.

    With baselines (N,) the pixels are those in the right images of stereo pairs.
    """
    rotation = quaternion.to_matrix(scene.cam_from_world[:, :4])
    pixels, by_world = np.full((len(places), 2), np.nan), np.full((len(places), 2, 3), np.nan)
    for front, found, by_cam in _projected(scene, image_idx, places, baseline):
        pixels[front], by_world[front] = found, by_cam @ rotation[image_idx[front]]
    return pixels, by_world


def pixels_of(scene: Scene, image_idx: IntArray, places: FloatArray) -> FloatArray:
    """Pixels (N, 2) of points in the world; NaN behind the camera."""
    pixels = np.full((len(places), 2), np.nan)

    def fill(part: slice) -> None:
        for front, found, _ in _projected(scene, image_idx[part], places[part]):
            pixels[part][front] = found

    map_ranges(fill, len(places), _ROWS_AT_ONCE)
    return pixels


def _projected(
    scene: Scene, image_idx: IntArray, places: FloatArray, baseline: FloatArray | float = 0.0
) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
    """Yield rows in front of their camera, their pixels, and the derivatives by coordinates in the camera."""
    poses = scene.cam_from_world[image_idx]
    in_cam = quaternion.rotate(poses[:, :4], places) + poses[:, 4:]
    in_cam[:, 0] -= baseline
    for model, rows, params in scene.cameras.rows_by_model(scene.images.camera_idx[image_idx]):
        seen = model.sees_behind | (in_cam[rows, 2] > 0)
        pixels, by_cam, _ = model.project_jacobian(params[seen], np.ascontiguousarray(in_cam[rows[seen]]))
        yield rows[seen], pixels, by_cam


def _pixel_rows(scene: Scene) -> tuple[IntArray, FloatArray, FloatArray]:
    """Points (N,), whitened residuals (N,) and their derivatives (N, 3) of the coordinates of all observations."""
    table = scene.point_observations
    pixels, by_world = project_points(scene, table.image_idx, scene.points.xyz[table.point_idx])
    residual = pixel_differences(scene, table.image_idx, pixels, table.pixel) / table.sigma[:, None]
    return np.repeat(table.point_idx, 2), residual.ravel(), (by_world / table.sigma[:, None, None]).reshape(-1, 3)


def _column_rows(scene: Scene) -> tuple[IntArray, FloatArray, FloatArray]:
    """The same of the columns in right images."""
    table = scene.right_columns
    seen = scene.point_observations.take(table.observation_idx)
    pixels, by_world = project_points(scene, seen.image_idx, scene.points.xyz[seen.point_idx], table.baseline)
    return seen.point_idx, (pixels[:, 0] - table.u_right) / table.sigma, by_world[:, 0] / table.sigma[:, None]


def _depth_rows(scene: Scene) -> tuple[IntArray, FloatArray, FloatArray]:
    """The same of measured depths."""
    table = scene.point_depths
    poses = scene.cam_from_world[table.image_idx]
    axis = quaternion.to_matrix(poses[:, :4])[:, 2]
    residual = dot(axis, scene.points.xyz[table.point_idx]) + poses[:, 6] - table.depth
    return table.point_idx, residual / table.sigma, axis / table.sigma[:, None]


def pixel_differences(scene: Scene, image_idx: IntArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Differences (N, 2) of pixels, in panoramas the short way round."""
    difference = first - second
    for model, rows, params in scene.cameras.rows_by_model(scene.images.camera_idx[image_idx]):
        difference[rows] = model.pixel_difference(params, first[rows], second[rows])
    return difference


def _share_on_line(scene: Scene, image_idx: IntArray, measured: FloatArray, ends: FloatArray) -> FloatArray:
    """Where on the segments (0 first end, 1 second) the points closest to the rays of pixels lie."""
    share = shares_on_lines(scene, image_idx, measured, ends, min_squared_sine=1e-12)
    # Rays nearly along the line are uninformative, and far points would only disturb.
    return np.where(np.abs(share - 0.5) < GATES.max_share, share, np.nan)


def _misfit(squares: FloatArray, freedom: IntArray, sigma_px: float | None) -> tuple[float, FloatArray]:
    """Noise of a coordinate, robustly over the landmarks, and each landmark's misfit in units of it."""
    known = freedom > 0
    variance = ratio(squares, freedom.astype(np.float64), known, 0.0)
    sigma = GATES.min_sigma_px
    if sigma_px is not None:
        sigma = sigma_px
    elif known.any():
        order = np.argsort(variance[known])
        # The landmark in the middle of the degrees of freedom; a few outliers do not move it.
        cumulated = np.cumsum(freedom[known][order])
        middle = order[np.searchsorted(cumulated, 0.5 * cumulated[-1])]
        sigma = float(np.sqrt(variance[known][middle]))
    sigma = max(sigma, GATES.min_sigma_px)
    return sigma, np.sqrt(variance) / sigma


def _sum(blocks: FloatArray, owner: IntArray, count: int) -> FloatArray:
    """Sums (count, a, b) of blocks (N, a, b) by owner."""
    flat = blocks.reshape(len(blocks), math.prod(blocks.shape[1:]))
    out = np.zeros((count, flat.shape[1]))
    for column in range(flat.shape[1]):
        out[:, column] = np.bincount(owner, weights=flat[:, column], minlength=count)
    return out.reshape(count, *blocks.shape[1:])


def _extent(scene: Scene) -> float:
    places = np.concatenate([scene.points.xyz, scene.lines.segments.reshape(-1, 3), scene.cam_centers_in_world])
    away = norm(places - np.median(places, axis=0)) if len(places) else np.ones(1)
    return max(float(np.median(away)), 1e-12)


def _inverse(information: FloatArray, extent: float) -> FloatArray:
    """Inverses of information matrices; unobserved directions are uncertain by the extent of the scene."""
    return np.asarray(np.linalg.inv(information + np.eye(information.shape[-1]) / extent**2), dtype=np.float64)
