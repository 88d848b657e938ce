# SPDX-License-Identifier: BSD-3-Clause
"""Writing results: complete or not at all, never over what is there, JSON that every reader accepts."""

import json
import os

import numpy as np
import pytest

from groma.cli._output import atomic_output, check_json, check_output, plain, write_json
from groma.errors import OutputError


def test_a_file_appears_when_the_block_ends_well(tmp_path):
    with atomic_output(tmp_path / "a.txt", force=False) as draft:
        draft.write_text("new")
        assert not (tmp_path / "a.txt").exists()
    assert (tmp_path / "a.txt").read_text() == "new"
    assert os.listdir(tmp_path) == ["a.txt"]


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


def test_force_does_not_replace_a_folder_with_other_things(tmp_path):
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis.tex").write_text("years of work")
    with pytest.raises(OutputError, match=r"thesis\.tex"):
        check_output(tmp_path / "home", force=True)


def test_missing_parent(tmp_path):
    with pytest.raises(OutputError, match="does not exist"):
        check_output(tmp_path / "no" / "a.txt", force=False)


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
