# SPDX-License-Identifier: BSD-3-Clause
r"""Conformance checks: does a chart, camera model, factor, loss, detector, matcher or format keep its contract?

The tests of groma run these over everything that is registered; they are public for those that live elsewhere.
Each raises an ``AssertionError`` that shows what was expected and what came.

>>> import numpy as np
>>> from groma.geometry.charts.pose_charts import PoseLeft
>>> check_manifold(PoseLeft(), rng=np.random.default_rng(0))
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

import numpy as np

from groma._typing import FloatArray
from groma.errors import InputError
from groma.geometry import se3, sim3
from groma.geometry.manifold import AMBIENT_SIZE, FACTOR_COLUMNS, Manifold

if TYPE_CHECKING:
    from groma.cameras.check import check_camera
    from groma.factors.checks.check import check_factor
    from groma.factors.checks.loss import check_loss
    from groma.features.check import check_detector, check_matcher, check_retrieval
    from groma.io.check import check_format

#: Step of the differences through ``retract``: their truncation error is of order 1e-12, their rounding 1e-13.
_STEP = 1e-3
#: Size of the increments in the round trips, from rounding noise to a tenth of a radian.
_MAGNITUDES = (1e-12, 1e-6, 1e-1)
_HOME = {
    "check_camera": "groma.cameras.check",
    "check_detector": "groma.features.check",
    "check_factor": "groma.factors.checks.check",
    "check_format": "groma.io.check",
    "check_loss": "groma.factors.checks.loss",
    "check_matcher": "groma.features.check",
    "check_retrieval": "groma.features.check",
}


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module 'groma.testing' has no attribute {name!r}. Public names: {', '.join(__all__)}.")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return list(__all__)


def check_manifold(
    manifold: Manifold, *, rng: np.random.Generator | None = None, count: int = 20, tolerance: float = 1e-9
) -> None:
    r"""Check that a chart keeps the contract of :class:`groma.geometry.manifold.Manifold`.

    With the retraction :math:`\boxplus` and its inverse :math:`\boxminus`, on random states x and y:

    * :math:`x \boxplus 0 = x`, :math:`(x \boxplus \delta) \boxminus x = \delta` and
      :math:`x \boxplus (y \boxminus x) = y`;
    * ``from_ambient(ambient(x))`` is the same object as x;
    * ``basis`` equals the differences of the factor coordinates through ``retract``, and has full rank;
    * states near singular places (a plane through the origin, a rotation by pi, ...) give finite numbers;
    * sizes and shapes fit, no argument is changed, each row depends on its own row only, a batch may be empty.

    Two states are the same if their ambient numbers are: for lines and planes up to a factor, also a negative one, for
    all others exactly.

    Parameters
    ----------
    manifold : Manifold
        The chart.
    rng : numpy.random.Generator, optional
        Source of the random states; seed 0 if left out.
    count : int
        Number of random states.
    tolerance : float
        Allowed deviation, absolute for objects of a size near 1; of a basis, relative to its largest entry.

    Raises
    ------
    AssertionError
        If one of these does not hold; the message shows both sides.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    _check_sizes(manifold, rng, count)
    state, other = manifold.random(rng, count), manifold.random(rng, count)
    _check_round_trips(manifold, state, other, rng, tolerance)
    _check_basis(manifold, state, tolerance)
    _check_rows(manifold, state, rng)
    _check_awkward(manifold, rng, tolerance)


def _fail(manifold: Manifold, what: str, expected: FloatArray, got: FloatArray) -> None:
    with np.printoptions(precision=6, linewidth=160, suppress=False):
        raise AssertionError(f"{manifold!r}: {what}.\nexpected\n{expected}\ngot\n{got}")


def _near(manifold: Manifold, what: str, expected: FloatArray, got: FloatArray, tolerance: float) -> None:
    """Compare arrays row by row and show the worst row."""
    if expected.shape != got.shape:
        raise AssertionError(f"{manifold!r}: {what}: expected the shape {expected.shape}, got {got.shape}.")
    if expected.size == 0:
        return
    deviation = np.abs(got - expected).reshape(len(expected), -1).max(axis=1)
    bad = ~(deviation <= tolerance)  # NaN is bad
    if bad.any():
        worst = int(np.argmax(np.where(np.isnan(deviation), np.inf, deviation)))
        _fail(manifold, f"{what}, row {worst}, off by {deviation[worst]:.3g}", expected[worst], got[worst])


