# SPDX-License-Identifier: BSD-3-Clause
"""Quantiles and tails against scipy.stats, and that nothing imports that half second of code."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from groma.estimators.association import log10_binomial_tail, log10_poisson_tail
from groma.gates import chi_square_gate


@pytest.mark.parametrize("dof", [1, 2, 3, 7, 400])
def test_quantiles_of_chi_squares(dof):
    for share in (0.001, 0.5, 0.99, 0.9973, 1 - 1e-9):
        assert chi_square_gate(1.0 - share, dof) == pytest.approx(stats.chi2.isf(1.0 - share, dof), rel=1e-12)


@pytest.mark.filterwarnings("error")
def test_tails_of_poisson():
    for count in (-1, 0, 3, 40):
        for mean in (1e-3, 0.5, 30.0):
            expected = stats.poisson.logsf(count, mean) / np.log(10.0)
            assert log10_poisson_tail(count, mean) == pytest.approx(expected, rel=1e-12)
    # Below the smallest number; the terms after the first add a part in 400 000.
    for count, mean in ((400, 1e-3), (2000, 30.0)):
        expected = stats.poisson.logpmf(count + 1, mean) / np.log(10.0)
        assert log10_poisson_tail(count, mean) == pytest.approx(expected, rel=1e-5)
    assert log10_poisson_tail(3, 0.0) == -np.inf


def test_what_takes_long_to_import_is_not_imported():
    modules = "groma.mapping.map, groma.tracking.sequence, groma.adjustment.adjust"
    heavy = "scipy.stats", "scipy.optimize", "scipy.integrate", "scipy.interpolate", "matplotlib", "rich", "pycolmap"
    code = f"import sys, {modules}; print(*[name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []


def test_tails_of_binomials():
    for count in (-1, 0, 5, 19):
        expected = stats.binom.logsf(count, 20, 0.3) / np.log(10.0)
        assert log10_binomial_tail(count, 20, 0.3) == pytest.approx(expected, rel=1e-10)
    assert log10_binomial_tail(3, 4, 1.0) == 0.0
    # Far below the smallest number.
    assert log10_binomial_tail(499, 500, 1e-3) == pytest.approx(-1500.0, rel=1e-12)
    assert log10_binomial_tail(450, 500, 1e-2) == pytest.approx(
        stats.binom.logpmf(451, 500, 1e-2) / np.log(10), rel=1e-5
    )
