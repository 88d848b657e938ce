# SPDX-License-Identifier: BSD-3-Clause
"""Points of a map that queries are matched with: described, triangulated from the poses of the map, with covariances.

The points of the map itself may have been followed rather than described, or come from other features. These are made
anew, in the same world: features of images that see the same are matched, matches that the poses contradict are left
out, the rest are joined to tracks, and each track gives a point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import sparse

from groma._rows import Rows, column, pointers_of
from groma._typing import BoolArray, FloatArray, IntArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.fit import noise_of
from groma.adjustment.stages import with_loss
from groma.factors.contract import Factor
from groma.factors.losses import Cauchy
from groma.features.matching.wide_baseline import fundamental_from_poses
from groma.gates import NORMAL, chi_square_gate, gate
from groma.geometry import quaternion, se3
from groma.localization.features import DescribedPoints, unit
from groma.localization.matching import match_descriptors
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.records import LANDMARK_LOSS, landmark_covariances, landmark_rows, residual_squares
from groma.scene import PointObservations, Points, Scene
from groma.solver.options import SolverOptions
from groma.solver.solve import solve


@dataclass(frozen=True)
class TriangulationGates:
    """Which features become points of the map."""

    depth: float = gate(0.2, "share", "of its distance: largest standard deviation of a point", "convention: a fifth")


GATES = TriangulationGates()
_ASSEMBLY = AssemblyOptions(
    refine_poses=False, require_in_front=True, drop_behind=False, point_chart="euclidean", gauge="free"
)
_SOLVER = SolverOptions(max_iterations=20, function_tolerance=1e-6, threads=None)


@dataclass(frozen=True, eq=False)
class PointMap:
    """Described points of a map."""

    #: (P, 3) places, (P, 3, 3) covariances with the poses of the map as they are.
    xyz: FloatArray
    covariance: FloatArray
    #: (F,) of each feature of all images, in their order, its point; -1 for those that have none.
    point: IntArray
    #: Noise of the features that residuals show, in units of what is stated.
    noise: float = 1.0


def triangulate_features(
    scene: Scene, features: Sequence[DescribedPoints], pairs: IntArray, say: Callable[[int, int], None]
) -> PointMap:
    """Match the features of pairs (n, 2) of images, and triangulate them.

    ``say`` is told how many pairs are done, of how many.
    """
    begin = pointers_of([len(one) for one in features])
    straight = [_straight(scene, image, one) for image, one in enumerate(features)]
    edges: list[IntArray] = [np.zeros((0, 2), np.int64)]
    vectors = [unit(one.descriptors) for one in features]
    for done, (i, j) in enumerate(pairs):
        say(done, len(pairs))
        found = match_descriptors(vectors[i], vectors[j])
        near = _in_beam(scene, straight, features, (int(i), int(j)), found, NORMAL.mistake)
        edges.append(found[near] + begin[[i, j]])
    track = _tracks(np.concatenate(edges), np.repeat(np.arange(len(features)), np.diff(begin)))
    row = np.flatnonzero(track >= 0)
    image = np.repeat(np.arange(len(features)), np.diff(begin))[row]
    pixels, sigma = (np.concatenate([getattr(one, name) for one in features])[row] for name in ("pixels", "sigma"))
    seen = _Observed(row, image, track[row], pixels, sigma)
    return _points(scene, seen, np.concatenate(straight)[row], len(track))


def _straight(scene: Scene, image: int, features: DescribedPoints) -> FloatArray:
    return QueryCamera.of(scene.cameras, int(scene.images.camera_idx[image])).straight(features.pixels)


def _in_beam(
    scene: Scene,
    straight: Sequence[FloatArray],
    features: Sequence[DescribedPoints],
    pair: tuple[int, int],
    matches: IntArray,
    limit: float,
) -> BoolArray:
    """Which matches of a pair of images lie on each other's epipolar lines."""
    poses, K = [], []
    for image in pair:
        poses.append(se3.to_matrix(scene.cam_from_world[image : image + 1])[0][:3])
        K.append(QueryCamera.of(scene.cameras, int(scene.images.camera_idx[image])).matrix)
    F = fundamental_from_poses(poses[0], poses[1], K[0], K[1])
    x = np.column_stack([straight[pair[0]][matches[:, 0]], np.ones(len(matches))])
    y = np.column_stack([straight[pair[1]][matches[:, 1]], np.ones(len(matches))])
    line_y, line_x = x @ F.T, y @ F
    product = (y * line_y).sum(axis=1)
    variance = (line_y[:, :2] ** 2).sum(axis=1) * features[pair[1]].sigma[matches[:, 1]] ** 2
    variance += (line_x[:, :2] ** 2).sum(axis=1) * features[pair[0]].sigma[matches[:, 0]] ** 2
    with np.errstate(invalid="ignore", divide="ignore"):
        return product**2 <= limit**2 * variance


