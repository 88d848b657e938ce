# SPDX-License-Identifier: BSD-3-Clause
"""Charts of poses: each update written out with matrices, drift of the quaternion, refused matrices.

The round trips and derivatives common to all charts are in test_manifolds.py.
"""

import numpy as np
import pytest
from scipy.linalg import expm

from groma.errors import InputError, ShapeError
from groma.geometry import se3, so3
from groma.geometry.charts.pose_charts import POSE_CHARTS, PoseBody, PoseLeft, PoseRight

pytestmark = pytest.mark.kernels


def _case(seed: int = 1, count: int = 8) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return PoseLeft().random(rng, count), rng.uniform(-1, 1, (count, 6))


def test_left_multiplies_from_the_left():
    state, delta = _case()
    expected = expm(se3.hat(delta)) @ se3.to_matrix(state)
    np.testing.assert_allclose(se3.to_matrix(PoseLeft().retract(state, delta)), expected, atol=1e-13)


def test_right_multiplies_from_the_right():
    state, delta = _case()
    expected = se3.to_matrix(state) @ expm(se3.hat(delta))
    np.testing.assert_allclose(se3.to_matrix(PoseRight().retract(state, delta)), expected, atol=1e-13)


def test_body_is_the_update_of_the_free_line_notes():
    state, delta = _case()
    T, moved = se3.to_matrix(state), se3.to_matrix(PoseBody().retract(state, delta))
    np.testing.assert_allclose(moved[:, :3, :3], T[:, :3, :3] @ so3.exp(delta[:, 3:]), atol=1e-14)  # (4.1)
    shift = (T[:, :3, :3] @ delta[:, :3, None])[..., 0]
    np.testing.assert_allclose(moved[:, :3, 3], T[:, :3, 3] + shift, atol=1e-14)  # (4.2)


@pytest.mark.parametrize("chart", POSE_CHARTS.values(), ids=POSE_CHARTS)
def test_quaternions_do_not_drift(chart):
    rng = np.random.default_rng(2)
    state = chart.random(rng, 4)
    for _ in range(100):
        state = chart.retract(state, rng.normal(size=(4, 6)))
    np.testing.assert_allclose(np.linalg.norm(state[:, :4], axis=1), 1.0, atol=4e-16)


def test_names_and_default():
    assert list(POSE_CHARTS) == ["left", "right", "body"]
    assert all(chart.name == name for name, chart in POSE_CHARTS.items())


def test_ambient_is_the_row_major_matrix():
    state, _ = _case()
    np.testing.assert_allclose(
        PoseLeft().ambient(state).reshape(-1, 3, 4), se3.to_matrix(state)[:, :3], rtol=0, atol=1e-15
    )


@pytest.mark.parametrize("scale", [2.0, -1.0, np.nan])
def test_from_ambient_refuses_what_is_no_rotation(scale):
    ambient = PoseLeft().ambient(_case()[0]).reshape(-1, 3, 4)
    ambient[3, :, :3] *= scale
    with pytest.raises(InputError, match="row 3"):
        PoseLeft().from_ambient(ambient.reshape(-1, 12))


def test_wrong_shapes_are_named():
    state, delta = _case()
    with pytest.raises(ShapeError, match=r"delta must have shape \(N, 6\)"):
        PoseLeft().retract(state, delta[:, :3])
    with pytest.raises(ShapeError, match="as many rows"):
        PoseBody().retract(state, delta[:3])
