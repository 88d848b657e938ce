# SPDX-License-Identifier: BSD-3-Clause
r"""Errors of held poses, estimated from the points of the map.

Poses of a survey or of another program are held, and have errors :math:`e_i`: left twists with the covariance
:math:`\Sigma`, whose variances :math:`\sigma_t^2` (a coordinate of a centre) and :math:`\sigma_r^2` (of a rotation)
are unknown. They are estimated in three steps.

1. *Adjustment.* Poses and points are adjusted; the held poses are measurements of covariance :math:`\Sigma`, by the
   estimate so far. Linearised at the held poses, robust weights would take errors of poses for outliers, and the
   gradient would be too small.
2. *Gradient at the held poses.* Let :math:`H` and :math:`g_0` be the normal equations of the poses after the
   adjustment, points eliminated, and :math:`\delta` the twists from there to the held poses. Then

   .. math:: g = g_0 + H \delta = H e + n , \qquad \operatorname{cov} n = H .

3. *Variances*, by restricted maximum likelihood. With

   .. math:: W = (I + H \Sigma)^{-1} H, \qquad u = (I + H \Sigma)^{-1} g ,

   and their blocks of centres (t) and rotations (r), new variances on the left follow from old ones on the right:

   .. math:: \sum_l \|W_{kl}\|_F^2\, \sigma_l^2 =
             |u_k|^2 - \operatorname{tr} W_{kk} + \sum_l \|W_{kl}\|_F^2\, \sigma_l^2 , \qquad k, l \in \{t, r\} ,

   solved without negative ones, until they no longer change. Variances of exact poses become zero.

Points say nothing of motions of the whole map: :math:`H` is zero for them, and they do not change the estimate.

A map with such poses misplaces photographs, too. With all others held, the points of image i ask for a pose that
differs from the held one by :math:`e_i + H_{ii}^{-1} \sum_{j \ne i} H_{ij} e_j`; the covariance follows from
:math:`\Sigma`.

Reference: H. D. Patterson, R. Thompson, *Recovery of inter-block information when block sizes are unequal*, 1971.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.assemble import assemble, disassemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.fit import noise_of
from groma.adjustment.stages import with_loss
from groma.geometry import se3
from groma.localization.errors.views import Views, views_of
from groma.localization.pose.records import LANDMARK_LOSS, residual_squares
from groma.scene import PosePriors, Scene
from groma.solver.linear.blas import one_blas_thread
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

#: Adjustments, each with the variances after the one before (cost: of each).
_ADJUSTED = 2
#: Estimates of variances, each from the one before, and the relative change after which there is none (cost: of a
#: product of matrices each).
_ROUNDS, _ENOUGH = 20, 1e-3
#: Least variance of a measured pose, as a share of the first estimate, so that it has an inverse.
_LEAST = 1e-6
_FREE = AssemblyOptions(drop_behind=False, point_chart="euclidean", gauge="free")
_SOLVER = SolverOptions(max_iterations=20, function_tolerance=1e-5, threads=None)


@dataclass(frozen=True, eq=False)
class HeldPoses:
    """Errors of held poses."""

    #: (2,) standard deviations of a coordinate of the centre, scene units, and of the rotation, radians.
    sigma: FloatArray
    #: (N, 6, 6) covariance, by these errors, of the difference of a held pose and the one that its image shows while
    #: all others are held.
    of_difference: FloatArray


def held_poses(scene: Scene) -> HeldPoses:
    """Return the errors of the held poses of a scene that its points show; lines are not asked."""
    scene = scene.keep(lines=[], planes=[], directions=[])
    frames, seen, held = scene.num_frames, scene.point_observations, scene.frames.rig_from_world
    H, g = _normal_equations(views_of(scene, "points", 0), frames)
    known, inverse = _of_one_frame(H)
    one_step = np.einsum("nij,nj->ni", inverse, g[known]).reshape(-1, 2, 3)
    variance = first = (one_step**2).sum(axis=(0, 2)) / max(3 * len(known), 1)
    if not first.all():
        return HeldPoses(np.zeros(2), np.zeros((frames, 6, 6)))
    for _ in range(_ADJUSTED):
        sigma = np.tile(np.repeat(np.sqrt(np.maximum(variance, _LEAST * first)), 3), (frames, 1))
        priors = PosePriors(np.arange(frames), held, sigma)
        problem = with_loss(assemble(scene.replace(pose_priors=priors), _FREE).problem, LANDMARK_LOSS)
        problem = solve(problem, _SOLVER).problem
        noise = noise_of(residual_squares(problem, "points", len(seen)))
        moved = disassemble(scene, problem).replace(point_observations=seen.replace(sigma=seen.sigma * noise))
        H, g = _normal_equations(views_of(moved, "points", 0), frames)
        back = se3.log(se3.compose(held, se3.inverse(moved.frames.rig_from_world)))
        gradient = g + np.einsum("nimj,mj->ni", H, back)
        with one_blas_thread():
            variance = _variances(H.reshape(6 * frames, -1), gradient.ravel(), variance)
    known, inverse = _of_one_frame(H)
    by_all = np.einsum("nij,njmk->nimk", inverse, H[known]) * np.sqrt(np.repeat(variance, 3))
    by_all = by_all.reshape(len(known), 6, -1)
    of_difference = np.zeros((frames, 6, 6))
    of_difference[known] = by_all @ np.swapaxes(by_all, 1, 2)
    return HeldPoses(np.sqrt(variance), of_difference)


def _of_one_frame(H: FloatArray) -> tuple[IntArray, FloatArray]:
    """Frames that their points determine, all others held; and the inverses (n, 6, 6) of their normal equations."""
    own = H[np.arange(len(H)), :, np.arange(len(H))]
    known = np.flatnonzero(np.linalg.eigvalsh(own)[:, 0] > 1e-12 * np.trace(own, axis1=1, axis2=2))
    return known.astype(np.int64), np.asarray(np.linalg.inv(own[known]), np.float64)


def _normal_equations(views: Views, frames: int) -> tuple[FloatArray, FloatArray]:
    """Normal equations of frames, H (N, 6, N, 6) and g (N, 6), with the landmarks eliminated."""
    from scipy import sparse  # slow to import

    information, good = views.determined()
    rows = np.flatnonzero(good)
    landmark, frame = views.landmark[rows], views.frame[rows]
    J, by_landmark, r = views.by_frame[rows], views.by_landmark[rows], views.residual[rows]
    coupled = np.swapaxes(by_landmark, 1, 2) @ J
    root = np.zeros_like(information)
    some = np.unique(landmark)
    root[some] = np.linalg.inv(np.linalg.cholesky(information[some]))
    size, shape = information.shape[1], (len(information) * information.shape[1], 6 * frames)
    at = np.broadcast_arrays(
        size * landmark[:, None, None] + np.arange(size)[:, None], 6 * frame[:, None, None] + np.arange(6)
    )
    white = sparse.csr_matrix(((root[landmark] @ coupled).ravel(), (at[0].ravel(), at[1].ravel())), shape)
    pulled = np.zeros((len(information), size))
    np.add.at(pulled, landmark, np.einsum("nki,nk->ni", by_landmark, r))
    g = np.zeros((frames, 6))
    np.add.at(g, frame, np.einsum("nki,nk->ni", J, r))
    g -= (white.T @ np.einsum("nij,nj->ni", root, pulled).ravel()).reshape(-1, 6)
    H = -(white.T @ white).toarray().reshape(frames, 6, frames, 6)
    own, every = np.zeros((frames, 6, 6)), np.arange(frames)
    np.add.at(own, frame, np.swapaxes(J, 1, 2) @ J)
    H[every, :, every] += own
    return H, g


def _variances(H: FloatArray, g: FloatArray, variance: FloatArray) -> FloatArray:
    """The variances (2,) of coordinates of centres and of rotations; beginning with an estimate of both."""
    from scipy.optimize import nnls  # slow to import

    of_kind = np.arange(len(g)).reshape(-1, 2, 3).swapaxes(0, 1).reshape(2, -1)
    for _ in range(_ROUNDS):
        scale = np.empty(len(g))  # metres and radians differ: unknowns are scaled to one
        scale[of_kind] = np.sqrt(variance)[:, None]
        scaled = H * np.outer(scale, scale)
        left = np.linalg.solve(np.eye(len(g)) + scaled, np.column_stack([scaled, scale * g]))
        W, u = left[:, :-1], left[:, -1]
        square = np.array([[float((W[np.ix_(rows, columns)] ** 2).sum()) for columns in of_kind] for rows in of_kind])
        more = (u[of_kind] ** 2).sum(axis=1) - np.diag(W)[of_kind].sum(axis=1)
        before, variance = variance, variance * nnls(square, square.sum(axis=1) + more)[0]
        if np.allclose(variance, before, rtol=_ENOUGH, atol=0.0):
            break
    return variance
