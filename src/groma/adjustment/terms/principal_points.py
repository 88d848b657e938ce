# SPDX-License-Identifier: BSD-3-Clause
r"""Principal points of cameras whose calibration was not given.

Lenses are centred to about a hundredth of the longer side of an image: an offset of half of that turns all cameras
alike by a third of a degree, and bends the path of cameras that look in several directions. With

.. math:: c \sim \mathcal N(\tilde c,\; \sigma_c^2 I)

and :math:`\tilde c` in the middle of the image, the observations move the principal point where they tell it. Where
they do not, as with a single direction of view, it stays, and what is not known of it is in the covariance of the rest.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from groma._typing import BoolArray, IntArray
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.cameras import model as camera_model
from groma.factors.contract import Factor, Ref
from groma.factors.priors.vector_prior import VectorPrior
from groma.gates import gate
from groma.problem.problem import Problem
from groma.scene import PrincipalPointPriors, Scene


@dataclass(frozen=True)
class PrincipalPointGates:
    """What is known of a lens before its photographs."""

    centred: float = gate(
        0.01, "share", "of the longer side: standard deviation of an unknown principal point from the middle",
        "derived from calibrated cameras: 0.5 to 1.2 %; OpenSfM takes the same",
    )  # fmt: skip


GATES = PrincipalPointGates()


def near_the_middle(scene: Scene) -> Scene:
    """Return a scene whose cameras, none of them calibrated, have their principal points near the middle."""
    cameras = scene.cameras
    has_one = [len(camera_model(name).principal_point_indices) == 2 for name in cameras.models]
    size = np.stack([cameras.width, cameras.height], axis=1).astype(np.float64)
    rows = np.flatnonzero(np.array(has_one, bool) & (size > 0.0).all(axis=1))
    priors = PrincipalPointPriors(rows, 0.5 * size[rows], GATES.centred * size[rows].max(axis=1, initial=0.0))
    return scene.replace(principal_point_priors=priors)


def near_the_middle_if_guessed(scene: Scene, refine_intrinsics: bool | None, refine_it: bool | None) -> Scene:
    """Return the same where a calibration is to be estimated and begins with principal points exactly in the middle.

    Nobody measured these: programs put them there where nothing is known. Others stay, unless that is said.
    """
    if not refine_intrinsics or refine_it is not None or len(scene.principal_point_priors):
        return scene
    table = near_the_middle(scene).principal_point_priors
    rows = [scene.cameras.params_of(row) for row in table.camera_idx.tolist()]
    models = [camera_model(scene.cameras.models[row]) for row in table.camera_idx.tolist()]
    begun = [params[list(kind.principal_point_indices)] for params, kind in zip(rows, models, strict=True)]
    exactly = (np.reshape(begun, (-1, 2)) == table.pixel).all(axis=1)
    return scene.replace(principal_point_priors=table.take(exactly))


def observed_cameras(scene: Scene) -> IntArray:
    """Return the cameras that see points or lines."""
    seen = [table.image_idx for table in (scene.point_observations, scene.line_observations)]
    return np.unique(scene.images.camera_idx[np.concatenate(seen)])


def estimated_by_prior(scene: Scene, options: AssemblyOptions) -> BoolArray:
    """Return of which cameras (C,) the principal point is estimated with what is known of it: of those that see."""
    found = np.zeros(scene.num_cameras, bool)
    if options.refine_intrinsics is not False and options.refine_principal_point is not False:
        found[observed_cameras(scene) if options.seen_cameras is None else np.array(options.seen_cameras, int)] = True
        found &= np.isin(np.arange(len(found)), scene.principal_point_priors.camera_idx)
    return found


def _factors(draft: Draft) -> Iterator[Group]:
    table = draft.scene.principal_point_priors
    estimated = estimated_by_prior(draft.scene, draft.options)[table.camera_idx]
    for name, members in draft.scene.cameras.by_model().items():
        rows = np.flatnonzero(estimated & np.isin(table.camera_idx, members))
        if len(rows):
            yield Group(
                VectorPrior(
                    variable=Ref(f"intrinsics/{name}", np.searchsorted(members, table.camera_idx[rows])),
                    measured=table.pixel[rows],
                    coordinates=camera_model(name).principal_point_indices,
                    sqrt_information=1.0 / table.sigma[rows],
                )
            )


def is_prior(factor: Factor) -> bool:
    """Tell whether a factor says where principal points are expected."""
    return isinstance(factor, VectorPrior) and factor.variable.group.startswith("intrinsics/")


def with_principal_points_known_to(problem: Problem, share: float) -> Problem:
    """Return a problem with the standard deviations of expected principal points multiplied."""
    if share == 1.0 or not any(map(is_prior, problem.factors)):
        return problem
    factors = [
        replace(one, sqrt_information=one.sqrt_information / share) if is_prior(one) else one for one in problem.factors
    ]
    return Problem(problem.variables, factors)


TERM = Term("principal points", ("principal_point_priors",), (), _factors)
