"""Adjustments in parts that were stopped go on, to the same bytes; what is taken from a checkpoint, and what is not."""

import json

import numpy as np
import pytest
from _mpi import same_bytes

import groma
from groma.adjustment.parts import adjust_parts, write_parts
from groma.adjustment.parts.memory import free_memory, room_for_parts
from groma.adjustment.parts.run import BINS
from groma.errors import FileFormatError, InputError, OutputError
from groma.factors.losses import Cauchy, GemanMcClure
from groma.scene import Similarity, synthetic
from groma.scene.measurements import PosePriors
from groma.solver.options import SolverOptions
from groma.solver.reduce.single import SingleProcess

OPTIONS = SolverOptions(threads=1)
LOSSES = Cauchy(1.0), GemanMcClure(2.0)


class Killed(BaseException):
    """Stands for SIGKILL: nothing cleans up after it."""


def killed_at(step):
    def progress(record):
        if record.iteration == step:
            raise Killed

    return progress


@pytest.fixture
def parts(tmp_path):
    return write_parts(synthetic.corridor("tiny").start, tmp_path / "parts", observations=250)


def test_a_killed_run_goes_on(parts, tmp_path):
    """Wherever it was killed, in the first stage or the second, and however often."""
    whole = adjust_parts(parts, tmp_path / "whole", LOSSES, OPTIONS)
    second = whole.adjustment.stages[1]["first_step"]
    assert 3 < second < whole.report.iterations
    for step in (2, second - 1, second, whole.report.iterations):
        with pytest.raises(Killed):
            adjust_parts(parts, tmp_path / "out", LOSSES, OPTIONS, killed_at(step))
        kept = sorted(path.name for path in (tmp_path / "out" / ".checkpoint").iterdir())
        assert len(kept) <= 1 + 2 * len(parts) and "state.npz" in kept
    result = adjust_parts(parts, tmp_path / "out", LOSSES, OPTIONS)
    assert same_bytes(tmp_path / "out", tmp_path / "whole")
    assert [record.cost for record in result.report.history] == [record.cost for record in whole.report.history]
    assert result.report.initial_cost == whole.report.initial_cost
    assert result.report.final_cost == whole.report.final_cost
    assert result.adjustment.stages == whole.adjustment.stages


def test_half_a_checkpoint_counts_for_nothing(parts, tmp_path, monkeypatch):
    """Killed between the landmarks of a step and the file that says they are valid."""
    whole = adjust_parts(parts, tmp_path / "whole", options=OPTIONS)
    import groma.adjustment.parts.checkpoint as module

    save, count = module._save, []

    def failing(path, arrays):
        count.append(path)
        if path.name == "state.npz" and len(count) > 2 * (1 + len(parts)):
            raise Killed
        save(path, arrays)

    monkeypatch.setattr(module, "_save", failing)
    with pytest.raises(Killed):
        adjust_parts(parts, tmp_path / "out", options=OPTIONS)
    monkeypatch.undo()
    result = adjust_parts(parts, tmp_path / "out", options=OPTIONS)
    assert same_bytes(tmp_path / "out", tmp_path / "whole")
    assert result.report.iterations == whole.report.iterations


def test_another_adjustment_does_not_go_on(parts, tmp_path):
    with pytest.raises(Killed):
        adjust_parts(parts, tmp_path / "out", options=OPTIONS, progress=killed_at(2))
    with pytest.raises(OutputError, match="other options"):
        adjust_parts(parts, tmp_path / "out", Cauchy(1.0), OPTIONS)
    again = adjust_parts(parts, tmp_path / "out", Cauchy(1.0), OPTIONS, force=True)
    fresh = adjust_parts(parts, tmp_path / "fresh", Cauchy(1.0), OPTIONS)
    assert again.report.final_cost == fresh.report.final_cost
    assert same_bytes(tmp_path / "out", tmp_path / "fresh")


def test_a_damaged_checkpoint_is_told(parts, tmp_path):
    with pytest.raises(Killed):
        adjust_parts(parts, tmp_path / "out", options=OPTIONS, progress=killed_at(2))
    state = tmp_path / "out" / ".checkpoint" / "state.npz"
    state.write_bytes(state.read_bytes()[:200])
    with pytest.raises(FileFormatError, match="damaged"):
        adjust_parts(parts, tmp_path / "out", options=OPTIONS)