def _tracks(edges: IntArray, image: IntArray) -> IntArray:
    """Number (F,) of the track of each feature; -1 for single ones, and for tracks with two features of an image."""
    count = len(image)
    graph = sparse.coo_matrix((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), (count, count))
    label = sparse.csgraph.connected_components(graph, directed=False)[1].astype(np.int64)
    size = np.bincount(label, minlength=1)
    images = np.bincount(np.unique(np.column_stack([label, image]), axis=0)[:, 0], minlength=len(size))
    good = (size > 1) & (images == size)
    number = np.where(good, np.cumsum(good) - 1, -1)
    return number[label]


@dataclass(frozen=True, eq=False)
class _Observed(Rows):
    """Features that belong to tracks."""

    #: (n,) their numbers among all features, images, and tracks; pixels (n, 2), standard deviations.
    row: IntArray = column(dtype=np.int64)
    image: IntArray = column(dtype=np.int64)
    track: IntArray = column(dtype=np.int64)
    pixel: FloatArray = column(2)
    sigma: FloatArray = column()


def _points(scene: Scene, seen: _Observed, straight: FloatArray, count: int) -> PointMap:
    """Points of tracks: nearest to their rays, then refined, twice, each time without what does not agree."""
    xyz = _nearest_to_rays(scene, seen, straight)
    covariance, scale = np.zeros((len(xyz), 3, 3)), 1.0
    # without measurements, which the held cameras answer already
    bare = Scene(
        scene.cameras, scene.rigs, scene.sensors, scene.frames, scene.images, camera_motions=scene.camera_motions
    )
    for loss in (Cauchy(2.0), LANDMARK_LOSS):
        good = np.isfinite(xyz).all(axis=1) & (np.bincount(seen.track, minlength=len(xyz)) > 1)
        seen = seen.take(good[seen.track])
        if not len(seen.row):
            return PointMap(np.zeros((0, 3)), np.zeros((0, 3, 3)), np.full(count, -1))
        posed = bare.replace(
            points=Points.at(np.where(good[:, None], xyz, 0.0)),
            point_observations=PointObservations.numbered(seen.image, seen.track, seen.pixel, seen.sigma),
        )
        problem = solve(with_loss(assemble(posed, _ASSEMBLY).problem, loss), _SOLVER).problem
        xyz = problem.variables["points"].ambient()
        of_points = (factor for factor in problem.factors if landmark_rows(factor, "points") is not None)
        order = np.concatenate([_rows_of(factor, seen, scene) for factor in of_points])
        squares = np.empty(len(seen.row))
        squares[order] = residual_squares(problem, "points", len(order))
        scale = noise_of(squares) ** 2
        covariance = landmark_covariances(problem, "points", len(xyz)) * scale
        agrees = (squares > 0.0) & (squares <= chi_square_gate(NORMAL.outlier, 2) * scale)
        seen = seen.take(agrees)
    return replace(_well_determined(scene, seen, xyz, covariance, count), noise=float(np.sqrt(scale)))


def _nearest_to_rays(scene: Scene, seen: _Observed, straight: FloatArray) -> FloatArray:
    """Points (T, 3) of tracks that are nearest to the rays of their features; NaN where these are parallel."""
    camera = scene.images.camera_idx[seen.image]
    K = np.array([QueryCamera.of(scene.cameras, row).matrix for row in range(len(scene.cameras))])[camera]
    rays = np.column_stack([(straight - K[:, :2, 2]) / K[:, [0, 1], [0, 1]], np.ones(len(straight))])
    rays = quaternion.rotate(quaternion.conjugate(scene.cam_from_world[seen.image, :4]), rays)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    finite = np.isfinite(across).all(axis=(1, 2))
    count = int(seen.track.max()) + 1 if len(seen.track) else 0
    A, b = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(A, seen.track[finite], across[finite])
    centers = scene.cam_centers_in_world[seen.image]
    np.add.at(b, seen.track[finite], np.einsum("nij,nj->ni", across, centers)[finite])
    good = np.linalg.det(A) > 1e-12
    xyz = np.full((count, 3), np.nan)
    xyz[good] = np.linalg.solve(A[good], b[good][..., None])[..., 0]
    return xyz


def _well_determined(scene: Scene, seen: _Observed, xyz: FloatArray, covariance: FloatArray, count: int) -> PointMap:
    away = xyz[seen.track] - scene.cam_centers_in_world[seen.image]
    distance = np.full(len(xyz), np.inf)
    np.minimum.at(distance, seen.track, np.linalg.norm(away, axis=1))
    often = np.bincount(seen.track, minlength=len(xyz)) > 1
    with np.errstate(invalid="ignore"):
        good = often & (np.sqrt(np.trace(covariance, axis1=1, axis2=2)) <= GATES.depth * distance)
    number = np.where(good, np.cumsum(good) - 1, -1)
    point = np.full(count, -1)
    point[seen.row] = number[seen.track]
    return PointMap(xyz[good], covariance[good], point)


def _rows_of(factor: Factor, seen: _Observed, scene: Scene) -> IntArray:
    """Observations of a group of factors, which holds those of one camera model in order."""
    models = np.array(scene.cameras.models, dtype=object)[scene.images.camera_idx[seen.image]]
    name = factor.camera_model.name  # type: ignore[attr-defined]  # of points seen at pixels
    return np.flatnonzero(models == name)
