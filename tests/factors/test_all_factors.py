# SPDX-License-Identifier: BSD-3-Clause
"""Every registered factor: the conformance check, what it notices when the world moves, the registry, and that the
check notices broken factors."""

import dataclasses

import numpy as np
import pytest

import groma
import groma.factors
from groma.factors import Invariance, Slot, check_factor, contract, registered
from groma.factors.checks.check import ambients_of, linearized, residuals_of
from groma.factors.checks.world import WorldMotion, moved_world
from groma.factors.relations.point_on_plane import PointOnPlane
from groma.geometry import so3

pytestmark = pytest.mark.kernels
NAMES = sorted(registered())


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1])
def test_keeps_the_contract(name, seed):
    check = check_factor(registered()[name], np.random.default_rng(seed))
    slots = [slot.name for slot, _ in registered()[name].example(np.random.default_rng(seed)).factor.references()]
    assert list(check.worst) == slots
    assert max(check.worst.values()) < 1e-6


def move(name, motion):
    """Residuals of an example before and after a motion of the world."""
    example = registered()[name].example(np.random.default_rng(4))
    slots, ambients = [slot for slot, _ in example.factor.references()], ambients_of(example)
    return residuals_of(example.factor, ambients), residuals_of(example.factor, moved_world(slots, ambients, motion))


#: Factors that measure in world coordinates, and those that do not mind how large the world is.
TIED = {"line_normal", "line_on_plane", "plane_quaternion", "pose_prior", "position_prior", "segment_on_plane"}
TIED |= {"segment_on_plane_pixels", "vector_prior", "on_known_plane"}
#: Those that compare directions with known ones of the world.
TURNED = {"camera_direction", "known_direction"}
WITHOUT_SIZE = {name for name in NAMES if name.startswith(("parallel_", "orthogonal_")) or "_parallel_" in name}
WITHOUT_SIZE |= {name for name in NAMES if "_perpendicular_" in name}
WITHOUT_SIZE |= {
    "line_bearing",
    "line_unprojection",
    "line_direction",
    "line_normal",
    "line_reprojection",
    "line_to_pixel",
}
WITHOUT_SIZE |= {"point_on_plane_pixels", "point_reprojection", "point_to_image_line", "similarity_between", *TURNED}


def test_what_is_declared_about_motions_of_the_world():
    """The conformance check finds every declaration true; here they are listed."""
    assert {name for name, cls in registered().items() if not cls.invariance.translation} == TIED
    assert {name for name, cls in registered().items() if cls.invariance.rotation is not True} == (
        TIED - {"line_normal"}
    ) | TURNED
    assert {name for name, cls in registered().items() if cls.invariance.scale} == WITHOUT_SIZE


@pytest.mark.parametrize("name", [name for name in NAMES if name not in TIED | TURNED])
def test_residual_does_not_change_when_the_world_moves(name):
    rotation = so3.exp(np.array([[0.9, -1.3, 1.1]]))[0]
    before, after = move(name, WorldMotion("all at once", True, rotation, np.array([0.3, -0.4, 0.5])))
    if "pose" not in [slot.kind for slot in registered()[name].slots]:  # a vector in the world
        before, after = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-10 * max(1.0, np.abs(before).max()))


@pytest.mark.parametrize("name", sorted(TIED - {"vector_prior"}))
def test_the_exceptions_are_real(name):
    before, after = move(name, WorldMotion("away", False, np.eye(3), np.array([0.3, -0.4, 0.5])))
    assert not np.allclose(before, after)


def up_in_camera(invariance):
    """A factor that measures the world's vertical in a camera, with one declaration or another; not registered."""

    @groma.factor("up_in_camera", slots=[("pose", "pose")], residual_size=3, data_size=3, invariance=invariance)
    def UpInCamera(data, pose, out):  # noqa: N802
        for i in range(3):
            out[i] = pose[i, 2] - data[i]

    return UpInCamera


@pytest.fixture
def registry(monkeypatch):
    monkeypatch.setattr(contract, "_REGISTRY", dict(contract._REGISTRY))


def test_a_factor_may_be_tied_to_the_vertical_of_the_world(registry):
    check_factor(up_in_camera(Invariance(rotation=(0.0, 0.0, 1.0))))


