# SPDX-License-Identifier: BSD-3-Clause
"""Models of points: which of several in a folder is read, and a reconstruction that needs a second try."""

from itertools import combinations

import numpy as np
import pytest

from groma.errors import FileFormatError, InputError
from groma.io import read_colmap, to_pycolmap, write_colmap
from groma.io.colmap import mappers
from groma.io.colmap import sfm as colmap_sfm
from groma.io.colmap.load import load_pycolmap, opened
from groma.io.colmap.pairs import blocks_of_pairs, pair_blocks
from groma.io.colmap.sfm import PointModelOptions, reconstruct_points
from groma.scene.synthetic.scenes import holistic


@pytest.mark.parametrize("form", ["binary", "text"])
def test_of_several_models_the_one_with_most_images_is_read(tmp_path, form):
    scene = holistic(6, seed=0).start.points_only()
    (tmp_path / "sparse").mkdir()
    for number, count in ((0, 2), (1, 5), (10, 3)):
        write_colmap(scene.subset(range(count)), tmp_path / "sparse" / str(number), form)
    (tmp_path / "sparse" / "2").mkdir()  # no model
    with pytest.warns(UserWarning, match=r"images \(5, in sparse.1\) is read, the others \(3, 2 images\) are not"):
        assert read_colmap(tmp_path).num_images == 5
    with pytest.warns(UserWarning, match=r"images \(5, in 1\) is read, the others \(3, 2 images\) are not"):
        assert read_colmap(tmp_path / "sparse").num_images == 5
    assert read_colmap(tmp_path / "sparse" / "0").num_images == 2


def test_a_model_that_lacks_a_file_is_named_beside_whole_ones(tmp_path):
    scene = holistic(6, seed=0).start.points_only()
    (tmp_path / "sparse").mkdir()
    for number, count in ((0, 6), (1, 3)):
        write_colmap(scene.subset(range(count)), tmp_path / "sparse" / str(number))
    (tmp_path / "sparse" / "0" / "images.bin").unlink()
    with pytest.warns(UserWarning, match=r"a further model that is not read, since sparse.0.images\.bin is missing"):
        assert read_colmap(tmp_path).num_images == 3
    (tmp_path / "sparse" / "1" / "images.bin").unlink()
    with pytest.raises(FileFormatError, match=r"sparse.0.images\.bin, sparse.1.images\.bin are missing"):
        read_colmap(tmp_path)
    with pytest.raises(FileFormatError, match=r"holds no COLMAP model: .* images\.bin is missing"):
        read_colmap(tmp_path / "sparse" / "1")


@pytest.fixture
def without_images(monkeypatch):
    """Reconstruction whose features and matches are those already in the database: none."""
    for name in ("_enter_images", "find_features", "match_pairs", "places_by_gps"):
        monkeypatch.setattr(colmap_sfm, name, lambda *arguments: None)


def test_a_first_pair_of_narrow_angle_is_the_second_try(tmp_path, monkeypatch, without_images):
    scene, tried = holistic(6, seed=0).start.points_only(), []

    def reconstruct(task, options, say):
        tried.append(options.mapper.init_min_tri_angle)
        return [to_pycolmap(scene)] if tried[-1] == mappers.GATES.first_angles[-1] else []

    monkeypatch.setattr(mappers, "_incremental", reconstruct)
    found = reconstruct_points(tmp_path, tmp_path, scene.images.names, PointModelOptions(threads=1))
    assert found.num_images == 6 and tried == list(mappers.GATES.first_angles)


def test_where_few_images_are_placed_the_focal_length_is_held_first(tmp_path, monkeypatch, without_images):
    scene, held = holistic(6, seed=0).start.points_only(), []

    def reconstruct(task, options, say):
        held.append(not options.ba_refine_focal_length and not options.mapper.abs_pose_refine_focal_length)
        return [to_pycolmap(scene if held[-1] else scene.subset([0, 1]))]

    monkeypatch.setattr(mappers, "_incremental", reconstruct)
    found = reconstruct_points(tmp_path, tmp_path, scene.images.names, PointModelOptions(threads=1))
    assert found.num_images == 6 and held == [False, True]
    assert (found.cameras.params[:, 0] != scene.cameras.params[:, 0]).any()  # estimated at the end
    camera = scene.cameras.params_of(0)
    options = PointModelOptions(scene.cameras.models[0], tuple(camera), threads=1)
    assert np.array_equal(
        reconstruct_points(tmp_path, tmp_path, scene.images.names, options).cameras.params, scene.cameras.params
    )
    with pytest.raises(InputError, match="one of incremental, global; got 'fast'"):
        PointModelOptions(mapper="fast")


def test_of_many_images_neighbours_in_space_are_matched_too():
    count = 200
    places = np.stack([np.arange(count) % 100, np.zeros(count), np.zeros(count)], axis=1)
    pairs = {pair for block in blocks_of_pairs(count, places.astype(float)) for pair in block}
    by_name = {pair for block in pair_blocks(count) for pair in block}
    assert by_name < pairs and (3, 103) in pairs - by_name  # the same place, a hundred images later
    away = np.where(np.arange(count)[:, None] < 100, [[0.0, 0.0, 1.0]], [[0.0, 0.0, -1.0]])
    assert (3, 103) not in {pair for block in blocks_of_pairs(count, places.astype(float), away) for pair in block}
    assert {pair for block in blocks_of_pairs(9) for pair in block} == set(combinations(range(9), 2))


def test_what_is_said_without_a_model_depends_on_what_is_missing(tmp_path, monkeypatch, without_images):
    monkeypatch.setattr(mappers, "_incremental", lambda *arguments: [])
    with pytest.raises(InputError, match="show no texture"):
        reconstruct_points(tmp_path, tmp_path, ["a.png", "b.png", "c.png"])
    assert "overlap too little" in colmap_sfm._why_none(5000, 200, 9, 2)
    assert "the camera only turned" in colmap_sfm._why_none(70_000, 70_000, 9, 9)
    assert "No 3 of them are linked" in colmap_sfm._why_none(44_258, 513, 4, 2)


def test_all_images_that_pycolmap_cannot_read_are_named_at_once(tmp_path):
    names = [f"{letter}.webp" for letter in "abc"]
    for name in names:
        (tmp_path / name).write_bytes(b"no image")
    with pytest.raises(InputError, match=rf"cannot read 3 images in .*: {', '.join(names)}\. Convert"):
        reconstruct_points(tmp_path, tmp_path / "work", names)


def test_images_are_linked_by_pairs_of_many_matches(tmp_path):
    pycolmap = load_pycolmap()
    with opened(pycolmap, tmp_path / "database.db") as content:
        camera = content.write_camera(pycolmap.Camera(model="SIMPLE_PINHOLE", width=9, height=9, params=[9, 4, 4]))
        one, two, three, four = (
            content.write_image(pycolmap.Image(name=name, camera_id=camera)) for name in ("a", "b", "c", "d")
        )
        for pair, count in (((one, two), 348), ((three, four), 120), ((two, four), 56)):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.tile(np.arange(count, dtype=np.uint32)[:, None], 2)
            content.write_two_view_geometry(*pair, geometry)
        assert colmap_sfm._most_linked(pycolmap, content) == 2
        geometry.inlier_matches = np.tile(np.arange(100, dtype=np.uint32)[:, None], 2)
        content.write_two_view_geometry(one, three, geometry)
        assert colmap_sfm._most_linked(pycolmap, content) == 4
