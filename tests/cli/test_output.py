# SPDX-License-Identifier: BSD-3-Clause
"""Writing results: complete or not at all, never over what is there, JSON that every reader accepts."""

import json
import os
from pathlib import Path

import numpy as np
import pytest

from groma.bounded.json_text import plain
from groma.cli.main import run
from groma.cli.shared.output import (
    atomic_output,
    check_json,
    check_output,
    check_outputs,
    subject,
    work_folder,
    write_json,
)
from groma.errors import OutputError


def test_a_file_appears_when_the_block_ends_well(tmp_path):
    with atomic_output(tmp_path / "a.txt", force=False) as draft:
        draft.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "new"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_an_error_names_the_result_and_not_its_draft(tmp_path):
    with (
        pytest.raises(OutputError, match=f"^Cannot write {tmp_path}/page.html: No space left on device. Choose"),
        atomic_output(tmp_path / "page.html", force=False) as draft,
    ):
        raise OutputError(f"Cannot write {draft}: No space left on device. Choose another place.")


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError, OutputError])
def test_nothing_is_left_when_it_does_not(tmp_path, error):
    with pytest.raises(error), atomic_output(tmp_path / "model", force=False) as draft:
        draft.mkdir()
        (draft / "cameras.bin").write_text("half")
        raise error
    assert os.listdir(tmp_path) == []


def test_what_is_there_stays_when_the_block_fails(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(RuntimeError), atomic_output(tmp_path / "a.txt", force=True) as draft:
        draft.write_text("new")
        raise RuntimeError
    assert (tmp_path / "a.txt").read_text() == "old"


def test_force_is_needed_to_replace(tmp_path):
    (tmp_path / "a.txt").write_text("old")
    with pytest.raises(OutputError, match="--force"):
        check_output(tmp_path / "a.txt", force=False)
    with atomic_output(tmp_path / "a.txt", force=True) as draft:
        draft.write_text("new")
    assert (tmp_path / "a.txt").read_text() == "new"


def test_force_replaces_a_result_folder(tmp_path):
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "points3D.bin").write_text("old")
    with atomic_output(tmp_path / "model", force=True) as draft:
        draft.mkdir()
        (draft / "cameras.bin").write_text("new")
    assert os.listdir(tmp_path / "model") == ["cameras.bin"]
    assert os.listdir(tmp_path) == ["model"]


@pytest.mark.parametrize("name", [".", "..", "../here"])
def test_the_folder_that_one_is_in_is_not_replaced(tmp_path, monkeypatch, name):
    """The shell would stand in a folder that is gone, and beside ``.`` there is no name for the finished stages."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with pytest.raises(OutputError, match="the folder that you are in"):
        check_output(Path(name), force=True)
    assert run(["synth", "-o", name, "-n", "2", "--force"]) == 1
    assert os.listdir(tmp_path) == ["here"] and os.listdir() == []


def test_finished_work_is_not_kept_in_a_folder_of_somebody_else(tmp_path):
    output, folder = tmp_path / "out", tmp_path / "out.work"
    assert work_folder(output) == folder
    folder.mkdir()
    assert work_folder(output) == folder
    for name in ("scene.npz", "now.npz"):  # of a track that was killed
        (folder / name).write_text("")
    assert work_folder(output) == folder
    (folder / "thesis.tex").write_text("")
    with pytest.raises(OutputError, match=r"out\.work is where finished work is kept .* Move it away"):
        work_folder(output)
    (folder / "lock").write_text("1\n")  # of a map, or of localised photographs
    assert work_folder(output) == folder
    (tmp_path / "file.work").write_text("")
    with pytest.raises(OutputError, match="Move it away"):
        work_folder(tmp_path / "file")


def test_force_does_not_replace_a_folder_with_other_things(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        check_output(tmp_path / "home", force=True)


@pytest.mark.parametrize("name", ["notes.txt", "mine.npz", "database.db", "sparse"])
def test_force_knows_the_files_of_results_by_name(tmp_path, name):
    (tmp_path / "cameras.bin").touch()
    check_output(tmp_path, force=True)
    (tmp_path / name).touch()
    with pytest.raises(OutputError, match=name):
        check_output(tmp_path, force=True)


def test_force_replaces_a_track_in_parts(tmp_path):
    for name in ("submap_2", "submap_13", "part_2", "structures"):
        (tmp_path / "track" / name).mkdir(parents=True)
    for name in ("trajectory.txt", "scene.npz", "summary.json", "report.html", "rigs.bin", "lines.obj", "planes.ply"):
        (tmp_path / "track" / name).touch()
    check_output(tmp_path / "track", force=True)


def test_a_file_never_replaces_a_folder(tmp_path):
    """A page named like the folder of a map would cost the map."""
    (tmp_path / "map").mkdir()
    (tmp_path / "map" / "cameras.bin").touch()
    with pytest.raises(OutputError, match="is a folder"):
        check_outputs(True, tmp_path / "map", file=True)
    with pytest.raises(OutputError, match="is a folder"):
        check_outputs(True, None, tmp_path / "map")


def test_two_results_of_one_name_are_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    check_outputs(False, Path("a"), Path("b"), None, json_target="c")
    for words in ({"json_target": "a"}, {"json_target": str(tmp_path / "a")}):
        with pytest.raises(OutputError, match="two results"):
            check_outputs(True, Path("a"), Path("b"), **words)
    with pytest.raises(OutputError, match="two results"):
        check_outputs(False, Path("a"), Path("b"), Path("b"))
    assert os.listdir(tmp_path) == []


def test_devices_are_not_replaced(tmp_path):
    """``--json /dev/stdout --force`` would put a file in place of the device."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OutputError, match="device or a pipe"):
        check_output(tmp_path / "pipe", force=True)


