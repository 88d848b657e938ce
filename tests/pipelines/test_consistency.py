# SPDX-License-Identifier: BSD-3-Clause
"""The Monte-Carlo test of covariances: averages in the band for every kind and gauge, and it notices wrong noise."""

import json

import pytest

from groma.errors import InputError
from groma.pipelines.consistency import consistency

pytestmark = pytest.mark.kernels


def test_every_kind_in_both_gauges():
    report = consistency(runs=4, seed=0, num_images=8)
    assert [(row.gauge, row.kind) for row in report.rows] == [
        ("held", "poses"), ("held", "points"), ("held", "lines"), ("held", "planes"),
        ("inner", "poses"), ("inner", "points"), ("inner", "lines"),
    ]  # fmt: skip
    assert report.passed
    assert [row.dof for row in report.rows] == [6, 3, 4, 3, 6, 3, 4]
    assert json.loads(json.dumps(report.to_dict(), allow_nan=False))["passed"] is True


def test_wrong_noise_is_noticed():
    report = consistency(runs=4, seed=0, num_images=8, noise_px=0.5, believed_px=0.35, gauges=("held",))
    assert not report.passed
    assert all(row.average > row.dof for row in report.rows)


@pytest.mark.slow
def test_averages_in_the_band():
    report = consistency(runs=40, seed=0)
    for row in report.rows:
        assert row.inside, f"{row.gauge} {row.kind}: {row.average:.3f} not in {row.low:.3f} .. {row.high:.3f}"
    wrong = consistency(runs=40, seed=0, believed_px=0.45)
    assert not wrong.passed


def test_wrong_options_are_refused():
    with pytest.raises(InputError, match="At least 2 runs"):
        consistency(runs=1)
    with pytest.raises(InputError, match="'held' or 'inner'"):
        consistency(gauges=("free",))
