# SPDX-License-Identifier: BSD-3-Clause
"""Commands repeat the defaults of what they call, so that no help has to load it: they are the same."""

from __future__ import annotations

import importlib
import inspect
from typing import get_args

import pytest

from groma.cli.commands import evaluate
from groma.evaluation.gates import SCORES
from groma.io import trajectories
from groma.localization.localizer import LocalizeOptions
from groma.mapping.lines.options import MapLinesOptions
from groma.mapping.options import MapOptions
from groma.mapping.posed.register import register_photographs
from groma.scene import synthetic
from groma.tracking.options import TrackOptions


def _default(function, name):
    return inspect.signature(function).parameters[name].default


@pytest.mark.parametrize(
    ("command", "argument", "there"),
    [
        ("evaluate.planes", "max_angle", SCORES.plane_angle_deg),
        ("evaluate.trajectory", "max_time_difference", SCORES.time_difference),
        ("localize.localize", "min_length", LocalizeOptions().min_segment_length),
        ("map.map_", "min_length", MapOptions().min_segment_length),
        ("map.map_", "cluster_size", MapLinesOptions().cluster_size),
        ("map.map_", "max_iterations", MapOptions().max_iterations),
        ("synth.synth", "cameras", _default(synthetic.holistic, "num_images")),
        ("track.track", "max_depth", TrackOptions().max_depth),
    ],
)
def test_commands_have_the_defaults_of_what_they_call(command, argument, there):
    module, name = command.split(".")
    assert _default(getattr(importlib.import_module(f"groma.cli.commands.{module}"), name), argument) == there


def test_photographs_are_placed_with_the_steps_of_a_map():
    assert _default(register_photographs, "max_iterations") == MapOptions().max_iterations


def test_evaluate_takes_the_trajectory_formats_that_are_read():
    assert set(get_args(evaluate._Format)) == {"auto", *trajectories._FORMATS}
