# SPDX-License-Identifier: BSD-3-Clause
"""The problem of one pose, made without a scene, is the one that is made of a scene, number by number."""

from dataclasses import fields

import numpy as np
import pytest

from groma.factors.contract import Ref
from groma.geometry import se3
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.matches import Matches
from groma.localization.pose.pose_problem import assembled, problem_of


@pytest.mark.parametrize(
    ("model", "params", "points", "lines"),
    [
        ("PINHOLE", [500.0, 510.0, 320.0, 240.0], 7, 4),
        ("SIMPLE_PINHOLE", [500.0, 320.0, 240.0], 0, 4),
        ("SIMPLE_RADIAL", [500.0, 320.0, 240.0, 0.1], 7, 0),
    ],
)
def test_it_is_what_a_scene_becomes(model, params, points, lines):
    rng = np.random.default_rng(points + lines)
    pose = se3.exp(rng.normal(size=(1, 6)))[0]
    matches = Matches(
        rng.uniform(0, 480, (points, 2)), rng.normal(size=(points, 3)),
        rng.uniform(0, 480, (lines, 2, 2)), rng.normal(size=(lines, 2, 3)),
        rng.uniform(0.5, 2, points), rng.uniform(0.5, 2, lines),
    )  # fmt: skip
    camera = QueryCamera(model, np.array(params), 640, 480)
    made, expected = problem_of(camera, matches, pose), assembled(camera, matches, pose, True)
    assert [part.kind for part in made.parts] == [part.kind for part in expected]
    for one, other in zip(made.parts, expected, strict=True):
        np.testing.assert_array_equal(one.row, other.row)
        np.testing.assert_allclose(one.landmarks, other.landmarks, rtol=0, atol=1e-14)
        assert type(one.factor) is type(other.factor)
        assert one.has_lens
        for field in fields(other.factor):
            ours, theirs = getattr(one.factor, field.name), getattr(other.factor, field.name)
            if isinstance(theirs, Ref):
                np.testing.assert_array_equal(ours.index, theirs.index)
            elif isinstance(theirs, np.ndarray):
                np.testing.assert_array_equal(ours, theirs)
            else:
                assert ours == theirs