def test_a_folder_where_nothing_can_be_made(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    with pytest.raises(OutputError, match=r"nothing can be made .* \(Read-only file system\)"):
        check_output(tmp_path / "a.txt", force=False)


def test_missing_folders_are_made_when_something_is_written(tmp_path):
    path = tmp_path / "no" / "folder" / "a.txt"
    check_outputs(False, path)
    assert os.listdir(tmp_path) == []
    with atomic_output(path, force=False) as draft:
        draft.write_text("a")
    assert path.read_text() == "a"
    with pytest.raises(OutputError, match=r"a\.txt is a file"):
        check_output(path / "further" / "b.txt", force=False)


def test_writing_nothing_is_an_error(tmp_path):
    with pytest.raises(OutputError, match="Nothing was written"), atomic_output(tmp_path / "a", force=False):
        pass
    assert os.listdir(tmp_path) == []


def test_json(tmp_path, capsys):
    content = {
        "a": np.float64(1.5),
        "b": np.arange(3),
        "c": float("nan"),
        "d": {1: np.int32(2)},
        "e": np.inf,
        "f": None,
    }
    expected = {"a": 1.5, "b": [0, 1, 2], "c": None, "d": {"1": 2}, "e": None, "f": None}
    write_json(str(tmp_path / "r.json"), content)
    assert json.loads((tmp_path / "r.json").read_text()) == expected
    write_json("-", content)
    assert json.loads(capsys.readouterr().out) == expected
    write_json(None, content)
    assert capsys.readouterr().out == ""


def test_json_of_truth_values_and_other_things():
    assert plain({"yes": np.bool_(True), "path": os, "t": (1, "x")})["yes"] is True


def test_json_target_is_checked_early(tmp_path):
    check_json("-", force=False)
    check_json(None, force=False)
    with pytest.raises(OutputError, match="folder"):
        check_json(str(tmp_path), force=True)
    (tmp_path / "r.json").write_text("{}")
    with pytest.raises(OutputError, match="--force"):
        check_json(str(tmp_path / "r.json"), force=False)


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("castle/images", "castle"),
        ("castle/sparse/0", "castle"),
        ("castle/dense/sparse", "castle"),
        ("castle", "castle"),
        ("castle/photos/day_2", "day_2"),
        ("kitti/sequences/00", "00"),
        ("problem-49.txt.bz2", "problem-49.txt.bz2"),
        ("/images", "images"),
        ("x/..", "here"),
    ],
)
def test_a_heading_names_the_project_and_not_a_folder_that_every_project_has(path, name, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert subject(Path(path)) == name
