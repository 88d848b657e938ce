# SPDX-License-Identifier: BSD-3-Clause
"""What charts of lines and of planes have in common: sizes, any scale of (m, d) and (n, w), errors, no side effects."""

import numpy as np
import pytest
from _charts import by_name

from groma.errors import InputError, ShapeError
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS

pytestmark = [
    pytest.mark.kernels,
    pytest.mark.parametrize("chart", [*LINE_CHARTS.values(), *PLANE_CHARTS.values()], ids=by_name),
]
#: Degrees of freedom, and numbers that factors read.
SIZES = {"line": (4, 6), "plane": (3, 4)}
SOME = {"line": [[3.5, 1.25, -2.0, 0.5, -1.0, 0.25]], "plane": [[0.5, -1.0, 0.25, 1.5]]}


def test_sizes_and_shapes(chart):
    rng = np.random.default_rng(1)
    dof, size = SIZES[chart.kind]
    assert (chart.dof, chart.ambient_size, chart.factor_columns) == (dof, size, size)
    for count in (0, 1, 5):
        state = chart.random(rng, count)
        assert state.shape == (count, chart.state_size)
        assert chart.ambient(state).shape == (count, size)
        assert chart.basis(state).shape == (count, size, dof)
        assert chart.retract(state, np.zeros((count, dof))).shape == state.shape
        assert chart.local(state, state).shape == (count, dof)
        assert chart.from_ambient(chart.ambient(state)).shape == state.shape


@pytest.mark.parametrize("scale", [1e-300, 1e-160, 1e160, 1e300])
def test_any_scale(chart, scale):
    ambient = np.array(SOME[chart.kind])
    np.testing.assert_allclose(chart.from_ambient(scale * ambient), chart.from_ambient(ambient), rtol=1e-13, atol=1e-15)


def test_errors(chart):
    good = chart.ambient(chart.random(np.random.default_rng(9), 3))
    for bad, message in ((0.0, "all zeros"), (np.nan, "finite numbers"), (np.inf, "finite numbers")):
        ambient = good.copy()
        ambient[1] = bad
        with pytest.raises(InputError, match=f"{message}.*row 1"):
            chart.from_ambient(ambient)
    with pytest.raises(ShapeError, match=r"Did you mean ambient\[None\]"):
        chart.from_ambient(good[0])
    with pytest.raises(ShapeError, match=rf"ambient must have shape \(N, {chart.ambient_size}\)"):
        chart.from_ambient(good[:, :3])
    state = chart.from_ambient(good)
    with pytest.raises(ShapeError, match=rf"delta must have shape \(N, {chart.dof}\)"):
        chart.retract(state, np.zeros((3, chart.dof + 1)))
    with pytest.raises(ShapeError, match="as many rows"):
        chart.retract(state, np.zeros((2, chart.dof)))
    with pytest.raises(ShapeError, match="as many rows"):
        chart.local(state, state[:2])
    with pytest.raises(ShapeError, match="state must have shape"):
        chart.basis(state[:, :2])


def test_arguments_are_not_changed(chart):
    rng = np.random.default_rng(10)
    arguments = chart.random(rng, 4), chart.random(rng, 4), rng.normal(size=(4, chart.dof))
    copies = [array.copy() for array in arguments]
    state, other, delta = arguments
    chart.retract(state, delta), chart.local(state, other), chart.basis(state)
    for now, before in zip(arguments, copies, strict=True):
        np.testing.assert_array_equal(now, before)
