# SPDX-License-Identifier: BSD-3-Clause
"""The prior of the motions of cameras with a rolling shutter during readout.

That images were read row by row is known to the terms of points, lines and marks, which ask
:mod:`groma.adjustment.terms.readout` for the motion that each of their observations depends on.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from groma._typing import BoolArray
from groma.adjustment.terms.contract import Draft, Group, Term
from groma.adjustment.terms.readout import MOTIONS
from groma.factors.contract import Ref
from groma.factors.priors.vector_prior import VectorPrior
from groma.geometry.manifold import Euclidean
from groma.problem.variables import Variables
from groma.scene import Scene


def motion_variables(scene: Scene, refine: bool) -> Variables:
    """Return the motions of a scene, and behind them that of images that were taken at once."""
    state = np.vstack([scene.camera_motions.motion, np.zeros(6)])
    held: BoolArray = np.full(len(state), not refine)
    held[-1] = True
    return Variables(Euclidean(6), state, held)


def _factors(draft: Draft) -> Iterator[Group]:
    table = draft.scene.camera_motions
    yield Group(
        VectorPrior(
            variable=Ref(MOTIONS, np.arange(len(table))),
            measured=table.expected,
            sqrt_information=(1.0 / table.sigma)[:, :, None] * np.eye(6),
        )
    )


TERM = Term("camera motions", ("camera_motions",), (MOTIONS,), _factors)
__all__ = ["MOTIONS", "TERM", "motion_variables"]
