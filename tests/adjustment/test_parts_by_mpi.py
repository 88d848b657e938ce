"""Parts that belong to several processes: the same bytes as by one, a rank that is killed, wrong use without a hang."""

import json
import os
import shutil
import signal
import sys

import pytest
from _mpi import commands, mpiexec, needs_mpi, same_bytes

import groma
from groma.adjustment.parts import adjust_parts, write_parts
from groma.cli.main import run
from groma.scene import synthetic
from groma.solver.options import SolverOptions
from groma.solver.reduce.mpi import started_as


@pytest.fixture(scope="module")
def parts(tmp_path_factory):
    folder = tmp_path_factory.mktemp("adjusted") / "parts"
    write_parts(synthetic.corridor("tiny").start, folder, observations=400)
    return folder


@pytest.fixture(scope="module")
def by_two(parts):
    """A folder, and what two ranks said of five commands in one start.

    Parts in two robust stages; parts that a rank cannot see or has none of; wrong options; other cameras.
    """
    home = parts.parent
    few, mixed = home / "few", home / "mixed"
    write_parts(groma.read_scene(parts / "part-00000.npz"), few)
    shutil.copytree(few, mixed)
    groma.write_scene(synthetic.corridor(13).start, mixed / "part-00001.npz")
    first = ["adjust", parts, "-o", home / "two", "--json", home / "two.json", "--threads", "1"]
    same = [
        ["adjust", few, "-o", home / "y", "--threads", "1", "-v"],
        ["adjust", mixed, "-o", home / "z", "--loss-scale", "-1", "--loss", "huber"],
        ["adjust", mixed, "-o", home / "z"],
    ]
    seen = [[first, ["adjust", folder, "-o", home / "x"], *same] for folder in (parts, home / "nowhere")]
    return home, commands(*seen)


@needs_mpi
def test_two_ranks_write_what_one_process_writes(parts, by_two, tmp_path):
    """Points and lines, in two robust stages."""
    assert run(["adjust", str(parts), "-o", str(tmp_path / "one"), "--threads", "1", "-q"]) == 0
    home, ((code, said, complaint), *_) = by_two
    assert code == 0, complaint
    assert said.count("Wrote") == said.count("steps in") == 1
    assert same_bytes(tmp_path / "one", home / "two")
    numbers = json.loads((home / "two.json").read_text())
    assert numbers["ranks"] == 2 and numbers["num_lines"] > 0 and len(numbers["stages"]) == 2
    cameras = groma.read_scene(tmp_path / "one" / "part-00000.npz").num_images
    blocks = cameras + cameras * (cameras - 1) // 2
    assert 0 < numbers["bytes_per_step"] <= 16 * (36 * blocks + 3 * 6 * cameras + 10)


@needs_mpi
def test_a_rank_is_killed_and_all_go_on(parts, tmp_path):
    options = SolverOptions(threads=1)
    adjust_parts(sorted(parts.iterdir()), tmp_path / "whole", options=options)
    assert mpiexec(*[[__file__, parts, tmp_path / "out"]] * 2).returncode != 0
    assert (tmp_path / "out" / ".checkpoint" / "state.npz").exists()
    said = mpiexec(*[[__file__, parts, tmp_path / "out", "on"]] * 2)
    assert said.returncode == 0, said.stderr
    assert same_bytes(tmp_path / "out", tmp_path / "whole")


@needs_mpi
def test_a_rank_that_fails_ends_all(parts, tmp_path):
    """In the middle of the work, while the other waits for its sum."""
    said = mpiexec(*[[__file__, parts, tmp_path / "out", "fail"]] * 2)
    assert said.returncode != 0
    assert "groma: rank 1 of 2: the disk is gone" in said.stderr and "Traceback" not in said.stderr


@needs_mpi
def test_what_is_wrong_for_some_rank_is_told_once(by_two):
    """Parts that a rank cannot see or has none of, wrong options, other cameras."""
    home, (_, *others) = by_two
    codes, _, (unseen, idle, option, other) = zip(*others, strict=True)
    assert codes == (1, 0, 1, 1)
    assert len(unseen.splitlines()) == 1 and unseen.startswith("groma: Rank 1 of 2: ")
    assert "that this process can see" in unseen and not (home / "x").exists()
    assert idle.splitlines() == ["warning: There are 1 parts for 2 ranks: 1 have nothing to do."]
    assert len(option.splitlines()) == 1 and "must be a positive number" in option
    assert len(other.splitlines()) == 1 and "other images or cameras" in other


def test_ranks_without_mpi4py_end_and_one_says_why(parts, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mpi4py", None)
    monkeypatch.setenv("PMI_SIZE", "2")
    for rank, words in (("0", 'pip install "groma[mpi]"'), ("1", "")):
        monkeypatch.setenv("PMI_RANK", rank)
        assert run(["adjust", str(parts), "-o", str(tmp_path / "x")]) == 1
        error = capsys.readouterr().err
        assert words in error and len(error.splitlines()) == (rank == "0")


def test_launchers_are_known():
    assert started_as({}) == (0, 1)
    assert started_as({"PMI_RANK": "3", "PMI_SIZE": "8"}) == (3, 8)
    assert started_as({"OMPI_COMM_WORLD_RANK": "1", "OMPI_COMM_WORLD_SIZE": "2"}) == (1, 2)


def test_commands_without_a_launcher(parts, tmp_path, capsys):
    scene = tmp_path / "scene.npz"
    groma.write_scene(synthetic.corridor("tiny").start, scene)
    cut = tmp_path / "cut"
    assert run(["convert", str(scene), str(cut), "--parts", "--part-size", "300", "--json", str(tmp_path / "n")]) == 0
    count = len(list(cut.iterdir()))
    assert json.loads((tmp_path / "n").read_text())["num_parts"] == count > 1
    assert f"{count} parts, 697 observations" in capsys.readouterr().out
    assert run(["convert", str(scene), str(cut), "--parts"]) == 1
    assert "exists already" in capsys.readouterr().err
    assert run(["convert", str(scene), str(cut), "--parts", "--force"]) == 0
    assert len(list(cut.iterdir())) == 1
    for more, words in (
        (["--report", str(tmp_path / "r.html"), "-o", str(tmp_path / "x")], "--report is for whole scenes"),
        ([], "pass -o OUT"),
        (["-o", str(cut)], "folder of the parts"),
    ):
        assert run(["adjust", str(cut), *more]) == 1
        assert words in capsys.readouterr().err
    assert run(["convert", str(scene), str(tmp_path / "z.npz"), "--part-size", "3"]) == 1
    assert "Add --parts" in capsys.readouterr().err


if __name__ == "__main__":
    from groma.solver.reduce.mpi import Ranks

    ranks = Ranks()

    if sys.argv[3:] == ["fail"]:
        import groma.adjustment.parts.run as module

        def solve_shards(*_, **__):
            raise OSError("the disk is gone")

        if ranks.rank == 1:
            module.solve_shards = solve_shards
        sys.exit(run(["adjust", sys.argv[1], "-o", sys.argv[2]]))

    def die(record):
        if ranks.rank == 1 and record.iteration == 3 and sys.argv[3:] != ["on"]:
            os.kill(os.getpid(), signal.SIGKILL)

    adjust_parts(
        sorted(groma.adjustment.parts.parts_of(sys.argv[1])), sys.argv[2], options=SolverOptions(threads=1),
        progress=die, reducer=ranks,
    )  # fmt: skip
