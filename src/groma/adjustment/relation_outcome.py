# SPDX-License-Identifier: BSD-3-Clause
"""Which relations between landmarks held: those that the adjustment gave up are dropped from the scene."""

from __future__ import annotations

import numpy as np

from groma._typing import BoolArray
from groma.adjustment.stages import STAGES
from groma.adjustment.terms.relations import RELATION_FACTORS
from groma.factors.losses import Trivial
from groma.problem.problem import Problem
from groma.problem.residuals import squared_norms
from groma.scene import Scene


def drop_failed_relations(scene: Scene, problem: Problem) -> tuple[Scene, dict[str, dict[str, int]]]:
    """Return the scene without the relations that a robust loss gave up, and how many of each kind held and failed.

    Parameters
    ----------
    scene : Scene
        The adjusted scene.
    problem : Problem
        The problem at its solution; relations as distances, in the order of the scene.
    """
    relations, outcome = scene.relations, {}
    for factor in problem.factors:
        name = RELATION_FACTORS.get(factor.type_name)
        if name is None or len(factor) != len(getattr(relations, name)):
            continue
        failed: BoolArray = np.zeros(len(factor), dtype=bool)
        if not isinstance(factor.loss, Trivial):
            squared = squared_norms(factor, problem.variables)
            failed = np.asarray(factor.loss.evaluate(squared)[1] < STAGES.given_up)
        outcome[name] = {"held": int((~failed).sum()), "dropped": int(failed.sum())}
        if failed.any():
            relations = relations.take(**{name: ~failed})
    return (scene.replace(relations=relations) if relations is not scene.relations else scene), outcome
