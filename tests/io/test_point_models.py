# SPDX-License-Identifier: BSD-3-Clause
"""Models of points: which of several in a folder is read, and a reconstruction that needs a second try."""

import pytest

from groma.errors import InputError
from groma.io import read_colmap, to_pycolmap, write_colmap
from groma.io.colmap import sfm as colmap_sfm
from groma.io.colmap.sfm import FIRST_PAIR_ANGLES, PointModelOptions, reconstruct_points
from groma.scene.synthetic.scenes import holistic


@pytest.mark.parametrize("form", ["binary", "text"])
def test_of_several_models_the_one_with_most_images_is_read(tmp_path, form):
    scene = holistic(6, seed=0).start.points_only()
    (tmp_path / "sparse").mkdir()
    for number, count in ((0, 2), (1, 5), (10, 3)):
        write_colmap(scene.subset(range(count)), tmp_path / "sparse" / str(number), form)
    (tmp_path / "sparse" / "2").mkdir()  # no model
    assert read_colmap(tmp_path).num_images == 5
    assert read_colmap(tmp_path / "sparse" / "0").num_images == 2


@pytest.fixture
def without_images(monkeypatch):
    """Reconstruction whose features and matches are those already in the database: none."""
    for name in ("_enter_images", "_find_features", "_match"):
        monkeypatch.setattr(colmap_sfm, name, lambda *arguments: None)


def test_a_first_pair_of_narrow_angle_is_the_second_try(tmp_path, monkeypatch, without_images):
    scene, tried = holistic(6, seed=0).start.points_only(), []

    def reconstruct(*arguments):
        tried.append(arguments[6])
        return [to_pycolmap(scene)] if arguments[6] == FIRST_PAIR_ANGLES[-1] else []

    monkeypatch.setattr(colmap_sfm, "_reconstruct", reconstruct)
    found = reconstruct_points(tmp_path, tmp_path, scene.images.names, PointModelOptions(threads=1))
    assert found.num_images == 6 and tried == list(FIRST_PAIR_ANGLES)


def test_what_is_said_without_a_model_depends_on_what_is_missing(tmp_path, monkeypatch, without_images):
    monkeypatch.setattr(colmap_sfm, "_reconstruct", lambda *arguments: [])
    with pytest.raises(InputError, match="show no texture"):
        reconstruct_points(tmp_path, tmp_path, ["a.png", "b.png", "c.png"])
    assert "overlap too little" in colmap_sfm._why_none(5000, 200, 9)
    assert "the camera only turned" in colmap_sfm._why_none(70_000, 70_000, 9)
