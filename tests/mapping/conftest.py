# SPDX-License-Identifier: BSD-3-Clause
"""A model without photographs, and the photographs of a house corner."""

import pytest
from _facade import facade

from groma.io import write_scene
from groma.scene.synthetic.scenes import holistic


@pytest.fixture
def model():
    return holistic(4, seed=0).start.points_only()


@pytest.fixture(scope="session")
def corner(tmp_path_factory):
    """A folder with the photographs of a house corner, and their model."""
    folder = tmp_path_factory.mktemp("corner") / "images"
    scene = facade(folder, 4)
    write_scene(scene, folder.parent / "model.npz")
    return folder, scene