def _same(manifold: Manifold, what: str, expected: FloatArray, got: FloatArray, tolerance: float) -> None:
    """Compare ambient numbers as objects."""
    if manifold.kind in ("line", "plane"):
        expected = expected / np.linalg.norm(expected, axis=1, keepdims=True)
        got = got / np.linalg.norm(got, axis=1, keepdims=True)
        got = np.where(np.sum(expected * got, axis=1, keepdims=True) < 0, -got, got)
    _near(manifold, what, expected, got, tolerance)


def _unchanged(manifold: Manifold, method: Callable[..., FloatArray | None], *arguments: FloatArray) -> FloatArray:
    """Call a method and insist that its arguments stay as they are."""
    copies = [argument.copy() for argument in arguments]
    result = method(*arguments)
    for before, after in zip(copies, arguments, strict=True):
        if not np.array_equal(before, after):
            _fail(manifold, f"{getattr(method, '__name__', method)} changed an argument", before, after)
    return np.empty(0) if result is None else result


def _basis(manifold: Manifold, state: FloatArray) -> FloatArray:
    if manifold.basis(state) is None:
        return np.broadcast_to(np.eye(manifold.factor_columns, manifold.dof), (len(state), manifold.dof, manifold.dof))
    return _unchanged(manifold, manifold.basis, state)


def _check_sizes(manifold: Manifold, rng: np.random.Generator, count: int) -> None:
    for sizes, size in ((AMBIENT_SIZE, manifold.ambient_size), (FACTOR_COLUMNS, manifold.factor_columns)):
        if sizes.get(manifold.kind, size) != size:
            raise AssertionError(
                f"{manifold!r}: kind {manifold.kind!r} needs {sizes[manifold.kind]} numbers, not {size}."
            )
    for rows in (count, 0):
        state = manifold.random(rng, rows)
        results = {
            "random": (state, (rows, manifold.state_size)),
            "ambient": (manifold.ambient(state), (rows, manifold.ambient_size)),
            "from_ambient": (manifold.from_ambient(manifold.ambient(state)), (rows, manifold.state_size)),
            "retract": (manifold.retract(state, np.zeros((rows, manifold.dof))), (rows, manifold.state_size)),
            "local": (manifold.local(state, state), (rows, manifold.dof)),
            "basis": (_basis(manifold, state), (rows, manifold.factor_columns, manifold.dof)),
        }
        for name, (result, shape) in results.items():
            if result.shape != shape or result.dtype != np.float64:
                raise AssertionError(
                    f"{manifold!r}: {name} must return float64 of shape {shape}; got {result.dtype} of {result.shape}."
                )


def _check_round_trips(
    manifold: Manifold, state: FloatArray, other: FloatArray, rng: np.random.Generator, tolerance: float
) -> None:
    ambient = _unchanged(manifold, manifold.ambient, state)
    still = _unchanged(manifold, manifold.retract, state, np.zeros((len(state), manifold.dof)))
    _near(manifold, "retract(x, 0) is not x", state, still, 1e-12)
    back = _unchanged(manifold, manifold.from_ambient, ambient)
    _same(manifold, "from_ambient(ambient(x)) is another object", ambient, manifold.ambient(back), tolerance)
    for magnitude in _MAGNITUDES:
        delta = magnitude * rng.uniform(-1, 1, (len(state), manifold.dof))
        moved = _unchanged(manifold, manifold.retract, state, delta)
        found = _unchanged(manifold, manifold.local, state, moved)
        allowed = min(tolerance, 1e-13 + 1e-3 * magnitude)  # tiny increments must not drown in rounding
        _near(manifold, "local(x, retract(x, delta)) is not delta", delta, found, allowed)
    reached = manifold.retract(state, _unchanged(manifold, manifold.local, state, other))
    _same(manifold, "retract(x, local(x, y)) is not y", manifold.ambient(other), manifold.ambient(reached), tolerance)


def _factor_coordinates(manifold: Manifold, state: FloatArray, moved: FloatArray) -> FloatArray:
    """What factors differentiate by: left tangents of poses and similarities, else ambient numbers up to a constant."""
    ambient = manifold.ambient(moved)
    if manifold.kind == "similarity":
        return sim3.log(sim3.compose(ambient, sim3.inverse(manifold.ambient(state))))
    if manifold.kind != "pose":
        return ambient
    here, there = (se3.from_matrix(a.reshape(-1, 3, 4)) for a in (manifold.ambient(state), ambient))
    return se3.log(se3.compose(there, se3.inverse(here)))


