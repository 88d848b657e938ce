# SPDX-License-Identifier: BSD-3-Clause
"""Covers how compiled loops find the kernels of a camera model: by tag, from the disk cache, for outside models too."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from groma import cameras
from groma._numba import kernel, loop
from groma.cameras import dispatch as _dispatch
from groma.cameras import registry as _camera
from groma.cameras.check import check_camera
from groma.errors import InputError

pytestmark = pytest.mark.kernels


@loop
def residual_squares(model_tag, params, points, jacobian, sums):
    """What a factor's loop looks like: one source, any model."""
    pixel, by_point = np.empty(2), np.empty((2, 3))
    for i in range(points.shape[0]):
        _dispatch.project_jacobian(model_tag, params, points[i], pixel, by_point, jacobian)
        sums[i] = pixel[0] ** 2 + pixel[1] ** 2


@loop
def line_intrinsics(model_tag, params, K, J):
    _dispatch.pinhole_parameters(model_tag, params, K)
    _dispatch.pinhole_parameters_jacobian(model_tag, params, J)


@pytest.mark.parametrize(("name", "params"), [("PINHOLE", [5.0, 6.0, 1.0, 2.0]), ("BAL", [5.0, 0.1, 0.01])])
def test_one_loop_serves_every_model(name, params):
    model, params = cameras.model(name), np.array(params)
    points = np.array([[0.1, 0.2, 1.0], [0.3, -0.2, 2.0]])
    sums = np.empty(2)
    residual_squares(model.tag, params, points, np.empty((2, model.num_parameters)), sums)
    np.testing.assert_allclose(sums, (model.project(params, points) ** 2).sum(axis=1), rtol=1e-14)


@pytest.mark.parametrize(("name", "params"), [("PINHOLE", [5.0, 6.0, 1.0, 2.0]), ("SIMPLE_PINHOLE", [5.0, 1.0, 2.0])])
def test_pinhole_parameters_in_a_loop(name, params):
    """K is linear in the parameters without constant, so K = J params; and a unit step in a parameter is a column."""
    model, params = cameras.model(name), np.array(params)
    K, J, moved = np.empty(4), np.full((4, model.num_parameters), 9.0), np.empty(4)
    line_intrinsics(model.tag, params, K, J)
    np.testing.assert_array_equal(K, model.pinhole_parameters(params)[0])
    np.testing.assert_array_equal(K, J @ params)
    for j in range(len(params)):
        line_intrinsics(model.tag, params + np.eye(len(params))[j], moved, np.empty_like(J))
        np.testing.assert_array_equal(moved - K, J[:, j])


CACHED = """
import numpy as np
from groma import cameras
from groma._numba import loop
from groma.cameras.contract import project

@loop
def pixels(model_tag, params, points, out):
    for i in range(points.shape[0]):
        project(model_tag, params, points[i], out[i])

points, out = np.array([[1.0, 2.0, 4.0]]), np.empty((1, 2))
for name, params in (("SIMPLE_PINHOLE", [8.0, 1.0, 2.0]), ("BAL", [8.0, 1.0, 0.0])):
    pixels(cameras.model(name).tag, np.array(params), points, out)
    print(*out[0])
print(sum(pixels.stats.cache_hits.values()), sum(pixels.stats.cache_misses.values()))
"""


@pytest.mark.compiled
def test_a_loop_over_two_models_is_cached_on_disk(tmp_path):
    """The second process compiles nothing and gives the same numbers."""
    script = tmp_path / "cached_loop.py"
    script.write_text(CACHED)
    environment = {key: value for key, value in os.environ.items() if key != "NUMBA_DISABLE_JIT"}
    environment["NUMBA_CACHE_DIR"] = str(tmp_path / "cache")

    def output():
        process = subprocess.run(
            [sys.executable, script], env=environment, capture_output=True, text=True, timeout=300, check=False
        )
        assert process.returncode == 0, process.stderr
        return process.stdout.split("\n")[:3]

    expected = ["3.0 6.0", "2.625 5.25"]  # 8 (1, 2)/4 + (1, 2), and 8 (1 + 5/16) (1, 2)/4
    assert output() == [*expected, "0 2"]
    assert output() == [*expected, "2 0"]


