# SPDX-License-Identifier: BSD-3-Clause
"""What tests of commands share: small scenes in files, and an empty folder to work in."""

import pytest

from groma.io import write_scene
from groma.scene import synthetic


@pytest.fixture(scope="session")
def scenes(tmp_path_factory):
    """A folder with truth.npz, start.npz (points, lines, planes) and points.npz (the same start, points alone)."""
    folder = tmp_path_factory.mktemp("scenes")
    made = synthetic.holistic(6, seed=3)
    write_scene(made.truth, folder / "truth.npz")
    write_scene(made.start, folder / "start.npz")
    write_scene(made.start.points_only(), folder / "points.npz")
    return folder


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path
