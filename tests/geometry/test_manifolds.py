# SPDX-License-Identifier: BSD-3-Clause
"""Every chart keeps the contract of manifolds; and the check that says so notices charts that do not."""

import numpy as np
import pytest

from groma import testing
from groma.errors import InputError
from groma.geometry.charts.line_charts import LINE_CHARTS, CartesianLine
from groma.geometry.charts.plane_charts import PLANE_CHARTS, NormalOffsetPlane
from groma.geometry.charts.point3 import POINT_CHARTS, from_homogeneous, to_homogeneous
from groma.geometry.charts.pose_charts import POSE_CHARTS, PoseBody, PoseLeft, PoseRight
from groma.geometry.charts.similarity import SIMILARITY_CHARTS
from groma.geometry.charts.unit3 import DIRECTION_CHARTS, Unit3
from groma.geometry.manifold import Euclidean
from groma.testing import check_manifold

pytestmark = pytest.mark.kernels

TABLES = {
    "pose": POSE_CHARTS,
    "similarity": SIMILARITY_CHARTS,
    "line": LINE_CHARTS,
    "plane": PLANE_CHARTS,
    "direction": DIRECTION_CHARTS,
    "point": POINT_CHARTS,
    "intrinsics": {"euclidean": Euclidean(4, "intrinsics")},
    "vector": {"euclidean": Euclidean(9)},
}
CASES = [
    pytest.param(manifold, id=f"{kind}-{name}") for kind, table in TABLES.items() for name, manifold in table.items()
]


@pytest.mark.parametrize("manifold", CASES)
@pytest.mark.parametrize("seed", [0, 1])
def test_contract(manifold, seed):
    check_manifold(manifold, rng=np.random.default_rng(seed), count=12)


@pytest.mark.parametrize("manifold", CASES)
def test_kind_and_name(manifold):
    assert TABLES[manifold.kind][manifold.name] is manifold
    assert repr(manifold)


@pytest.mark.parametrize("manifold", CASES)
def test_large_steps_stay_finite(manifold):
    rng = np.random.default_rng(2)
    state = manifold.random(rng, 6)
    for magnitude in (10.0, 1e3):
        moved = manifold.retract(state, rng.uniform(-magnitude, magnitude, (6, manifold.dof)))
        assert np.isfinite(moved).all()
        assert np.isfinite(manifold.ambient(moved)).all()


class _WrongBasis(PoseRight):
    def basis(self, state):
        return np.broadcast_to(np.eye(6), (len(state), 6, 6))


class _WrongInverse(PoseLeft):
    def local(self, state, other):
        return PoseBody().local(state, other)


class _Careless(CartesianLine):
    def retract(self, state, delta):
        moved = super().retract(state, delta)
        state[:] = moved
        return moved


class _NotUnit(Unit3):
    def from_ambient(self, ambient):
        return ambient * (1 + 1e-6)


class _Shifted(NormalOffsetPlane):
    def ambient(self, state):
        return super().ambient(state) + np.array([0.0, 0.0, 0.0, 1e-6])


class _Neighbours(PoseLeft):
    def retract(self, state, delta):
        return super().retract(state, delta + 0.1 * delta[::-1])


class _RowsDiffer(PoseLeft):
    """Right for a batch, wrong for one row."""

    def retract(self, state, delta):
        return super().retract(state, delta * (1.0 if len(state) != 1 else 1.001))


class _NotFinite(NormalOffsetPlane):
    def basis(self, state):
        return super().basis(state) * np.where(state[:, 3] == 0.0, np.nan, 1.0)[:, None, None]


class _TooSmall(Unit3):
    ambient_size = 2


@pytest.mark.parametrize(
    ("broken", "complaint"),
    [
        (_WrongBasis(), "basis differs from differences.*expected.*got"),
        (_WrongInverse(), "is not delta"),
        (_Careless(), "changed an argument"),
        (_NotUnit(), "another object"),
        (_Shifted(), "another object"),
        (_Neighbours(), "is not delta"),
        (_RowsDiffer(), "of one row"),
        (_NotFinite(), "not finite"),
        (_TooSmall(), "needs 3 numbers, not 2"),
    ],
    ids=lambda value: type(value).__name__ if not isinstance(value, str) else "",
)
def test_broken_charts_are_noticed(broken, complaint):
    with pytest.raises(AssertionError, match=rf"(?s){complaint}"):
        check_manifold(broken)


def test_a_chart_may_refuse_with_an_input_error_only():
    class Refuses(NormalOffsetPlane):
        error: type[Exception] = InputError

        def from_ambient(self, ambient):
            if len(ambient) and (ambient[:, 3] == 0).any():
                raise self.error("no planes through the origin here")
            return super().from_ambient(ambient)

    check_manifold(Refuses())
    Refuses.error = ZeroDivisionError
    with pytest.raises(ZeroDivisionError):
        check_manifold(Refuses())


def test_testing_is_lazy_and_says_what_there_is():
    assert testing.__all__ == sorted(testing.__all__) == dir(testing)
    assert callable(testing.check_camera)
    assert callable(testing.check_factor)
    with pytest.raises(AttributeError, match="check_manifold"):
        _ = testing.check_chart


def test_homogeneous_points():
    points = np.random.default_rng(3).normal(size=(2, 5, 3))
    np.testing.assert_allclose(from_homogeneous(-2.5 * to_homogeneous(points)), points, rtol=1e-15)
    assert np.isnan(from_homogeneous(np.array([1.0, 2.0, 3.0, 0.0]))).all()
