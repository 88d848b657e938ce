# SPDX-License-Identifier: BSD-3-Clause
"""Factors of what other instruments measured of objects of many kinds: derivatives, and values by plain geometry."""

from dataclasses import replace

import numpy as np
import pytest

from groma.factors import Distance, KnownDirection, OnKnownPlane, Ref
from groma.factors.checks.check import compare_jacobians
from groma.factors.priors.known_direction import CameraDirection
from groma.geometry import incidence, quaternion, se3
from groma.geometry.charts import charts_of
from groma.problem.residuals import residuals_of
from groma.problem.variables import Variables

pytestmark = pytest.mark.kernels

KINDS = ("camera", "point", "line", "plane")
PAIRS = [(first, second) for k, first in enumerate(KINDS) for second in KINDS[k:]]
#: The floor z = 0 and the wall x = 4, of any scale.
FLOOR, WALL = np.array([[0.0, 0.0, 2.0, 0.0]]), np.array([[-3.0, 0.0, 0.0, 12.0]])


@pytest.mark.parametrize(("first", "second"), PAIRS)
@pytest.mark.parametrize("seed", [0, 1])
def test_derivatives_of_distances(first, second, seed):
    for block in compare_jacobians(Distance.between(np.random.default_rng(seed), first, second)):
        assert block.passed, block


@pytest.mark.parametrize("seed", range(4))
def test_distances_of_skew_lines(seed):
    """Derivatives against central differences, values against the geometry of two lines."""
    example = Distance.between(np.random.default_rng(seed), "line", "line")
    factor = replace(example.factor, is_shortest=np.ones(6, bool))
    for block in compare_jacobians(replace(example, factor=factor)):
        assert block.passed, block
    variables = {name: Variables(*given) for name, given in example.variables.items()}
    first = variables["first"].ambient()[factor.first_line.index]
    second = variables["second"].ambient()[factor.second_line.index]
    apart = residuals_of(factor, variables)[:, 0] + factor.distances
    np.testing.assert_allclose(apart, incidence.distance(first, second), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_on_known_planes(kind):
    for block in compare_jacobians(OnKnownPlane.of(np.random.default_rng(3), kind)):
        assert block.passed, block


@pytest.mark.parametrize("kind", ["line", "plane", "direction"])
def test_derivatives_of_known_directions(kind):
    for block in compare_jacobians(KnownDirection.of(np.random.default_rng(3), kind)):
        assert block.passed, block


def objects():
    """A camera at (1, 2, 3), looking anywhere; a point; the line; the wall."""
    turn = quaternion.exp(np.array([[0.4, -0.3, 1.0]]))
    pose = np.hstack([turn, -quaternion.rotate(turn, np.array([[1.0, 2.0, 3.0]]))])
    d = np.array([[0.0, -2.0, 0.0]])
    line = np.hstack([np.cross([[1.0, 7.0, 0.5]], d), d])
    ambient = {"camera": pose, "point": np.array([[1.0, -1.0, -0.5]]), "line": line, "plane": WALL, "other": FLOOR}
    found = {}
    for name, value in ambient.items():
        kind = {"camera": "pose", "other": "plane"}.get(name, name)
        chart = next(iter(charts_of(kind).values()))
        found[name] = Variables(chart, value if kind in ("pose", "point") else chart.from_ambient(value))
    return found


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ("camera", "point", np.sqrt(9.0 + 3.5**2)),
        ("camera", "line", 2.5),
        ("camera", "plane", 3.0),
        ("point", "line", 1.0),
        ("point", "plane", 3.0),
        ("line", "plane", 3.0),
    ],
)
def test_distances_are_those_of_geometry(first, second, expected):
    arm = np.zeros((1, 3)) if first == "camera" else np.array([[8.0, 5.0, 5.0]])
    factor = Distance(
        **{f"first_{first}": Ref(first, [0]), f"second_{second}": Ref(second, [0])},
        distances=[0.25], first_arm=arm, second_arm=np.zeros((1, 3)),
    )  # fmt: skip
    assert residuals_of(factor, objects())[0, 0] == pytest.approx(expected - 0.25, abs=1e-12)


@pytest.mark.parametrize(("kind", "expected"), [("camera", 3.0), ("point", -0.5), ("line", 0.5)])
def test_heights_are_signed(kind, expected):
    factor = OnKnownPlane(**{kind: Ref(kind, [0])}, known=FLOOR, arm=np.zeros((1, 3)))
    assert residuals_of(factor, objects())[0, 0] == pytest.approx(expected, abs=1e-12)


def test_where_objects_touch_there_is_no_direction():
    variables = {"points": Variables(next(iter(charts_of("point").values())), np.ones((2, 3)))}
    factor = Distance(
        first_point=Ref("points", [0]), second_point=Ref("points", [1]),
        distances=[1.0], first_arm=np.zeros((1, 3)), second_arm=np.zeros((1, 3)),
    )  # fmt: skip
    assert residuals_of(factor, variables).tolist() == [[0.0]]


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 3.0, 90.0, 179.0])
def test_the_residual_of_gravity_is_the_angle(degrees):
    """Also where a phone is held upside down, so that a wrong sign is seen as what it is."""
    angle = np.radians(degrees)
    down = np.array([[0.0, 0.0, -1.0]])
    tilted = np.array([[np.sin(angle), 0.0, -np.cos(angle)]])
    poses = {"poses": Variables(next(iter(charts_of("pose").values())), se3.exp(np.zeros((1, 6))))}
    factor = CameraDirection(pose=Ref("poses", [0]), in_world=down, in_camera=5 * tilted)
    assert np.linalg.norm(residuals_of(factor, poses)) == pytest.approx(angle, abs=1e-12)


def test_a_direction_has_no_sign_in_a_landmark():
    for sign in (1.0, -1.0):
        factor = KnownDirection(line=Ref("line", [0]), known=np.array([[0.0, sign * np.cos(0.1), np.sin(0.1)]]))
        assert np.linalg.norm(residuals_of(factor, objects())) == pytest.approx(0.1, abs=1e-12)