@pytest.mark.parametrize(
    ("invariance", "message"),
    [
        (Invariance(), "a rotation of the world changes its residuals"),
        (Invariance(rotation=(1.0, 0.0, 0.0)), r"a rotation about \(1.0, 0.0, 0.0\) of the world changes"),
        (Invariance(False, (0.0, 0.0, 1.0)), "a translation of the world leaves its residuals as they are"),
    ],
)
def test_check_notices_a_wrong_word_about_motions_of_the_world(registry, invariance, message):
    with pytest.raises(AssertionError, match=message):
        check_factor(up_in_camera(invariance))


def test_check_notices_a_wrong_word_about_scale():
    with pytest.raises(AssertionError, match="a scaling of the world changes its residuals"):
        check_factor(broken(invariance=Invariance(scale=True)))


def test_a_slot_that_is_not_in_the_world_stays():
    """Otherwise cameras on rigs would seem to notice every motion."""
    motion = WorldMotion("away", True, np.eye(3), np.ones(3), 2.0)
    pose = np.hstack([np.eye(3), [[1.0], [2.0], [3.0]]]).reshape(1, 12)
    moved = moved_world([Slot("a", "pose"), Slot("b", "pose", in_world=False)], (pose, pose), motion)
    np.testing.assert_array_equal(moved[0][0, 3::4], [1.0, 3.0, 5.0])
    np.testing.assert_array_equal(moved[1][0, 3::4], [2.0, 4.0, 6.0])


def test_registry_holds_what_the_package_exports():
    exported = {value for value in vars(groma.factors).values() if getattr(value, "type_name", "")}
    assert {cls for cls in registered().values() if cls.__module__.startswith("groma.")} == exported
    assert groma.factors.__all__ == sorted(groma.factors.__all__, key=lambda n: (not n.isupper(), n.islower(), n))


def broken(**changes):
    """A copy of PointOnPlane with methods replaced; not registered."""
    return dataclasses.dataclass(frozen=True, kw_only=True)(type("Broken", (PointOnPlane,), changes))


def test_check_notices_a_wrong_derivative_and_prints_both_matrices():
    def linearize(self, inputs, begin, end, columns, record):
        degenerate = PointOnPlane.linearize(self, inputs, begin, end, columns, record)
        if columns[1] >= 0:
            record[:, :, columns[1] + 3] *= 1.001
        return degenerate

    with pytest.raises(AssertionError, match=r"(?s)block 'plane'.*analytic\n\[\[.*numeric\n\[\["):
        check_factor(broken(linearize=linearize))


def test_check_notices_a_written_column_that_was_not_wanted():
    def linearize(self, inputs, begin, end, columns, record):
        degenerate = PointOnPlane.linearize(self, inputs, begin, end, columns, record)
        if columns[0] < 0 <= columns[1]:
            record[:, :, 0] = 0.0
        return degenerate

    with pytest.raises(AssertionError, match="unwanted block"):
        check_factor(broken(linearize=linearize))


def test_check_notices_nan_and_uncounted_degeneracy():
    def linearize(self, inputs, begin, end, columns, record):
        PointOnPlane.linearize(self, inputs, begin, end, columns, record)
        return 0

    with pytest.raises(AssertionError, match="counts as valid"):
        check_factor(broken(linearize=linearize))

    def residuals(self, inputs, begin, end, out):
        degenerate = PointOnPlane.residuals(self, inputs, begin, end, out)
        out[~out.any(axis=1)] = np.nan
        return degenerate

    with pytest.raises(AssertionError, match="NaN or infinity"):
        check_factor(broken(residuals=residuals))


def test_check_notices_a_range_that_is_ignored():
    def residuals(self, inputs, begin, end, out):
        return PointOnPlane.residuals(self, inputs, 0, end - begin, out)

    with pytest.raises(AssertionError, match="differs from those rows"):
        check_factor(broken(residuals=residuals))


def test_records_may_be_laid_out_in_any_order():
    example = PointOnPlane.example(np.random.default_rng(0))
    inputs = example.factor.prepare(ambients_of(example))
    expected, _ = linearized(example.factor, ambients_of(example), [3, 4])
    record = np.zeros((6, 1, 10))
    example.factor.linearize(inputs, 0, 6, (6, 1), record)
    np.testing.assert_array_equal(record[:, :, 6:9], expected[:, :, :3])
    np.testing.assert_array_equal(record[:, :, 1:5], expected[:, :, 3:7])
