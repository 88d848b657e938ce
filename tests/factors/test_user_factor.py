# SPDX-License-Identifier: BSD-3-Clause
"""Factors of the user's own: the three ways to the derivative, any number of variables, degeneracy, clear errors."""

import math
import os
import subprocess
import sys

import numba
import numpy as np
import pytest

from groma.errors import InputError, ProblemError, ShapeError
from groma.factors import contract as _factor
from groma.factors._examples import charts
from groma.factors.checks.check import ambients_of, check_factor, linearized, residuals_of
from groma.factors.contract import Example, Ref, registered
from groma.factors.relations.point_on_plane import PointOnPlane
from groma.factors.user import UserFactor, factor, transform

pytestmark = pytest.mark.kernels
SLOTS = [("pose", "pose"), ("point", "point")]


@pytest.fixture(autouse=True)
def keep_registry(monkeypatch):
    """Forget what the tests register."""
    monkeypatch.setattr(_factor, "_REGISTRY", dict(_factor._REGISTRY))


def in_front(cls, rng):
    """An example whose points lie in front of its cameras."""
    poses = np.hstack([0.2 * rng.normal(size=(4, 3)), np.ones((4, 1)), 0.3 * rng.normal(size=(4, 3))])
    poses[:, :4] /= np.linalg.norm(poses[:, :4], axis=1, keepdims=True)
    points = rng.normal(size=(4, 3)) + np.array([0.0, 0.0, 6.0])
    index = np.array([0, 1, 2, 3, 0, 2])
    made = cls(pose=Ref("poses", index), point=Ref("points", index[::-1]), data=rng.normal(size=(6, 2)))
    pose_chart = charts("pose")[0]
    return Example(made, {"poses": (pose_chart, poses), "points": (charts("point")[0], points)})


def pinhole(data, pose, point, out):
    x, y, z = transform(pose, point)
    out[0] = x / z - data[0]
    out[1] = y / z - data[1]


def pinhole_jacobian(data, pose, point, J_pose, J_point):
    x, y, z = transform(pose, point)
    for i in range(2):
        u = (x if i == 0 else y) / z
        a0, a1, a2 = (1 / z if i == 0 else 0.0), (1 / z if i == 1 else 0.0), -u / z
        J_pose[i, 0], J_pose[i, 1], J_pose[i, 2] = a0, a1, a2
        J_pose[i, 3], J_pose[i, 4], J_pose[i, 5] = y * a2 - z * a1, z * a0 - x * a2, x * a1 - y * a0
        for j in range(3):
            J_point[i, j] = a0 * pose[0, j] + a1 * pose[1, j] + a2 * pose[2, j]


@pytest.mark.parametrize(
    ("options", "tolerance"),
    [({"derivative": "central"}, 1e-7), ({"derivative": "complex"}, 1e-9), ({"jacobian": pinhole_jacobian}, 1e-9)],
    ids=["central", "complex", "given"],
)
def test_a_pinhole_camera_in_a_few_lines(options, tolerance):
    Pinhole = factor("my_pinhole", slots=SLOTS, residual_size=2, data_size=2, example=in_front, **options)(pinhole)
    assert issubclass(Pinhole, UserFactor)
    assert registered()["my_pinhole"] is Pinhole
    check = check_factor(Pinhole, np.random.default_rng(2), tolerance=tolerance)
    assert set(check.worst) == {"pose", "point"}


def test_a_name_belongs_to_one_factor():
    """Made again, as a cell of a notebook, it takes its own place, but not that of another with its name."""

    def Distance(data, x, out):  # noqa: N802
        out[0] = x[0] - data[0]

    for _ in range(2):
        made = factor("along_x", slots=[("x", "point")], residual_size=1, data_size=1)(Distance)
    assert registered()["along_x"] is made
    with pytest.raises(ProblemError, match=r"'distance' is registered already \(groma\..*Distance\)"):
        factor("distance", slots=[("x", "point")], residual_size=1, data_size=1)(Distance)
    Distance.__qualname__ = "Distance"
    with pytest.raises(ProblemError, match="Choose another name"):
        factor("distance", slots=[("x", "point")], residual_size=1, data_size=1)(Distance)