@kernel
def double_project(params, X, uv):
    if X[2] == 0.0 or not abs(X[0]) + abs(X[1]) + abs(X[2]) < np.inf:
        uv[:] = 0.0
        return False
    uv[0], uv[1] = 2.0 * params[0] * X[0] / X[2], 2.0 * params[0] * X[1] / X[2]
    return True


@kernel
def double_project_jacobian(params, X, uv, J_point, J_params):
    J_point[:, :] = 0.0
    J_params[:, :] = 0.0
    if not double_project(params, X, uv):
        return False
    J_point[0, 0] = J_point[1, 1] = 2.0 * params[0] / X[2]
    J_point[0, 2], J_point[1, 2] = -uv[0] / X[2], -uv[1] / X[2]
    J_params[0, 0], J_params[1, 0] = uv[0] / params[0], uv[1] / params[0]
    return True


@kernel
def wrong_project_jacobian(params, X, uv, J_point, J_params):
    known = double_project_jacobian(params, X, uv, J_point, J_params)
    J_params[0, 0] *= 1.001
    return known


@kernel
def double_unproject(params, uv, bearing):
    x, y = uv[0] / (2.0 * params[0]), uv[1] / (2.0 * params[0])
    norm = np.sqrt(1.0 + x * x + y * y)
    bearing[:] = 0.0
    if not norm < np.inf:
        return False
    bearing[0], bearing[1], bearing[2] = x / norm, y / norm, 1.0 / norm
    return True


@kernel
def bent_unproject(params, uv, bearing):
    known = double_unproject(params, uv, bearing)
    bearing[0] += 1e-6
    return known


DOUBLE = cameras.CameraModel("DOUBLE", ("half",), (0,), (), ())


@pytest.fixture
def registry(monkeypatch):
    """Forget models registered by a test."""
    monkeypatch.setattr(_camera, "_MODELS", dict(_camera._MODELS))


def test_an_outside_model_takes_part(registry):
    model = cameras.register_camera(DOUBLE, double_project, double_project_jacobian, double_unproject)
    assert cameras.model("DOUBLE") is model
    assert cameras.models()[-1] is model
    check_camera(model, np.array([250.0]), np.random.default_rng(0))


def test_the_check_finds_a_wrong_derivative(registry):
    model = cameras.register_camera(
        replace(DOUBLE, name="WRONG"), double_project, wrong_project_jacobian, double_unproject
    )
    with pytest.raises(AssertionError, match="WRONG: derivative by the parameters differ"):
        check_camera(model, np.array([250.0]), np.random.default_rng(0))


def test_the_check_finds_an_inverse_that_is_none(registry):
    model = cameras.register_camera(
        replace(DOUBLE, name="BENT"), double_project, double_project_jacobian, bent_unproject
    )
    with pytest.raises(AssertionError, match=r"BENT: unproject\(project\(X\)\)"):
        check_camera(model, np.array([250.0]), np.random.default_rng(0))


def test_names_are_unique_and_numbers_are_given(registry):
    kernels = double_project, double_project_jacobian, double_unproject
    with pytest.raises(InputError, match=r"registered already, by groma\.cameras\.pinhole"):
        cameras.register_camera(replace(DOUBLE, name="PINHOLE"), *kernels)
    assert cameras.model("PINHOLE") is cameras.PINHOLE
    taken = {model.number for model in cameras.models()}
    assert cameras.register_camera(replace(DOUBLE, number=cameras.PINHOLE.number), *kernels).number not in taken


def test_a_model_that_is_not_registered_says_so():
    with pytest.raises(InputError, match="register_camera returns"):
        DOUBLE.project(np.array([1.0]), np.ones((1, 3)))


def test_a_model_registered_again_uses_its_new_kernels(registry):
    """As when its module is loaded again; loops compiled for the old kernels must not serve the new ones."""
    kernels = double_project, double_project_jacobian, double_unproject
    old = cameras.register_camera(DOUBLE, *kernels)
    check_camera(old, np.array([250.0]), np.random.default_rng(0))
    new = cameras.register_camera(DOUBLE, double_project, wrong_project_jacobian, double_unproject)
    assert cameras.models()[-1] is cameras.model("DOUBLE") is new
    with pytest.raises(AssertionError, match="derivative by the parameters differ"):
        check_camera(new, np.array([250.0]), np.random.default_rng(0))
    check_camera(old, np.array([250.0]), np.random.default_rng(0))
