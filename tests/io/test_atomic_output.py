# SPDX-License-Identifier: BSD-3-Clause
"""Files and folders appear whole or not at all; nothing is replaced unasked; nothing is left behind."""

import os

import pytest

from groma.errors import OutputError
from groma.io import atomic_output, write_scene
from groma.scene import Scene


def test_file_and_folder_appear(tmp_path):
    with atomic_output(tmp_path / "a.txt") as draft:
        draft.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    with atomic_output(tmp_path / "folder") as draft:
        (draft / "deep").mkdir(parents=True)
        (draft / "deep" / "b.txt").write_text("b")
    assert (tmp_path / "a.txt").read_text() == "new"
    assert (tmp_path / "folder" / "deep" / "b.txt").read_text() == "b"
    assert sorted(os.listdir(tmp_path)) == ["a.txt", "folder"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, OutputError])
@pytest.mark.parametrize("force", [False, True])
def test_nothing_is_left_after_an_exception(tmp_path, error, force):
    if force:
        (tmp_path / "a").write_text("old")
    with pytest.raises(error), atomic_output(tmp_path / "a", force=force) as draft:
        draft.write_text("half")
        raise error
    assert os.listdir(tmp_path) == (["a"] if force else [])
    assert not force or (tmp_path / "a").read_text() == "old"


def test_existing_is_refused_or_replaced(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "old").write_text("old")
    with pytest.raises(OutputError, match="exists already"), atomic_output(tmp_path / "folder"):
        pass
    with atomic_output(tmp_path / "folder", force=True) as draft:
        draft.mkdir()
        (draft / "new").write_text("new")
    assert os.listdir(tmp_path / "folder") == ["new"]
    with atomic_output(tmp_path / "folder", force=True) as draft:
        draft.write_text("now a file")
    assert (tmp_path / "folder").read_text() == "now a file"
    assert os.listdir(tmp_path) == ["folder"]


def test_unwritable_places_are_known_errors(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="Cannot write"):
        write_scene(Scene(), tmp_path / "file" / "a.npz")
    with pytest.raises(OutputError, match="Nothing was written"), atomic_output(tmp_path / "b"):
        pass
    assert os.listdir(tmp_path) == ["file"]
