# SPDX-License-Identifier: BSD-3-Clause
"""Every registered factor: the conformance check, invariance when the world moves, the registry, and that the check
notices broken factors."""

import dataclasses

import numpy as np
import pytest

import groma.factors
from groma.factors import check_factor, registered
from groma.factors._examples import random_poses
from groma.factors._record import poses_from_states
from groma.factors.checks.check import _ambients, _linearize, _residuals
from groma.factors.relations.point_on_plane import PointOnPlane

pytestmark = pytest.mark.kernels
NAMES = sorted(registered())

#: Factors that measure in world coordinates, and why.
TIED_TO_THE_WORLD = {
    "line_normal": "the anchor of a line is its point closest to the world origin",
    "line_on_plane": "anchors are world points",
    "plane_quaternion": "the angle between 4-vectors depends on the world origin",
    "pose_prior": "a prior fixes the world",
    "position_prior": "a prior fixes the world",
    "segment_on_plane": "ends are world points",
    "segment_on_plane_pixels": "ends are world points",
    "vector_prior": "a prior fixes the world",
}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("seed", [0, 1])
def test_keeps_the_contract(name, seed):
    check = check_factor(registered()[name], np.random.default_rng(seed))
    slots = [slot.name for slot, _ in registered()[name].example(np.random.default_rng(seed)).factor.references()]
    assert list(check.worst) == slots
    assert max(check.worst.values()) < 1e-6


def hat(t):
    return np.array([[0, -t[2], t[1]], [t[2], 0, -t[0]], [-t[1], t[0], 0]])


def move_world(kind, ambient, S):
    """Apply the motion ``S`` (4, 4) of the world to what factors read."""
    R, t = S[:3, :3], S[:3, 3]
    if kind == "pose":
        moved = ambient.reshape(-1, 3, 4) @ np.linalg.inv(S)
        return np.ascontiguousarray(moved).reshape(-1, 12)
    if kind == "point":
        return ambient @ R.T + t
    if kind == "line":
        return np.hstack([ambient[:, :3] @ R.T + ambient[:, 3:] @ (hat(t) @ R).T, ambient[:, 3:] @ R.T])
    if kind == "plane":
        return ambient @ np.linalg.inv(S)
    if kind == "direction":
        return ambient @ R.T
    return ambient


@pytest.mark.parametrize("name", [name for name in NAMES if name not in TIED_TO_THE_WORLD])
def test_residual_does_not_change_when_the_world_moves(name):
    rng = np.random.default_rng(4)
    example = registered()[name].example(rng)
    S = np.vstack([poses_from_states(random_poses(rng, 1, rotation=2.0)).reshape(3, 4), [0, 0, 0, 1]])
    slots = [slot for slot, _ in example.factor.references()]
    moved = tuple(
        ambient if slot.name == "extrinsics" else move_world(slot.kind, ambient, S)
        for slot, ambient in zip(slots, _ambients(example), strict=True)
    )
    before, after = _residuals(example.factor, _ambients(example)), _residuals(example.factor, moved)
    if "pose" not in [slot.kind for slot in slots]:  # a vector in the world, such as the offset of a point from a line
        before, after = np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)
    np.testing.assert_allclose(after, before, rtol=1e-9, atol=1e-10 * max(1.0, np.abs(before).max()))


@pytest.mark.parametrize("name", sorted(set(TIED_TO_THE_WORLD) & set(NAMES)))
def test_the_exceptions_are_real(name):
    """Otherwise the list above would hide factors from the test."""
    rng = np.random.default_rng(4)
    example = registered()[name].example(rng)
    S = np.eye(4)
    S[:3, 3] = [0.3, -0.4, 0.5]
    slots = [slot for slot, _ in example.factor.references()]
    kinds = [
        "point" if slot.kind == "vector" and a.shape[1] == 3 else slot.kind
        for slot, a in zip(slots, _ambients(example), strict=True)
    ]
    if "vector" in kinds:
        return  # numbers that do not live in the world at all
    moved = tuple(move_world(kind, ambient, S) for kind, ambient in zip(kinds, _ambients(example), strict=True))
    assert not np.allclose(_residuals(example.factor, moved), _residuals(example.factor, _ambients(example)))


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
    inputs = example.factor.prepare(_ambients(example))
    expected, _ = _linearize(example.factor, _ambients(example), [3, 4])
    record = np.zeros((6, 1, 10))
    example.factor.linearize(inputs, 0, 6, (6, 1), record)
    np.testing.assert_array_equal(record[:, :, 6:9], expected[:, :, :3])
    np.testing.assert_array_equal(record[:, :, 1:5], expected[:, :, 3:7])