def _check_basis(manifold: Manifold, state: FloatArray, tolerance: float) -> None:
    analytic = _basis(manifold, state)
    numeric = np.zeros_like(analytic)
    for k in range(manifold.dof):
        values = {}
        for steps in (-2, -1, 1, 2):
            delta = np.zeros((len(state), manifold.dof))
            delta[:, k] = steps * _STEP
            values[steps] = _factor_coordinates(manifold, state, manifold.retract(state, delta))
        numeric[:, :, k] = (8 * (values[1] - values[-1]) - (values[2] - values[-2])) / (12 * _STEP)
    scale = max(1.0, float(np.abs(numeric).max(initial=0.0)))
    _near(manifold, "basis differs from differences", numeric, analytic, tolerance * scale)
    weakest = np.linalg.svd(analytic, compute_uv=False).min(axis=-1, initial=np.inf)
    if (weakest < 1e-6).any():
        row = int(np.argmin(weakest))
        raise AssertionError(f"{manifold!r}: basis is rank deficient at {state[row]}:\n{analytic[row]}")


def _check_rows(manifold: Manifold, state: FloatArray, rng: np.random.Generator) -> None:
    """One row at a time gives what the batch gives."""
    delta = 0.1 * rng.uniform(-1, 1, (len(state), manifold.dof))
    moved = manifold.retract(state, delta)
    for row in range(min(3, len(state))):
        one = slice(row, row + 1)
        _near(manifold, "retract of one row", moved[one], manifold.retract(state[one], delta[one]), 1e-12)
        local = manifold.local(state, moved)[one]
        _near(manifold, "local of one row", local, manifold.local(state[one], moved[one]), 1e-12)
        _near(manifold, "basis of one row", _basis(manifold, state)[one], _basis(manifold, state[one]), 1e-12)


def _awkward_ambients(kind: str, rng: np.random.Generator) -> FloatArray:
    """Objects at and near the places where charts of this kind may be singular."""
    axes = np.vstack([np.eye(3), -np.eye(3), np.ones((1, 3)) / np.sqrt(3), [[0.6, 0.8, 0.0]], [[0.6, 0.8, 1e-17]]])
    tiny = (0.0, 1e-300, 1e-160, 1e-12, 1e-6)
    if kind == "direction":
        return np.vstack([axes, [[1.0, 0.0, -1e-17], [1e-9, 1e-9, -1.0], [1e-200, 0.0, 1.0]]])
    if kind == "plane":  # through the origin, nearly so, far away
        return np.vstack([np.column_stack([axes, np.full(len(axes), w)]) for w in (*tiny, -1e-12, 1e6)])
    if kind == "line":  # through the origin, nearly so, far away
        side = np.cross(axes, rng.normal(size=axes.shape))
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        return np.vstack([np.hstack([distance * side, axes]) for distance in (*tiny, 1e6)])
    if kind == "pose":  # no rotation, and rotations by pi and nearly pi
        angles = (0.0, 1e-300, 1e-12, 1e-6, np.pi - 1e-6, np.pi - 1e-12, np.pi)
        omega = np.vstack([angle * axes[:7] for angle in angles])
        poses = se3.exp(np.hstack([rng.normal(size=omega.shape), omega]))
        return se3.to_matrix(poses)[:, :3].reshape(-1, 12)
    return np.empty((0, 0))


def _check_awkward(manifold: Manifold, rng: np.random.Generator, tolerance: float) -> None:
    for ambient in _awkward_ambients(manifold.kind, rng):
        try:
            state = manifold.from_ambient(ambient[None])
        except InputError:
            continue  # a chart may refuse what it cannot hold, but by this error only
        delta = 1e-3 * rng.uniform(-1, 1, (1, manifold.dof))
        moved = manifold.retract(state, delta)
        _same(manifold, f"ambient(from_ambient({ambient}))", ambient[None], manifold.ambient(state), tolerance)
        results = (state, moved, manifold.ambient(moved), manifold.local(state, moved), _basis(manifold, state))
        for result in results:
            if not np.isfinite(result).all():
                _fail(manifold, f"numbers at {ambient} are not finite", np.zeros(()), result)


__all__ = [
    "check_camera",
    "check_detector",
    "check_factor",
    "check_format",
    "check_loss",
    "check_manifold",
    "check_matcher",
    "check_retrieval",
]
