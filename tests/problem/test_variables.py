"""Groups of variables: shapes, constants, finiteness; and the directions in which a scene is free to move."""

import numpy as np
import pytest

from groma.errors import ProblemError, ShapeError
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.charts.unit3 import DIRECTION_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.gauge import gauge_directions
from groma.problem.variables import Variables


def move_world(kind, ambient, translation, rotation, scale):
    r"""Ambient numbers of objects after the world frame moved by :math:`X' = s R X + a`.

    Poses keep their metric form: :math:`R'_{cw} = R_{cw} R^\top`, :math:`t'_{cw} = s\,t_{cw} - R'_{cw} a`.
    """
    R, a, s = rotation, translation, scale
    if kind == "point":
        return s * ambient @ R.T + a
    if kind == "direction":
        return ambient @ R.T
    if kind == "line":
        d = ambient[:, 3:] @ R.T
        return np.hstack([s * ambient[:, :3] @ R.T + np.cross(a, d), d])
    if kind == "plane":
        n = ambient[:, :3] @ R.T
        return np.hstack([n, s * ambient[:, 3:] - (n @ a)[:, None]])
    if kind == "pose":
        T = ambient.reshape(-1, 3, 4)
        R_cw = T[:, :, :3] @ R.T
        t_cw = s * T[:, :, 3] - R_cw @ a
        return np.concatenate([R_cw, t_cw[:, :, None]], axis=2).reshape(-1, 12)
    return ambient


def test_constants_of_every_shape():
    state = np.zeros((3, 2))
    assert Variables(Euclidean(2), state).free_coordinates() is None
    assert not Variables(Euclidean(2), state).is_constant
    assert Variables(Euclidean(2), state, True).is_constant
    free = Variables(Euclidean(2), state, np.array([True, False, False])).free_coordinates()
    np.testing.assert_array_equal(free, [[False, False], [True, True], [True, True]])
    mask = np.array([[True, False], [False, False], [False, True]])
    np.testing.assert_array_equal(Variables(Euclidean(2), state, mask).free_coordinates(), ~mask)


def test_bad_states_are_refused():
    with pytest.raises(ShapeError, match=r"shape \(count, 2\)"):
        Variables(Euclidean(2), np.zeros((3, 3)))
    with pytest.raises(ShapeError, match="constant"):
        Variables(Euclidean(2), np.zeros((3, 2)), np.zeros(4, bool))
    with pytest.raises(ProblemError, match="variable 1 is not finite"):
        Variables(Euclidean(2), np.array([[0, 0], [np.nan, 0]]))


ALL = [Euclidean(3, "point"), *POSE_CHARTS.values(), *DIRECTION_CHARTS.values()]
ALL += [*LINE_CHARTS.values(), *PLANE_CHARTS.values()]


@pytest.mark.parametrize("manifold", ALL, ids=repr)
def test_gauge_directions_move_the_world(manifold):
    """A small world motion and the increment it stands for lead to the same objects."""
    rng = np.random.default_rng(1)
    state = manifold.random(rng, 4)
    directions = gauge_directions(manifold, state)
    h = 1e-4
    a, scale = np.array([h, -2 * h, 0.5 * h]), 1 + 0.7 * h
    combined = h * (directions[0] - 2 * directions[1] + 0.5 * directions[2] + 0.7 * directions[6])
    moved = manifold.ambient(manifold.retract(state, combined))
    expected = move_world(manifold.kind, manifold.ambient(state), a, np.eye(3), scale)
    if manifold.kind in ("line", "plane"):  # up to scale
        moved /= np.linalg.norm(moved, axis=1, keepdims=True)
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        expected *= np.sign(np.sum(moved * expected, axis=1, keepdims=True))
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    assert np.abs(moved - manifold.ambient(state)).max() > 1e-5 or manifold.kind == "direction"
