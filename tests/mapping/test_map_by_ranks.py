"""``groma map`` by processes that mpiexec started together: the same map as by one, and wrong use told once."""

import sys

import numpy as np
import pytest
from _mpi import mpiexec, needs_mpi

import groma
from groma.cli.main import run


@needs_mpi
@pytest.mark.parametrize("cluster_size", ["0", "2"])
def test_ranks_map_what_one_process_maps(corner, tmp_path, cluster_size):
    folder = corner[0]
    arguments = ["map", str(folder), "--model", str(folder.parent / "model.npz"), "--no-diagnosis", "--threads", "1"]
    arguments += ["--cluster-size", cluster_size]
    assert run([*arguments, "-o", str(tmp_path / "one"), "-q"]) == 0
    said = mpiexec(*[["-m", "groma", *arguments, "-o", tmp_path / "two"]] * 2)
    assert said.returncode == 0, said.stderr
    assert said.stdout.count("Wrote") == 1
    one, two = (groma.read_scene(tmp_path / name / "scene.npz") for name in ("one", "two"))
    assert one.num_lines > 10
    for table, column in (("lines", "plucker"), ("line_observations", "segment"), ("points", "xyz")):
        np.testing.assert_array_equal(getattr(getattr(two, table), column), getattr(getattr(one, table), column))


@needs_mpi
def test_what_goes_wrong_is_told_once_and_all_end(corner, tmp_path):
    folder = corner[0]
    output = ["-o", tmp_path / "x"]
    for arguments, words in (
        ([folder.parent / "nowhere", *output], "Cannot read"),
        ([folder, "--model", folder.parent / "nowhere.npz", *output], "Cannot read"),
    ):
        said = mpiexec(*[["-m", "groma", "map", *arguments]] * 2)
        assert said.returncode == 1
        assert len(said.stderr.splitlines()) == 1 and words in said.stderr
    assert not (tmp_path / "x").exists()


def test_ranks_without_mpi4py_end_and_one_says_why(corner, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    monkeypatch.setenv("PMI_SIZE", "2")
    for rank, words in (("0", 'pip install "groma[mpi]"'), ("1", "")):
        monkeypatch.setenv("PMI_RANK", rank)
        assert run(["map", str(corner[0]), "-o", str(tmp_path / "x")]) == 1
        error = capsys.readouterr().err
        assert words in error and len(error.splitlines()) == (rank == "0")
