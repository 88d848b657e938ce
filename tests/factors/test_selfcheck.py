# SPDX-License-Identifier: BSD-3-Clause
"""The self-check: it covers every registered factor, reports plain values, compares with reference values, notices
errors."""

import json
from pathlib import Path

import numpy as np
import pytest

from groma import cameras
from groma.errors import InputError
from groma.factors import contract as _factor
from groma.factors import registered, selfcheck
from groma.factors.checks.selfcheck import SelfCheckReport, SelfCheckRow
from groma.factors.priors.position_prior import PositionPrior

pytestmark = pytest.mark.kernels


@pytest.fixture
def two_factors(monkeypatch):
    """A registry of two factors, to be quick."""
    names = ("position_prior", "point_on_plane")
    monkeypatch.setattr(_factor, "_REGISTRY", {name: registered()[name] for name in names})


@pytest.mark.compiled
def test_covers_every_factor_and_block():
    report = selfcheck(seed=3)
    assert report.passed
    lenses = {f"camera {model.name}" for model in cameras.models() if model.colmap_name}
    assert {row.factor for row in report.rows} == {*registered(), *lenses}
    assert len(lenses) == 18
    assert all({row.block for row in report.rows if row.factor == name} == {"point", "parameters"} for name in lenses)
    for name, cls in registered().items():
        blocks = {row.block.split(" ")[0] for row in report.rows if row.factor == name}
        assert blocks == {slot.name for slot, _ in cls.example(np.random.default_rng(3)).factor.references()}
    assert all(row.against == "differences" and row.cases > 0 and 0 <= row.worst < 1 for row in report.rows)


def test_report_is_plain_json(two_factors):
    report = selfcheck()
    read = json.loads(json.dumps(report.to_dict(), allow_nan=False))
    assert read["passed"] is True
    assert len(read["rows"]) == len(report.rows)
    assert set(read["rows"][0]) == {"factor", "block", "against", "cases", "worst", "passed"}


def test_a_wrong_derivative_fails(two_factors, monkeypatch):
    right = PositionPrior.linearize

    def linearize(self, inputs, begin, end, columns, record):
        degenerate = right(self, inputs, begin, end, columns, record)
        if columns[0] >= 0:
            record[:, :, columns[0]] *= 1.001
        return degenerate

    monkeypatch.setattr(PositionPrior, "linearize", linearize)
    report = selfcheck()
    assert not report.passed
    assert {row.factor for row in report.rows if not row.passed} == {"position_prior"}


def test_nan_and_emptiness_do_not_pass():
    row = SelfCheckRow("f", "b", "differences", 1, float("nan"), passed=False)
    assert SelfCheckReport((row,)).to_dict()["rows"][0]["worst"] is None
    assert not SelfCheckReport(()).passed


def test_folder_that_is_not_there(two_factors):
    with pytest.raises(InputError, match="expected at nowhere"):
        selfcheck(Path("nowhere"))


@pytest.mark.shared
def test_reference_values(two_factors, shared_golden):
    report = selfcheck(shared_golden)
    golden = [row for row in report.rows if row.against == "golden"]
    assert report.passed
    assert len({row.factor for row in golden}) == 4
    assert all(row.cases > 0 for row in golden)
