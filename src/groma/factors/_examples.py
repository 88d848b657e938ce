# SPDX-License-Identifier: BSD-3-Clause
"""Small random instances of factors, and the charts that exist for each kind of variable."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.errors import ProblemError
from groma.factors.contract import Example, Factor
from groma.geometry import se3
from groma.geometry.charts import charts_of
from groma.geometry.manifold import Manifold

#: Factors in one example.
COUNT = 6


def charts(kind: str) -> tuple[Manifold, ...]:
    """Return every chart known for ``kind``, the default first; none for kinds of any size."""
    return tuple(charts_of(kind).values())


def indices(rng: np.random.Generator, count: int) -> IntArray:
    """Return an index below ``count`` for each factor of an example."""
    return rng.integers(0, count, COUNT)


def random_poses(rng: np.random.Generator, count: int, rotation: float) -> FloatArray:
    """Return poses (count, 7) whose rotation angles are below ``rotation`` (radians)."""
    omega = rng.normal(size=(count, 3))
    omega *= rotation * rng.uniform(0.1, 1.0, (count, 1)) / np.linalg.norm(omega, axis=1, keepdims=True)
    return se3.exp(np.hstack([rng.normal(size=(count, 3)), omega]))


def make_example(
    factor: Factor,
    rng: np.random.Generator,
    *,
    manifolds: Mapping[str, Manifold] | None = None,
    states: Mapping[str, FloatArray] | None = None,
) -> Example:
    """Fill the groups that ``factor`` refers to with random variables.

    Parameters
    ----------
    factor : Factor
        The factors.
    rng : numpy.random.Generator
        Random generator.
    manifolds : mapping, optional
        Charts by group; the default chart of the kind otherwise.
    states : mapping, optional
        States by group, in that chart; random ones otherwise.

    Raises
    ------
    ProblemError
        If a group is of a kind without a default chart (intrinsics, vectors) and none is given.
    """
    manifolds, states = dict(manifolds or {}), dict(states or {})
    counts: dict[str, int] = {}
    for slot, ref in factor.references():
        counts[ref.group] = max(counts.get(ref.group, 1), int(ref.index.max(initial=-1)) + 1)
        if ref.group not in manifolds:
            known = charts(slot.kind)
            if not known:
                raise ProblemError(
                    f"The example of {type(factor).__name__} needs a chart for its group {ref.group!r}: variables of "
                    f"kind {slot.kind!r} may have any size. Pass manifolds={{{ref.group!r}: Euclidean(size)}}."
                )
            manifolds[ref.group] = known[0]
    variables = {
        group: (manifolds[group], states[group] if group in states else manifolds[group].random(rng, count))
        for group, count in counts.items()
    }
    return Example(factor, variables)


def visible_scene(rng: np.random.Generator) -> dict[str, FloatArray]:
    """Return states of 3 poses, and of 4 points and 4 lines in front of them, for examples (default charts)."""
    poses = random_poses(rng, 3, rotation=0.4)
    poses[:, 6] += 8.0
    first, second = rng.normal(size=(4, 3)), rng.normal(size=(4, 3))
    lines = charts("line")[0].from_ambient(np.hstack([np.cross(first, second), second - first]))
    return {"poses": poses, "points": first, "lines": lines}
