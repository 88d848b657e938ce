# SPDX-License-Identifier: BSD-3-Clause
r"""Adjustment of a graph of similarities: what a pose graph is for cameras whose scale drifts.

A monocular map has no unit of length: its scale drifts from keyframe to keyframe. Each
camera then is a similarity :math:`S` (``cam_from_world``), whose scale is the length of the world's unit in that of the
camera. With the measured :math:`Z_{ij}` (``first_from_second``: poses with scale 1 between neighbours, and a scale
where a place was recognised) it minimises

.. math:: \tfrac12 \sum_{ij} \rho\big(\lVert r(Z_{ij}, S_i, S_j) \rVert^2_{\Sigma_{ij}^{-1}}\big)

with :math:`r` of :mod:`groma.factors.priors.similarity_between`.

Reference: H. Strasdat, J. M. M. Montiel, A. J. Davison, *Scale drift-aware large scale monocular SLAM*, RSS 2010.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import InputError, ShapeError, given_or_default
from groma.factors.contract import Ref
from groma.factors.priors.similarity_between import SimilarityBetween
from groma.geometry.charts.similarity import SIMILARITY_CHARTS
from groma.problem.problem import Problem
from groma.problem.residuals import squared_norms
from groma.problem.variables import Variables
from groma.solver.options import SolverOptions
from groma.solver.report import SolveReport
from groma.solver.solve import solve


@dataclass(frozen=True, eq=False)
class SimilarityMotions:
    """Measured similarities between pairs of cameras."""

    #: (E,) rows of the two cameras.
    first_idx: IntArray
    second_idx: IntArray
    #: (E, 8) quaternion xyzw, translation and scale that take the second camera's coordinates to the first's.
    first_from_second: FloatArray
    #: (E, 7, 7) covariance of the error (translation, rotation, logarithm of the scale), in the unit of the second.
    covariance: FloatArray

    def __post_init__(self) -> None:
        count = len(self.first_idx)
        for name, shape in (("second_idx", ()), ("first_from_second", (8,)), ("covariance", (7, 7))):
            got = np.shape(getattr(self, name))
            if got != (count, *shape):
                raise ShapeError(f"{name} must have shape {(count, *shape)}, a row for each motion; got {got}.")

    def __len__(self) -> int:
        return len(self.first_idx)


@dataclass(frozen=True, eq=False)
class SimilarityGraphResult:
    """The adjusted cameras, and the course of the adjustment."""

    #: (N, 8) similarities, cam_from_world.
    cam_from_world: FloatArray
    #: (E,) squared error of every motion in variances, without the loss.
    chi_square: FloatArray
    report: SolveReport


def adjust_similarity_graph(
    cam_from_world: FloatArray, motions: SimilarityMotions, options: SolverOptions | None = None
) -> SimilarityGraphResult:
    """Adjust cameras, each with a scale, to the similarities measured between them.

    Parameters
    ----------
    cam_from_world : (N, 8) float64
        Similarities at the start; of poses, with a scale of 1. The first stays.
    motions : SimilarityMotions
        What was measured.
    options : SolverOptions, optional
        How it is solved.

    Raises
    ------
    InputError
        If there are no motions, or one names a camera that is not there.
    """
    count = len(cam_from_world)
    if not len(motions):
        raise InputError(f"The graph has {count} cameras and no motions between them; nothing to adjust.")
    named = np.concatenate([motions.first_idx, motions.second_idx])
    if named.min() < 0 or named.max() >= count:
        raise InputError(f"A motion names camera {named.max()} or {named.min()}; the cameras are 0 to {count - 1}.")
    factor = SimilarityBetween(
        first=Ref("cameras", motions.first_idx),
        second=Ref("cameras", motions.second_idx),
        first_from_second=motions.first_from_second,
        sqrt_information=np.asarray(np.linalg.inv(np.linalg.cholesky(motions.covariance)), np.float64),
    )
    cameras = Variables(SIMILARITY_CHARTS["left"], cam_from_world, np.arange(count) == 0)
    solution = solve(Problem({"cameras": cameras}, [factor]), given_or_default(options, SolverOptions))
    squares = squared_norms(factor, solution.problem.variables)
    return SimilarityGraphResult(solution["cameras"], squares, solution.report)
