# SPDX-License-Identifier: BSD-3-Clause
"""Sequences from strangers: names that leave the folder, words and numbers without end, images too large."""

import shutil

import numpy as np
import pytest
from _sequences import image

from groma.errors import FileFormatError
from groma.io.sequences import open_sequence


@pytest.mark.parametrize("name", ["../x.png", "/etc/x.png", "rgb/../../x.png", "a\0b.png"])
def test_names_that_leave_the_folder_are_refused(tmp_path, name):
    image(tmp_path / "s/rgb/0.png", 3, (32, 24))
    (tmp_path / "s/camera.txt").write_text("30 30 16 12")
    (tmp_path / "s/rgb.txt").write_text(f"# list\n0 rgb/0.png\n1 {name}\n")
    with pytest.raises(FileFormatError, match=r"rgb\.txt, line 3: expected the name of a file"):
        open_sequence(tmp_path / "s")
    (tmp_path / "s/associations.txt").write_text(f"0 rgb/0.png 0 {name}\n")
    with pytest.raises(FileFormatError, match=r"associations\.txt, line 1: expected the name of a file"):
        open_sequence(tmp_path / "s")


def test_an_image_of_euroc_outside_is_refused(euroc):
    table = euroc[0] / "mav0/cam0/data.csv"
    table.write_text(table.read_text().replace("\n1", "\n5,../../../x.png\n1", 1))
    with pytest.raises(FileFormatError, match=r"data\.csv, line 2: expected the name of a file"):
        open_sequence(euroc[0])


def test_a_long_word_in_a_calibration_takes_no_time(euroc):
    sensor = euroc[0] / "mav0/cam0/sensor.yaml"
    good = open_sequence(euroc[0]).camera
    # A quadratic search would take minutes.
    sensor.write_text(sensor.read_text() + "a" * 500_000 + "\n" + "a:[" * 100_000 + "\n")
    np.testing.assert_array_equal(open_sequence(euroc[0]).camera.params, good.params)


def test_a_huge_number_of_a_frame_takes_no_memory(kitti):
    (kitti / "times.txt").unlink()
    source = next((kitti / "image_0").iterdir())
    shutil.copy(source, kitti / "image_0/99999999999999.png")
    sequence = open_sequence(kitti)
    assert [frame.timestamp for frame in sequence][-1] == pytest.approx(9999999999999.9)


def test_an_image_too_large_is_skipped_and_named(tmp_path):
    image(tmp_path / "0.png", 3, (32, 24))
    content = (tmp_path / "0.png").read_bytes()
    (tmp_path / "1.png").write_bytes(content[:16] + (70_000).to_bytes(4, "big") * 2 + content[24:])
    (tmp_path / "camera.txt").write_text("30 30 16 12")
    sequence = open_sequence(tmp_path)
    assert len(list(sequence)) == 1
    assert any("1.png: its header promises 70000x70000 pixels" in words for words in sequence.warnings)


@pytest.mark.parametrize("text", ["30 " + "1" * 4000, "1" * 5000])
def test_text_too_long_for_a_file_name_is_no_calibration(tmp_path, text):
    image(tmp_path / "s/rgb/0.png", 3, (32, 24))
    (tmp_path / "s/rgb.txt").write_text("0 rgb/0.png\n")
    with pytest.raises(FileFormatError, match=r"cannot be read as a calibration: .*1111|File name too long"):
        open_sequence(tmp_path / "s", camera=text)
