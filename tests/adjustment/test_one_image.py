# SPDX-License-Identifier: BSD-3-Clause
"""The problem of one image, made without a scene, is the one that is made of a scene, number by number."""

from dataclasses import fields

import numpy as np
import pytest

from groma import cameras
from groma.adjustment.assemble import assemble
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.one_image import one_image_problem
from groma.factors.contract import Ref
from groma.geometry import se3
from groma.scene import Cameras, LineObservations, Lines, PointObservations, Points, Scene

OPTIONS = AssemblyOptions(
    point_chart="euclidean", drop_behind=False, require_in_front=True, gauge="free", refine_landmarks=False
)


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
    pixels, xyz, sigma = rng.uniform(0, 480, (points, 2)), rng.normal(size=(points, 3)), rng.uniform(0.5, 2, points)
    ends, places = rng.uniform(0, 480, (lines, 4)), rng.normal(size=(lines, 2, 3))
    own, line_sigma = Lines.through(places), rng.uniform(0.5, 2, lines)
    table = Cameras(np.array([1]), (model,), np.array([params]), np.array([640]), np.array([480]))
    scene = Scene.from_images(
        table, ["query"], [0], pose[None],
        points=Points.at(xyz), lines=own,
        point_observations=PointObservations.numbered(np.zeros(points, int), np.arange(points), pixels, sigma),
        line_observations=LineObservations(np.zeros(lines, int), np.arange(lines), ends, line_sigma),
    )  # fmt: skip
    camera = cameras.model(model), np.array(params)
    made = one_image_problem(camera, pose, (pixels, xyz, sigma), (ends, own.plucker, line_sigma))
    expected = assemble(scene, OPTIONS).problem
    assert made.variables.keys() == expected.variables.keys()
    for name, group in expected.variables.items():
        np.testing.assert_array_equal(made.variables[name].state, group.state)
        assert made.variables[name].constant == group.constant
        assert type(made.variables[name].manifold) is type(group.manifold)
    assert [type(factor) for factor in made.factors] == [type(factor) for factor in expected.factors]
    for ours, theirs in zip(made.factors, expected.factors, strict=True):
        for field in fields(theirs):
            one, other = getattr(ours, field.name), getattr(theirs, field.name)
            if isinstance(other, Ref):
                assert one.group == other.group
                np.testing.assert_array_equal(one.index, other.index)
            elif isinstance(other, np.ndarray):
                np.testing.assert_array_equal(one, other)
            else:
                assert one == other
