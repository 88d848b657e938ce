# SPDX-License-Identifier: BSD-3-Clause
"""Masks of photographs: found by name, and nothing is found where they are black."""

import shutil
from contextlib import suppress

import cv2
import numpy as np
import pycolmap
import pytest

from groma.cli.main import run
from groma.errors import FileFormatError, InputError
from groma.evaluation import cabinet
from groma.features.registry import DETECTORS
from groma.io import read_scene
from groma.io.colmap.masks import Masks
from groma.io.colmap.sfm import PointModelOptions, reconstruct_points
from groma.mapping.image_segments import check_masks, detect_segments

NAMES = ["0024.jpg", "0026.jpg"]
SIZE = (640, 480)


def quiet(stage, done, total):
    pass


def right_half(width=SIZE[0], height=SIZE[1]):
    mask = np.zeros((height, width), np.uint8)
    mask[:, width // 2 :] = 1
    return mask


@pytest.fixture
def masks(tmp_path):
    (tmp_path / "masks").mkdir()
    for name in NAMES:
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), right_half())
    return Masks.of(tmp_path / "masks", NAMES)


@pytest.mark.parametrize("form", ["a/b.jpg.png", "a/b.png", "a/b_mask.png", "b.jpg.png", "b_mask.png"])
def test_masks_are_found_by_the_names_of_photographs(form, tmp_path):
    (tmp_path / form).parent.mkdir(exist_ok=True)
    cv2.imwrite(str(tmp_path / form), right_half(8, 4))
    found = Masks.of(tmp_path, ["a/b.jpg", "a/other.jpg"])
    assert found.file_of == {"a/b.jpg": tmp_path / form}
    np.testing.assert_array_equal(found.read("a/b.jpg", (8, 4)), right_half(8, 4) > 0)
    assert found.read("a/other.jpg", (8, 4)) is None
    # At twice the resolution of the mask each pixel is four.
    np.testing.assert_array_equal(found.read("a/b.jpg", (16, 8)), right_half(16, 8) > 0)
    with pytest.raises(FileFormatError, match="8x4 pixels, its photograph 4x8"):
        found.read("a/b.jpg", (4, 8))


def test_flat_masks_of_photographs_with_one_name_in_two_folders_are_not_guessed(tmp_path):
    cv2.imwrite(str(tmp_path / "b.png"), right_half(8, 4))
    with pytest.raises(InputError, match="a mask of none of the 2 photographs; it holds 'b"):
        Masks.of(tmp_path, ["left/b.jpg", "right/b.jpg"])
    with pytest.raises(InputError, match="not a folder of masks, nor a mask"):
        Masks.of(tmp_path / "none.png", ["left/b.jpg"])


def test_a_file_is_the_mask_of_all_photographs(tmp_path):
    cv2.imwrite(str(tmp_path / "b.png"), right_half(8, 4))
    found = Masks.of(tmp_path / "b.png", ["left/b.jpg", "right/b.jpg"])
    for name in ("left/b.jpg", "right/b.jpg"):
        np.testing.assert_array_equal(found.read(name, (8, 4)), right_half(8, 4) > 0)


def test_black_of_jpeg_is_inexact(tmp_path):
    cv2.imwrite(str(tmp_path / "b.jpg"), right_half(64, 48) * 255, [cv2.IMWRITE_JPEG_QUALITY, 30])
    np.testing.assert_array_equal(Masks.of(tmp_path, ["b.jpg"]).read("b.jpg", (64, 48)), right_half(64, 48) > 0)


def test_no_point_is_found_where_a_mask_is_black(masks, tmp_path):
    with suppress(InputError):  # two photographs need not give a model
        reconstruct_points(cabinet.folder() / "images", tmp_path / "work", NAMES, PointModelOptions(masks=masks))
    with pycolmap.Database.open(tmp_path / "work" / "database.db") as content:
        found = [content.read_keypoints(image.image_id) for image in content.read_all_images()]
    for keypoints in found:
        assert len(keypoints) > 20 and keypoints[:, 0].min() >= SIZE[0] // 2


def test_no_segment_is_found_where_a_mask_is_black(masks):
    scene = read_scene(cabinet.folder() / "model")
    rows = [list(scene.images.names).index(name) for name in NAMES]
    detector = DETECTORS.make("lsd", min_length=12.0, max_segments=0)
    scene, photographs = scene.subset(rows), cabinet.folder() / "images"
    every, found = (detect_segments(photographs, scene, detector, quiet, given) for given in (None, masks))
    for whole, half in zip(every, found, strict=True):
        assert whole.ends[:, [0, 2]].min() < SIZE[0] // 2 - 50
        # Nor along its border, which is no edge.
        assert len(half) > 10 and half.ends[:, [0, 2]].min() >= SIZE[0] // 2 + 2


def test_what_masks_leave_out_is_told(masks):
    sizes = dict.fromkeys(NAMES, SIZE)
    assert check_masks(masks, sizes, quiet) == ["Masks leave out 50 % of 2 photographs."]
    assert check_masks(masks, sizes | {"0028.jpg": SIZE}, quiet)[0].endswith("of 2 photographs; 1 have none.")
    assert check_masks(None, sizes, quiet) == []
    for _, path, _ in masks.files:
        cv2.imwrite(str(path), np.zeros(SIZE[::-1], np.uint8))
    with pytest.raises(InputError, match="all black"):
        check_masks(masks, sizes, quiet)


def test_command_refuses_masks_of_other_photographs(tmp_path, capsys):
    for folder in ("images", "masks"):
        (tmp_path / folder).mkdir()
    for number in range(24, 27):
        shutil.copy(cabinet.folder() / "images" / f"{number:04d}.jpg", tmp_path / "images")
    cv2.imwrite(str(tmp_path / "masks" / "other.png"), right_half())
    assert run(["map", str(tmp_path / "images"), "--masks", str(tmp_path / "masks"), "-o", str(tmp_path / "out")]) == 1
    assert "has a mask of none of the 3 photographs" in capsys.readouterr().err
