# SPDX-License-Identifier: BSD-3-Clause
"""Names of images in one file found in another: folders, letters and endings that differ, and files of one name."""

from groma._image_names import NOWHERE, SEVERAL, rows_by_name, tell_partly


def test_names_are_found_without_folder_and_ending():
    known = ("left/a.JPG", "left/b.jpg", "right/b.jpg", "c.png")
    wanted = ["A.jpg", "right\\b.jpg", "b.jpg", "c", "c.jpg", "d"]
    found = rows_by_name(wanted, known)
    assert found.tolist() == [0, 2, SEVERAL, 3, 3, NOWHERE]
    words = "p.csv: 3 names of images were found without folder or ending, such as A.jpg for left/a.JPG."
    assert tell_partly(found, wanted, known, "p.csv") == [words]
    assert tell_partly(found[1:3], wanted[1:3], known, "p.csv") == []


def test_a_folder_around_all_images_is_left_out_on_either_side():
    inside, around = ["left/1.png", "right/1.png"], ["./images/left/1.png", "./images/right/1.png"]
    assert rows_by_name(around, inside).tolist() == [0, 1]
    assert rows_by_name(inside, around).tolist() == [0, 1]
    assert rows_by_name([name.replace("png", "JPG") for name in around], inside).tolist() == [0, 1]


def test_files_of_one_name_in_two_folders_are_two():
    """Cameras number their files anew in every folder: the image of the second folder is not placed here."""
    wanted = ["100/1.jpg", "100/2.jpg", "101/1.jpg", "101/3.jpg"]
    assert rows_by_name(wanted, ["100/1.jpg", "100/2.jpg", "100/3.jpg"]).tolist() == [0, 1, NOWHERE, NOWHERE]
    assert rows_by_name(wanted, ["all/1.jpg", "all/2.jpg"]).tolist() == [SEVERAL, 1, SEVERAL, NOWHERE]


def test_folders_that_mean_nothing_may_differ():
    assert rows_by_name(["images_4/1.png", "images_4/2.JPG"], ["images/2.jpg", "images/1.jpg"]).tolist() == [1, 0]


def test_marks_name_one_image_many_times():
    assert rows_by_name(["x/1.jpg", "x/1.jpg", "x/1.jpg"], ["y/1.jpg"]).tolist() == [0, 0, 0]