def test_agrees_with_the_same_factor_written_by_hand():
    @factor("my_point_on_plane", slots=[("point", "point"), ("plane", "plane")], residual_size=1, derivative="complex")
    def mine(data, point, plane, out):
        n2 = plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2
        out[0] = (plane[0] * point[0] + plane[1] * point[1] + plane[2] * point[2] + plane[3]) / n2**0.5

    example = PointOnPlane.example(np.random.default_rng(3))
    theirs, _ = linearized(example.factor, ambients_of(example), [3, 4])
    made = mine(point=example.factor.point, plane=example.factor.plane)
    ours, degenerate = linearized(made, ambients_of(example), [3, 4])
    assert degenerate == 0
    np.testing.assert_allclose(ours, theirs, rtol=1e-12, atol=1e-14)
    _, degenerate = linearized(made, (ambients_of(example)[0], np.zeros((3, 4))), [3, 4])
    assert degenerate == 6


def test_one_variable_of_free_size_and_three_variables():
    @factor("my_circle", slots=[("circle", "vector", 3)], residual_size=1, data_size=2)
    def circle_factor(data, circle, out):
        out[0] = math.hypot(data[0] - circle[0], data[1] - circle[1]) - circle[2]

    check_factor(circle_factor)

    @factor("my_chain", slots=[("a", "point"), ("b", "point"), ("line", "line")], residual_size=3)
    def chain(data, a, b, line, out):
        for i in range(3):
            out[i] = math.sin(a[i]) * b[(i + 1) % 3] * line[3 + i] - b[i] * line[i]

    example = chain.example(np.random.default_rng(0))
    record, _ = linearized(example.factor, ambients_of(example), [3, 3, 6])
    a, b, line = (
        ambient[ref.index] for ambient, (_, ref) in zip(ambients_of(example), example.factor.references(), strict=True)
    )
    np.testing.assert_allclose(record[:, 0, 0], np.cos(a[:, 0]) * b[:, 1] * line[:, 3], rtol=1e-8)
    np.testing.assert_allclose(record[:, 2, 6 + 2], -b[:, 2], rtol=1e-8)


def test_nan_and_forgotten_rows_are_degenerate():
    @factor("my_root", slots=[("x", "vector", 1)], residual_size=2, data_size=1)
    def root(data, x, out):
        out[0] = math.sqrt(x[0] - data[0]) if x[0] >= data[0] else math.nan
        if x[0] < 10.0:
            out[1] = x[0]

    x = np.array([[1.0], [-1.0], [11.0], [4.0]])
    made = root(x=Ref("x", np.arange(4)), data=np.zeros((4, 1)))
    record, degenerate = linearized(made, (x,), [1])
    assert degenerate == 2
    assert not record[1:3].any()
    np.testing.assert_allclose(record[[0, 3], 0, 1], [1.0, 2.0])
    out = np.empty((4, 2))
    assert made.residuals(made.prepare((x,)), 0, 4, out) == 2
    np.testing.assert_array_equal(out, record[:, :, 1])


def test_a_complex_step_that_divides_by_zero_is_degenerate():
    @factor("my_quotient", slots=[("x", "vector", 2)], residual_size=1, derivative="complex")
    def quotient(data, x, out):
        out[0] = x[0] + 1.0 / (1.0 + 1.0 / x[1])  # finite at 0

    x = np.array([[1.0, 0.0], [1.0, 1.0]])
    record, degenerate = linearized(quotient(x=Ref("x", [0, 1])), (x,), [2])
    assert degenerate == 1
    np.testing.assert_allclose(record[:, 0], [[0.0, 0.0, 0.0], [1.0, 0.25, 1.5]], rtol=1e-12)


def test_writing_to_the_arguments_changes_nothing():
    @factor("my_vandal", slots=[("x", "point")], residual_size=1)
    def vandal(data, x, out):
        out[0] = x[0] + 2 * x[1]
        x[0] = 1e6

    x = np.ones((2, 3))
    record, _ = linearized(vandal(x=Ref("x", [0, 1])), (x,), [3])
    np.testing.assert_allclose(record[:, 0], np.tile([1.0, 2.0, 0.0, 3.0], (2, 1)), rtol=1e-9)
    np.testing.assert_array_equal(x, 1.0)


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="nothing is compiled")
def test_functions_that_numba_cannot_compile_are_refused_with_a_reason():
    @factor("my_text", slots=[("x", "point")], residual_size=1)
    def text(data, x, out):
        out[0] = float(f"{x[0]:.3f}")

    with pytest.raises(InputError, match=r"residual function of factor 'my_text' must be of the kind that Numba"):
        residuals_of(text(x=Ref("x", [0])), (np.ones((1, 3)),))

    @factor("my_comparison", slots=[("x", "point")], residual_size=1, derivative="complex")
    def comparison(data, x, out):
        out[0] = math.hypot(x[0], x[1])

    with pytest.raises(InputError, match=r"use derivative='central' if it cannot"):
        residuals_of(comparison(x=Ref("x", [0])), (np.ones((1, 3)),))


