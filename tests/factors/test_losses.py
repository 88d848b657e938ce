# SPDX-License-Identifier: BSD-3-Clause
"""Robust losses: normalisation at zero, derivatives against differences, Barron's known members, limits, errors."""

import math

import numpy as np
import pytest

from groma.errors import InputError
from groma.factors.losses import (
    LOSSES,
    Barron,
    Cauchy,
    GemanMcClure,
    Huber,
    SoftL1,
    Trivial,
    Truncated,
    Tukey,
    loss,
    loss_value,
)

pytestmark = pytest.mark.kernels

ALL = [
    Trivial(),
    Huber(1.7),
    SoftL1(0.6),
    Cauchy(2.2),
    Tukey(4.5),
    GemanMcClure(1.3),
    Truncated(2.5),
    *(Barron(alpha, 1.4) for alpha in (2.0, 1.99999, 1.0, 0.3, 1e-6, 0.0, -1e-6, -2.0, -7.5, -math.inf)),
]
S = np.array([1e-6, 0.01, 0.3, 1.0, 2.0, 5.0, 17.0, 300.0, 1e6])


@pytest.mark.parametrize("member", ALL, ids=repr)
def test_value_is_zero_and_weight_one_at_zero(member):
    value, weight, second = member.evaluate(np.zeros(1))
    assert value[0] == 0.0
    assert weight[0] == pytest.approx(1.0, abs=1e-15)
    assert second[0] <= 0.0


@pytest.mark.parametrize("member", ALL, ids=repr)
def test_derivatives_equal_central_differences(member):
    step = 1e-5 * S
    value, weight, second = member.evaluate(S)
    plus, minus = member.evaluate(S + step), member.evaluate(S - step)
    # Rounding of the value over the step is the limit: 2e-16 rho / (1e-5 s), of the weight likewise.
    np.testing.assert_allclose((plus[0] - minus[0]) / (2 * step), weight, rtol=1e-7, atol=1e-10 * (value / S).max())
    np.testing.assert_allclose(((plus[1] - minus[1]) / (2 * step) - second) * S, 0.0, atol=2e-9)


@pytest.mark.parametrize("member", ALL, ids=repr)
def test_grows_never_faster_than_least_squares(member):
    value, weight, second = member.evaluate(S)
    assert np.all(np.diff(value) >= 0)
    assert np.all(value <= S * (1 + 1e-12))
    assert np.all((weight >= 0) & (weight <= 1 + 1e-12))
    assert np.all(second <= 0)
    assert np.isfinite([value, weight, second]).all()


@pytest.mark.parametrize(
    ("alpha", "same_as"),
    [(2.0, Trivial()), (1.0, SoftL1(1.4)), (0.0, Cauchy(1.4 * math.sqrt(2))), (-2.0, GemanMcClure(2.8))],
)
@pytest.mark.parametrize("offset", [0.0, 1e-9])
def test_barron_runs_through_the_known_members(alpha, same_as, offset):
    for ours, theirs in zip(Barron(alpha - offset, 1.4).evaluate(S), same_as.evaluate(S), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-7 if offset else 1e-12)


def test_barron_at_minus_infinity_is_the_limit():
    for ours, theirs in zip(Barron(-math.inf).evaluate(S[:7]), Barron(-1e10).evaluate(S[:7]), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5)


def test_tukey_and_truncated_are_constant_beyond_their_scale():
    value, weight, second = Tukey(3.0).evaluate(np.array([9.0, 1e9]))
    np.testing.assert_allclose(value, 3.0)
    assert not weight.any() and not second.any()
    value, weight, _ = Truncated(3.0).evaluate(np.array([8.9, 9.1]))
    np.testing.assert_array_equal(value, [8.9, 9.0])
    np.testing.assert_array_equal(weight, [1.0, 0.0])


def test_cauchy_halves_the_weight_at_its_scale():
    assert Cauchy(2.0).evaluate(np.array(4.0))[1] == pytest.approx(0.5)
    assert Huber(2.0).evaluate(np.array(16.0))[1] == pytest.approx(0.5)


def test_kernel_and_method_agree_and_shape_is_kept():
    member = Barron(0.5, 1.1)
    s = S.reshape(3, 3)
    value = member.evaluate(s)[0]
    assert value.shape == (3, 3)
    assert loss_value(member.tag, member.parameters, s[1, 1]) == value[1, 1]


def test_scaled_bends_at_so_many_times_the_scale():
    assert Cauchy(2.0).scaled(0.5) == Cauchy(1.0)
    assert Trivial().scaled(0.5) == Trivial()


def test_by_name():
    assert loss("huber", 1.5) == Huber(1.5)
    assert loss("soft-l1") == SoftL1(1.0)
    assert loss("none") == loss("trivial", 3.0) == Trivial()
    assert loss("barron", 2.0, alpha=-1.0) == Barron(-1.0, 2.0)
    for name in LOSSES:
        assert loss(name).name == name
    assert len({cls.number for cls in LOSSES.values()}) == len(LOSSES)


def test_errors_say_what_to_do():
    with pytest.raises(InputError, match=r"no loss named 'hubert'; choose one of none, barron, cauchy"):
        loss("hubert")
    with pytest.raises(InputError, match=r"positive number .* got 0.0"):
        Huber(0.0)
    with pytest.raises(InputError, match=r"at most 2; got 2\.5"):
        Barron(2.5)
    with pytest.raises(InputError, match="Leave it out"):
        loss("huber", alpha=1.0)
