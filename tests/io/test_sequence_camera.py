# SPDX-License-Identifier: BSD-3-Clause
"""The camera of a sequence as a value: what it takes, and what it refuses."""

import numpy as np
import pytest

from groma.errors import InputError
from groma.io.sequences import SequenceCamera


def test_a_camera_takes_lists_and_keeps_an_array_of_its_own():
    params = np.array([50.0, 51.0, 32.0, 24.0])
    camera = SequenceCamera("PINHOLE", params, 64, 48)
    params[0] = 0.0
    assert camera.params[0] == 50.0
    np.testing.assert_array_equal(SequenceCamera("PINHOLE", [50, 51, 32, 24], 64, 48).params, camera.params)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ("PINHOLE", [50, 51, 32], 64, 48),
            r"PINHOLE takes 4 finite numbers \(fx, fy, cx, cy\); got \[50.0",
        ),
        (("PINHOLE", [50, 51, 32, 24, 0], 64, 48), "takes 4 finite numbers"),
        (("OPENCV", [50, 51, 32, 24], 64, 48), "takes 8 finite numbers"),
        (("PINHOLE", [50, np.nan, 32, 24], 64, 48), "takes 4 finite numbers"),
        (("PINHOLE", None, 64, 48), "takes 4 finite numbers"),
        (("PINHOLE", "wide", 64, 48), "could not convert"),
        (("PINHOLE", [50, -51, 32, 24], 64, 48), "focal lengths must be positive"),
        (("CIRCLE", [50, 51, 32, 24], 64, 48), "must be one of"),
        (("PINHOLE", [50, 51, 32, 24], 64, 0), "width and height must be positive"),
        (("PINHOLE", [50, 51, 32, 24], 64, 48, 0.0), "baseline must be positive"),
    ],
)
def test_a_camera_of_a_sequence_is_checked(arguments, words):
    with pytest.raises(InputError, match=words):
        SequenceCamera(*arguments)
