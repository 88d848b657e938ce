# SPDX-License-Identifier: BSD-3-Clause
"""Residuals and Jacobians outside of a solve: against differences in several charts, on a rig, without noise."""

import dataclasses

import numpy as np
import pytest

from groma.factors import registered
from groma.factors.contract import Ref
from groma.factors.relations.point_on_plane import PointOnPlane
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.plane_charts import PLANE_CHARTS
from groma.geometry.charts.pose_charts import POSE_CHARTS
from groma.geometry.manifold import Euclidean
from groma.problem.residuals import jacobians_of, residuals_of, squared_norms
from groma.problem.variables import Variables

pytestmark = pytest.mark.kernels
#: Charts beside those of the examples: with and without a basis.
OTHERS = {
    "pose": POSE_CHARTS["right"],
    "line": LINE_CHARTS["orthonormal_right"],
    "plane": PLANE_CHARTS["normal_offset"],
}
STEP = 1e-6


def example(name, charts, rig):
    """An example factor whose slots have a group of variables each, in the given charts."""
    made = registered()[name].example(np.random.default_rng(5))
    factor, states = made.factor, dict(made.variables)
    if rig:
        chart, rows = POSE_CHARTS["left"], len(factor)
        states["extrinsics"] = (chart, chart.retract(chart.from_ambient(np.eye(3, 4).reshape(1, 12)),
                                                     np.full((1, 6), 0.05)))  # fmt: skip
        factor = dataclasses.replace(factor, extrinsics=Ref("extrinsics", np.zeros(rows, int)))
    variables, refs = {}, {}
    for slot, ref in factor.references():
        manifold, state = states[ref.group]
        chart = charts.get(manifold.kind, manifold)
        variables[slot.name] = Variables(chart, chart.from_ambient(manifold.ambient(state)))
        refs[slot.name] = Ref(slot.name, ref.index)
    return dataclasses.replace(factor, **refs), variables


@pytest.mark.parametrize("charts", [{}, OTHERS], ids=["charts of the example", "other charts"])
@pytest.mark.parametrize(
    ("name", "rig"),
    [
        ("point_reprojection", False),
        ("point_reprojection", True),
        ("line_reprojection", False),
        ("plane_observation", False),
        ("point_on_line", False),
        ("pose_between", False),
    ],
)
def test_jacobians_are_the_differences_of_the_residuals(name, rig, charts):
    factor, variables = example(name, charts, rig)
    blocks = jacobians_of(factor, variables)
    assert list(blocks) == [slot.name for slot, _ in factor.references()] == list(variables)
    for slot, group in variables.items():
        manifold = group.manifold
        assert blocks[slot].shape == (len(factor), factor.residual_size, manifold.dof)
        for k in range(manifold.dof):
            delta = np.zeros((len(group), manifold.dof))
            delta[:, k] = STEP
            sides = [
                residuals_of(factor, variables | {slot: Variables(manifold, moved)})
                for moved in (manifold.retract(group.state, sign * delta) for sign in (1, -1))
            ]
            difference = (sides[0] - sides[1]) / (2 * STEP)
            largest = max(np.abs(blocks[slot]).max(), 1.0)
            np.testing.assert_allclose(blocks[slot][:, :, k], difference, rtol=0, atol=1e-6 * largest)


def on_plane(points, sqrt_information=1.0):
    """Points near one plane, z = 0, that is held constant."""
    chart = PLANE_CHARTS["normal_offset"]
    variables = {
        "points": Variables(Euclidean(3, "point"), np.asarray(points, float).reshape(-1, 3)),
        "planes": Variables(chart, chart.from_ambient(np.array([[0.0, 0.0, 1.0, 0.0]])), True),
    }
    index = np.arange(len(variables["points"]))
    factor = PointOnPlane(point=Ref("points", index), plane=Ref("planes", 0 * index), sqrt_information=sqrt_information)
    return factor, variables


def test_neither_noise_nor_constants_change_jacobians():
    factor, variables = on_plane([[1, 2, 3], [4, 5, 6]], sqrt_information=10.0)
    np.testing.assert_allclose(residuals_of(factor, variables).ravel(), [3, 6])
    np.testing.assert_allclose(squared_norms(factor, variables), [900, 3600])
    blocks = jacobians_of(factor, variables)
    np.testing.assert_allclose(blocks["point"], [[[0, 0, 1]], [[0, 0, 1]]])
    assert np.abs(blocks["plane"]).max() > 1.0


def test_no_factors_give_empty_blocks():
    factor, variables = on_plane([])
    assert residuals_of(factor, variables).shape == (0, 1)
    shapes = {name: block.shape for name, block in jacobians_of(factor, variables).items()}
    assert shapes == {"point": (0, 1, 3), "plane": (0, 1, 3)}
