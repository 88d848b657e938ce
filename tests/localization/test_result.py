# SPDX-License-Identifier: BSD-3-Clause
"""Results as a table."""

import numpy as np
import pytest

from groma.geometry import se3
from groma.localization.result import row_of
from groma.localization.stored import StoredImage


@pytest.mark.parametrize(("sigma_deg", "shown"), [(0.03, "0.030°"), (0.0244, "0.024°"), (12.3, "12°")])
def test_deviations_have_two_digits_in_every_row(sigma_deg, shown):
    covariance = np.diag([0.0, 0.0, 0.04**2, np.radians(sigma_deg) ** 2, 0.0, 0.0])
    none = np.zeros(0, int)
    one = StoredImage(
        "a.jpg", "localized", "", se3.identity(1)[0], covariance, "PINHOLE", np.array([500.0, 500, 320, 240]),
        np.array([640, 480]), none, np.zeros((0, 2)), none, np.zeros((0, 4)), 0.0,
    )  # fmt: skip
    assert row_of(one)[-1] == shown
    one = StoredImage(**{**vars(one), "covariance": np.diag([0.0, 0.0, 0.04**2, 0.0, 0.0, 0.0])})
    assert row_of(one)[-2] == "0.040"