def test_declarations_are_checked():
    def one(data, x, out): ...

    with pytest.raises(InputError, match=r"must take \(data, x, y, out\)"):
        factor("bad", slots=[("x", "point"), ("y", "point")], residual_size=1)(one)
    with pytest.raises(InputError, match=r"must take \(data, x, J_x\)"):
        factor("bad", slots=[("x", "point")], residual_size=1, jacobian=lambda data, x: None)
    with pytest.raises(InputError, match="'vector' needs a size"):
        factor("bad", slots=[("x", "vector")], residual_size=1)
    with pytest.raises(InputError, match="'point' has a fixed size"):
        factor("bad", slots=[("x", "point", 3)], residual_size=1)
    with pytest.raises(InputError, match="Kinds: pose, point, line, plane, direction"):
        factor("bad", slots=[("x", "circle")], residual_size=1)
    for word in ("data", "loss", "class", "take", "a b"):
        with pytest.raises(InputError, match="cannot be the name of a slot"):
            factor("bad", slots=[(word, "point")], residual_size=1)
    with pytest.raises(InputError, match="a name of its own"):
        factor("bad", slots=[("x", "point"), ("x", "line")], residual_size=1)
    with pytest.raises(InputError, match="'central' or 'complex'"):
        factor("bad", slots=[("x", "point")], residual_size=1, derivative="auto")
    with pytest.raises(InputError, match="residual_size >= 1"):
        factor("bad", slots=[("x", "point")], residual_size=0)
    assert "bad" not in registered()
    One = factor("good", slots=[("x", "vector", 2)], residual_size=1, data_size=3)(one)
    with pytest.raises(ShapeError, match=r"one.data must have shape \(2, 3\)"):
        One(x=Ref("x", [0, 1]), data=np.zeros((2, 2)))
    with pytest.raises(ShapeError, match="takes variables of 2 numbers; got 3"):
        One(x=Ref("x", [0]), data=np.zeros((1, 3))).prepare((np.zeros((1, 3)),))


PROGRAM = """
import numpy as np
from groma._kernels.cache import counts
from groma.factors.checks.check import ambients_of, block_sizes_of, linearized, residuals_of
from groma.factors.user import factor

SCALE = 2.0

@factor("first", slots=[("point", "point")], residual_size=1, data_size=1)
def First(data, point, out):
    out[0] = SCALE * (point[0] - data[0])

@factor("second", slots=[("point", "point")], residual_size=1, data_size=1)
def Second(data, point, out):
    out[0] = point[1] - data[0]

before = counts.compiled
for kind in (First, Second):
    example = kind.example(np.random.default_rng(0))
    ambients = ambients_of(example)
    sizes = block_sizes_of(example)
    print(residuals_of(example.factor, ambients)[0, 0].hex(), linearized(example.factor, ambients, sizes)[1])
print(counts.compiled - before)
"""


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_what_is_compiled_is_kept_until_the_function_changes(tmp_path):
    path = tmp_path / "program.py"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}

    def results(program):
        path.write_text(program)
        call = [sys.executable, "-W", "error", path]
        said = subprocess.run(call, capture_output=True, text=True, check=True, env=environment).stdout.split()
        return said[:-1], int(said[-1])

    first, compiled = results(PROGRAM)
    assert compiled > 0
    assert results(PROGRAM) == (first, 0)
    changed, compiled = results(PROGRAM.replace("SCALE = 2.0", "SCALE = 4.0"))
    assert compiled > 0
    assert float.fromhex(changed[0]) == 2.0 * float.fromhex(first[0])
    assert changed[2:] == first[2:]
