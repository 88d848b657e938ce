"""Parts that belong to several processes: the same bytes as by one, a rank that is killed, wrong use without a hang."""

import json
import os
import shutil
import signal
import sys

import pytest
from _mpi import mpiexec, needs_mpi, same_bytes

import groma
from groma.adjustment.parts import adjust_parts, write_parts
from groma.cli.main import run
from groma.scene import synthetic
from groma.solver.options import SolverOptions
from groma.solver.reduce.mpi import started_as


@pytest.fixture
def parts(tmp_path):
    write_parts(synthetic.corridor("tiny").start, tmp_path / "parts", observations=400)
    return tmp_path / "parts"


def adjust(*arguments):
    return ["-m", "groma", "adjust", *arguments, "--threads", "1"]


@needs_mpi
def test_two_ranks_write_what_one_process_writes(parts, tmp_path):
    """Points and lines, in two robust stages."""
    assert run(["adjust", str(parts), "-o", str(tmp_path / "one"), "--threads", "1", "-q"]) == 0
    said = mpiexec(*[adjust(parts, "-o", tmp_path / "two", "--json", tmp_path / "two.json")] * 2)
    assert said.returncode == 0, said.stderr
    assert said.stdout.count("Wrote") == said.stdout.count("steps in") == 1
    assert same_bytes(tmp_path / "one", tmp_path / "two")
    numbers = json.loads((tmp_path / "two.json").read_text())
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
def test_what_is_wrong_for_some_rank_is_told_once(parts, tmp_path):
    """Parts that a rank cannot see or has none of, wrong options, other cameras: four commands in one start."""
    few, mixed = tmp_path / "few", tmp_path / "mixed"
    write_parts(groma.read_scene(parts / "part-00000.npz"), few)
    shutil.copytree(few, mixed)
    groma.write_scene(synthetic.corridor(13).start, mixed / "part-00001.npz")
    same = [
        ["adjust", few, "-o", tmp_path / "y", "--threads", "1", "-v"],
        ["adjust", mixed, "-o", tmp_path / "z", "--loss-scale", "-1", "--loss", "huber"],
        ["adjust", mixed, "-o", tmp_path / "z"],
    ]
    seen = [[["adjust", folder, "-o", tmp_path / "x"], *same] for folder in (parts, tmp_path / "nowhere")]
    said = mpiexec(*[[__file__, "commands", json.dumps(commands, default=str)] for commands in seen])
    assert said.returncode == 0, said.stderr
    unseen, idle, option, other, _ = said.stderr.split("END ")
    assert len(unseen.splitlines()) == 1 and unseen.startswith("groma: Rank 1 of 2: ")
    assert "that this process can see" in unseen and not (tmp_path / "x").exists()
    assert idle.splitlines() == ["1", "warning: There are 1 parts for 2 ranks: 1 have nothing to do."]
    assert option.startswith("0") and len(option.splitlines()) == 2 and "must be a positive number" in option
    assert other.startswith("1") and len(other.splitlines()) == 2 and "other images or cameras" in other


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

    if sys.argv[1] == "commands":
        for words in json.loads(sys.argv[2]):
            code = run(words)
            ranks.gather("what the others say comes first")
            if ranks.rank == 0:
                print(f"END {code}", file=sys.stderr, flush=True)
        sys.exit(0)

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
