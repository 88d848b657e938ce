# SPDX-License-Identifier: BSD-3-Clause
"""Photographs that do not show the points of a model are refused before anything is mapped or described."""

from __future__ import annotations

import numpy as np
import pytest

from groma.errors import InputError
from groma.evaluation import cabinet
from groma.geometry import quaternion
from groma.io import read_scene
from groma.localization.localizer import Localizer
from groma.mapping.shown import check_points_shown


@pytest.fixture(scope="module")
def model():
    return read_scene(cabinet.folder() / "model")


@pytest.fixture(scope="module")
def files(model):
    return [cabinet.folder() / "images" / name for name in model.images.names]


def test_the_photographs_of_a_model_are_accepted(model, files):
    check_points_shown(model, files)


def test_other_photographs_with_the_names_of_a_model_are_refused(model, files, tmp_path):
    others = np.random.default_rng(0).permutation(files)
    with pytest.raises(InputError, match=r"do not show the points of the model: .* pass those that the model was made"):
        check_points_shown(model, list(others))
    for name, other in zip(model.images.names, others, strict=True):
        (tmp_path / name).write_bytes(other.read_bytes())
    with pytest.raises(InputError, match="do not show the points of the model"):
        Localizer(model, tmp_path)


@pytest.mark.parametrize("kept", [1, 2])
def test_nothing_is_said_where_images_share_too_few_points(model, files, kept):
    few = model.subset(range(kept)).keep(points=range(3))
    check_points_shown(few, files[:kept])


def test_images_turned_against_each_other_are_not_compared(model, files):
    """Places are described upright, so that a turned photograph of the same place looks like another."""
    turned = model.cam_from_world.copy()
    quarter = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    turned[1::2, :4] = quaternion.multiply(np.broadcast_to(quarter, turned[1::2, :4].shape), turned[1::2, :4])
    pair = model.with_poses(turned).subset([0, 1])
    check_points_shown(pair, [files[5], files[20]])