@pytest.mark.parametrize(
    ("file", "name", "value"),
    [
        ("state.npz", "told", np.array("{}")),
        ("state.npz", "told", np.array("[1")),
        ("state.npz", "frames", np.zeros((2, 7))),
        ("state.npz", "frames", None),
        ("part-00000.{slot}.npz", "points", np.full((3, 3), np.nan)),
        ("part-00000.{slot}.npz", "points", np.array(["a"])),
        ("part-00000.{slot}.npz", "moved", np.zeros(0, bool)),
    ],
)
def test_a_checkpoint_whose_arrays_are_others_is_told(parts, tmp_path, file, name, value):
    with pytest.raises(Killed):
        adjust_parts(parts, tmp_path / "out", options=OPTIONS, progress=killed_at(2))
    folder = tmp_path / "out" / ".checkpoint"
    with np.load(folder / "state.npz") as state:
        slot = json.loads(str(state["told"]))["slot"]
    place = folder / file.format(slot=slot)
    with np.load(place) as kept:
        arrays = {**kept, name: value}
    if name == "told" and str(value) == "{}":
        told = json.loads(str(np.load(folder / "state.npz")["told"]))
        arrays[name] = np.array(json.dumps({"key": told["key"]}))
    np.savez(place, **{key: array for key, array in arrays.items() if array is not None})
    with pytest.raises(FileFormatError, match=r"damaged\. Pass --force to begin anew"):
        adjust_parts(parts, tmp_path / "out", options=OPTIONS)


def test_parts_in_memory_give_the_same(parts, tmp_path):
    for keep in ("always", "never", "auto"):
        adjust_parts(parts, tmp_path / keep, options=OPTIONS, keep=keep)
    assert same_bytes(tmp_path / "always", tmp_path / "never") and same_bytes(tmp_path / "auto", tmp_path / "never")
    with pytest.raises(InputError, match="keep must be"):
        adjust_parts(parts, tmp_path / "x", keep="sometimes")
    assert room_for_parts("never", SingleProcess()) == 0.0 < room_for_parts("auto", SingleProcess()) < free_memory()


def test_parts_of_an_earlier_result_go(parts, tmp_path):
    adjust_parts(parts, tmp_path / "out", options=OPTIONS)
    fewer = write_parts(groma.read_scene(parts[0]), tmp_path / "fewer")
    adjust_parts(fewer, tmp_path / "out", options=OPTIONS, force=True)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["part-00000.npz"]
    with pytest.raises(OutputError, match="folder of the parts"):
        adjust_parts(fewer, tmp_path / "fewer", options=OPTIONS, force=True)


def test_far_from_the_origin_the_result_is_as_near_it(parts, tmp_path):
    """Coordinates of millions of metres: only their last digits are lost."""
    away = Similarity(translation=np.array([4.5e5, 5.3e6, 100.0]))
    scene = synthetic.corridor("tiny").start.points_only()
    near = adjust_parts(write_parts(scene, tmp_path / "a"), tmp_path / "near", options=OPTIONS)
    far = adjust_parts(write_parts(scene.transformed(away), tmp_path / "b"), tmp_path / "far", options=OPTIONS)
    assert far.report.final_cost == pytest.approx(near.report.final_cost, rel=1e-4)
    moved = groma.read_scene(near.paths[0]).transformed(away)
    np.testing.assert_allclose(
        groma.read_scene(far.paths[0]).cam_centers_in_world, moved.cam_centers_in_world, rtol=0, atol=1e-4
    )


def test_known_poses_count_once(tmp_path):
    scene = synthetic.corridor("tiny").start.points_only()
    priors = PosePriors(np.arange(3), scene.frames.rig_from_world[:3], np.full((3, 6), 0.01))
    scene = scene.replace(pose_priors=priors)
    paths = write_parts(scene, tmp_path / "parts", observations=200)
    assert len(paths) > 2 and sum(len(groma.read_scene(path).pose_priors) for path in paths) == 3
    result = adjust_parts(paths, tmp_path / "out", options=SolverOptions(function_tolerance=1e-10, threads=1))
    whole = groma.adjust(scene, groma.AdjustOptions(loss="none", planes=False, function_tolerance=1e-10))
    assert result.report.final_cost == pytest.approx(whole.report.solve.final_cost, rel=1e-6)


def test_the_report_is_that_of_the_whole(tmp_path):
    """Root mean squares, numbers and the scale of the last loss, with the bins of the median as its only difference."""
    scene = synthetic.corridor("tiny").start
    paths = write_parts(scene, tmp_path / "parts", observations=250)
    result = adjust_parts(paths, tmp_path / "out", LOSSES, OPTIONS, planes=False)
    whole = groma.adjust(scene, groma.AdjustOptions(planes=False, threads=1)).report
    mine = result.adjustment
    assert (mine.num_points, mine.num_lines, mine.num_images) == (whole.num_points, whole.num_lines, whole.num_images)
    assert mine.num_observations == whole.num_observations
    assert [stage["loss"] for stage in mine.stages] == [stage["loss"] for stage in whole.stages]
    for kind in ("points", "lines"):
        assert mine.rmse_px[kind]["before"] == pytest.approx(whole.rmse_px[kind]["before"], rel=1e-9)
        assert mine.rmse_px[kind]["after"] == pytest.approx(whole.rmse_px[kind]["after"], rel=0.02)
    assert BINS > 1000 and json.dumps(mine.to_dict())
