# SPDX-License-Identifier: BSD-3-Clause
r"""What is wrong with a whole map: errors of its poses and calibrations, and of a query's pose by them.

The covariance of a landmark is that with poses and calibrations of the map held. These were estimated, too. An error
:math:`\delta\theta` of them moves each landmark, which stays where its observations say,

.. math:: \delta X = -V^{-1} \sum_o J_{X,o}^\top W_o J_{\theta,o}\, \delta\theta, \qquad
          V = \sum_o J_{X,o}^\top W_o J_{X,o},

and all landmarks of a query at once: nothing is averaged out. What the query is off by then is, with its information
:math:`H` and derivatives by its own unknowns :math:`J_q`,

.. math:: \delta q = -H^{-1} \sum_i J_{q,i}^\top W_i (J_{X,i}\, \delta X_i + J_{c,i}\, \delta c) = K\, \delta\theta ,

where :math:`\delta c` is there if the query has the calibration of a camera of the map, whose error it shares. Its
covariance grows by :math:`K \Sigma_\theta K^\top`. :math:`\Sigma_\theta` is that of the adjustment of the map by its
points and lines, landmarks eliminated, in the frame in which the camera centres (and rotations, if the centres are on a
line) vary least together: errors of a query are relative to the map. What the observations do not know, such as a lens
of another model, is not in it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from groma._numba import loop
from groma._rows import pointers_of
from groma._typing import FloatArray, IntArray
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.stages import STAGES, with_loss
from groma.errors import InputError
from groma.factors.losses import GemanMcClure
from groma.gates import gate
from groma.localization.errors.held_poses import held_poses
from groma.localization.errors.views import Views, views_of
from groma.localization.pose.refinement import Refined, last_scale
from groma.scene import Relations, Scene
from groma.solver.covariance.marginals import Covariances


@dataclass(frozen=True)
class CommonErrorGates:
    """Of which maps common errors are told."""

    unknowns: int = gate(4000, "unknowns", "of poses and calibrations; larger maps are exact", "cost: their square")


GATES = CommonErrorGates()


# ---------------------------------------------------------------------------------------------------------- Kernels
@loop
def _pull_views(begin, seen, motion, landmarks, by_landmark, first_camera, K):
    """Add to K what landmarks (n,) do that pull (n, d, m) at a query, view by view of the map; m is three or six."""
    parameters, size = motion.shape[2] - 6, motion.shape[1]
    for n in range(landmarks.shape[0]):
        if landmarks[n] >= begin.shape[0] - 1:
            continue
        pull = by_landmark[n]
        for row in range(begin[landmarks[n]], begin[landmarks[n] + 1]):
            frame, camera = 6 * seen[row, 1], first_camera + parameters * seen[row, 2]
            for k in range(0, size, 3):
                for j in range(motion.shape[2]):
                    place = frame + j if j < 6 else camera + j - 6
                    x, y, z = motion[row, k, j], motion[row, k + 1, j], motion[row, k + 2, j]
                    for i in range(pull.shape[0]):
                        K[place, i] += pull[i, k] * x + pull[i, k + 1] * y + pull[i, k + 2] * z


# ----------------------------------------------------------------------------------------------------------- Public
@dataclass(frozen=True, eq=False)
class Responses:
    """How landmarks follow errors of poses and calibrations, one row an observation, in the order of the landmarks."""

    #: (N, 3) landmark, frame and camera.
    seen: IntArray
    #: (N, m, 6 + p) motion of the landmark by the left twist of the frame and the parameters of the camera: points in
    #: space, lines as (moment, direction).
    motion: npt.NDArray[np.float32]

    @cached_property
    def begin(self) -> IntArray:
        """Where the rows of each landmark begin, and end."""
        return pointers_of(np.bincount(self.seen[:, 0], minlength=1))


@dataclass(frozen=True, eq=False)
class CommonErrors:
    """Errors of the poses and calibrations of a map."""

    #: (n, n) of the left twists of all frames, then of the parameters of all cameras, so many of each.
    covariance: FloatArray
    frames: int
    points: Responses
    lines: Responses

    @property
    def parameters(self) -> int:
        """Number of parameters of each camera that have errors."""
        return self.points.motion.shape[2] - 6

    def of_query(self, refined: Refined, landmarks: tuple[IntArray, IntArray], camera: int | None = None) -> FloatArray:
        """Return what they add to the covariance (6 + k, 6 + k) of the pose of a query, and of what is estimated of its
        lens, as far from where it was given.

        Parameters
        ----------
        refined
            The pose.
        landmarks
            Points (N,) and lines (M,) of the map that the matches are of.
        camera
            The camera of the map whose calibration the query has.
        """
        kept = refined.point_inliers, refined.line_inliers
        J = np.concatenate([refined.points.by_pose[kept[0]], refined.lines.by_pose[kept[1]]])
        r = np.concatenate([refined.points.value[kept[0]], refined.lines.value[kept[1]]])
        weight = (1.0 + (r**2).sum(axis=1) / last_scale(len(r)) ** 2) ** -2
        pull = weight[:, None, None] * J
        place = [np.cumsum(kept[0]) - 1, np.cumsum(kept[1]) - 1 + int(kept[0].sum())]
        K = np.zeros((len(self.covariance), J.shape[2]))
        one = refined.one
        for part, white in zip(one.parts, refined.weights, strict=True):
            lines = part.kind == "lines"
            own, agree = (self.lines if lines else self.points), kept[int(lines)][part.row]
            matched = part.row[agree]
            row, seen = place[int(lines)][matched], landmarks[int(lines)][matched]
            record = white[agree] @ one.records(part, "landmark", "lens")[agree][..., :-1]
            by_own, by_lens = np.split(record, [own.motion.shape[1]], axis=2)
            moved = np.swapaxes(pull[row], 1, 2) @ by_own
            _pull_views(own.begin, own.seen, own.motion, seen, moved, 6 * self.frames, K)
            if camera is not None and self.parameters and part.has_lens:
                first = 6 * self.frames + camera * self.parameters
                K[first : first + by_lens.shape[2]] += _product(by_lens, pull[row])
        H = _product(pull, J) + refined.prior
        scale = 1.0 / np.sqrt(np.diag(H))
        step = (K * scale) @ np.linalg.inv(H * np.outer(scale, scale)) * scale
        return step.T @ self.covariance @ step


def _product(first: FloatArray, second: FloatArray) -> FloatArray:
    """Sum of the products (i, j) of matrices (n, k, i), transposed, and (n, k, j)."""
    return first.reshape(-1, first.shape[2]).T @ second.reshape(-1, second.shape[2])


def common_errors(
    scene: Scene, described: Scene, noise: tuple[float, float], estimated: tuple[bool, bool],
    gates: CommonErrorGates = GATES,
) -> tuple[CommonErrors | None, FloatArray]:  # fmt: skip
    """Return the common errors of a map; None where it has none, or does not determine them, or is too large. And (N,
    6, 6) by how much more than its landmarks make them, poses of its frames differ from held ones.

    Parameters
    ----------
    scene
        The map as it was adjusted.
    described
        The same poses, with the points that queries are matched with.
    noise
        Of its points and lines, in units of what is stated.
    estimated
        Whether its poses and its calibrations were estimated; else calibrations are exact, and poses as exact as its
        points say.
    gates
        How large it may be.
    """
    frames, count = scene.num_frames, max(len(row) for row in _params(scene)) if estimated[1] else 0
    beyond = np.zeros((frames, 6, 6))
    if 6 * frames + count * len(scene.cameras) > gates.unknowns:  # derived from the six numbers of a pose
        return None, beyond
    bare = scene.keep(planes=[], directions=[])
    seen, lines = bare.point_observations, bare.line_observations
    bare = bare.replace(
        point_observations=seen.replace(sigma=seen.sigma * noise[0]),
        line_observations=lines.replace(sigma=lines.sigma * noise[1]),
        relations=Relations(),
    )
    try:
        covariance = _of_estimated(bare, estimated) if any(estimated) else np.zeros((6 * frames, 6 * frames))
    except InputError:  # not even what the cameras see and where they are determines a frame
        return None, beyond
    points = views_of(described.keep(lines=[], planes=[], directions=[]), "points", count)
    if not estimated[0]:
        held = held_poses(described)
        covariance[: 6 * frames, : 6 * frames] = np.diag(np.tile(np.repeat(held.sigma**2, 3), frames))
        beyond = held.of_difference
    if not covariance.any():
        return None, beyond
    if estimated[1]:
        covariance = _padded(covariance, scene, count)
    lines_of = views_of(bare.keep(points=[]), "lines", count)
    return CommonErrors(np.nan_to_num(covariance), frames, responses(points), responses(lines_of)), beyond


def _of_estimated(scene: Scene, estimated: tuple[bool, bool]) -> FloatArray:
    """Joint covariance of the poses and calibrations of a scene; zero for those that were held."""
    options = AssemblyOptions(
        refine_poses=estimated[0], refine_intrinsics=estimated[1], refine_principal_point=None, gauge="free"
    )
    problem = with_loss(assemble(scene, options).problem, GemanMcClure(STAGES.last_scale))
    if not estimated[0]:
        return Covariances(problem, "held").joint(_variables(scene, estimated[1]))
    try:
        found = Covariances(problem, "inner", datum={"frames": [1, 1, 1, 0, 0, 0]})
    except InputError:  # centres on a line leave the rotation about it free: turns count as far as the line is long
        turn = np.ptp(scene.cam_centers_in_world, axis=0).max() ** 2
        found = Covariances(problem, "inner", datum={"frames": [1, 1, 1, turn, turn, turn]})
    return found.joint(_variables(scene, estimated[1]))


def _params(scene: Scene) -> list[FloatArray]:
    return [scene.cameras.params_of(row) for row in range(len(scene.cameras))]


def _variables(scene: Scene, calibrations: bool) -> list[tuple[str, int]]:
    """Names and numbers of the frames of a problem, and of its cameras in the order of the scene."""
    found = [("frames", row) for row in range(scene.num_frames)]
    if calibrations:
        place = _places(scene)
        found += [(f"intrinsics/{model}", int(place[row])) for row, model in enumerate(scene.cameras.models)]
    return found


def _places(scene: Scene) -> IntArray:
    """Number (C,) of each camera among those of its model."""
    place = np.zeros(len(scene.cameras), np.int64)
    for members in scene.cameras.by_model().values():
        place[members] = np.arange(len(members))
    return place


def _padded(covariance: FloatArray, scene: Scene, count: int) -> FloatArray:
    """The same with as many parameters for each camera."""
    first, sizes = 6 * scene.num_frames, [len(row) for row in _params(scene)]
    rows = [np.arange(first)]
    rows += [first + number * count + np.arange(size) for number, size in enumerate(sizes)]
    into = np.concatenate(rows)
    out = np.zeros((first + count * len(sizes),) * 2)
    out[np.ix_(into, into)] = covariance
    return out


def responses(views: Views) -> Responses:
    """Return how landmarks follow errors of the frames and cameras of their views."""
    information, good = views.determined()
    order = np.flatnonzero(good)[np.argsort(views.landmark[good], kind="stable")]
    landmark, by_view = views.landmark[order], np.concatenate([views.by_frame, views.by_camera], axis=2)[order]
    pulled = np.swapaxes(views.by_landmark[order], 1, 2) @ by_view
    motion = -views.free[landmark] @ np.linalg.solve(information[landmark], pulled)
    seen = np.column_stack([landmark, views.frame[order], views.camera[order]]).astype(np.int64)
    return Responses(seen, motion.astype(np.float32))
