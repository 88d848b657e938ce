"""``groma map`` by processes that mpiexec started together: the same map as by one, and wrong use told once."""

import sys

import numpy as np
import pytest
from _mpi import commands, needs_mpi

import groma
from groma.cli.main import run

SIZES = ["0", "2"]


def mapping(corner, cluster_size, output):
    folder = corner[0]
    options = ["--model", folder.parent / "model.npz", "--no-diagnosis", "--threads", "1"]
    return [str(word) for word in ("map", folder, *options, "--cluster-size", cluster_size, "-o", output)]


@pytest.fixture(scope="module")
def by_two(corner, tmp_path_factory):
    """A folder, and what two ranks said that mapped twice and twice were told what is not there, in one start."""
    output, (folder, _) = tmp_path_factory.mktemp("ranks"), corner
    wrong = [
        ["map", folder.parent / "nowhere", "-o", output / "x"],
        ["map", folder, "--model", folder.parent / "nowhere.npz", "-o", output / "x"],
    ]
    return output, commands(*[[*(mapping(corner, size, output / size) for size in SIZES), *wrong]] * 2)


@needs_mpi
@pytest.mark.parametrize("cluster_size", SIZES)
def test_ranks_map_what_one_process_maps(corner, by_two, tmp_path, cluster_size):
    assert run([*mapping(corner, cluster_size, tmp_path / "one"), "-q"]) == 0
    code, said, complaint = by_two[1][SIZES.index(cluster_size)]
    assert code == 0, complaint
    assert said.count("Wrote") == 1
    one, two = (groma.read_scene(folder / "scene.npz") for folder in (tmp_path / "one", by_two[0] / cluster_size))
    assert one.num_lines > 10
    for table, column in (("lines", "plucker"), ("line_observations", "segment"), ("points", "xyz")):
        np.testing.assert_array_equal(getattr(getattr(two, table), column), getattr(getattr(one, table), column))


@needs_mpi
def test_what_goes_wrong_is_told_once_and_all_end(by_two):
    for code, _, said in by_two[1][len(SIZES) :]:
        assert code == 1
        assert len(said.splitlines()) == 1 and "Cannot read" in said
    assert not (by_two[0] / "x").exists()


def test_ranks_without_mpi4py_end_and_one_says_why(corner, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    monkeypatch.setenv("PMI_SIZE", "2")
    for rank, words in (("0", 'pip install "groma[mpi]"'), ("1", "")):
        monkeypatch.setenv("PMI_RANK", rank)
        assert run(["map", str(corner[0]), "-o", str(tmp_path / "x")]) == 1
        error = capsys.readouterr().err
        assert words in error and len(error.splitlines()) == (rank == "0")
