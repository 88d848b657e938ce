"""Planes, directions and relations in parts: each counts once, the result is that of the whole, and of many ranks."""

import json

import numpy as np
import pytest
from _mpi import mpiexec, needs_mpi, same_bytes

import groma
from groma.adjustment.assemble import assemble, disassemble, first_camera_gauge
from groma.adjustment.assembly_options import AssemblyOptions
from groma.adjustment.parts import adjust_parts, join_parts, num_ties_cut, write_parts
from groma.cli.main import run
from groma.errors import InputError
from groma.factors.losses import Cauchy, GemanMcClure
from groma.geometry import line3, quaternion
from groma.scene import Directions, PlaneObservations, PosePriors, synthetic
from groma.solver.options import SolverOptions
from groma.solver.solve import solve

pytestmark = pytest.mark.kernels
GAUSS_NEWTON = SolverOptions(
    method="gauss_newton", linear_solver="dense", threads=1, max_iterations=20,
    function_tolerance=0.0, gradient_tolerance=0.0, step_tolerance=0.0,
)  # fmt: skip
SIZE = 400


def planes_seen(truth):
    """Every plane as the first three cameras measure it."""
    image, plane = (index.ravel() for index in np.meshgrid(np.arange(3), np.arange(truth.num_planes)))
    pose, hesse = truth.cam_from_world[image], truth.planes.hesse[plane]
    normal = quaternion.rotate(pose[:, :4], hesse[:, :3])
    offset = hesse[:, 3] - np.einsum("ni,ni->n", normal, pose[:, 4:])
    information = np.tile(np.diag([100.0, 100.0, 100.0]), (len(image), 1, 1))
    return PlaneObservations(image, plane, np.column_stack([normal, offset]), information)


@pytest.fixture(scope="module")
def scene():
    """Points, lines, planes, directions, relations of all kinds, planes measured in cameras, known poses."""
    made = synthetic.holistic(30, noise_px=0.2, rotation_deg=0.1, translation=0.005, structure=0.01)
    start, truth = made.start, made.truth
    along = np.array([[0, 0], [12, 1], [25, 2]])
    directions = truth.lines.plucker[along[:, 0], 3:]
    relations = start.relations
    relations = type(relations)(
        **{name: getattr(relations, name) for name in ("point_on_plane", "line_on_plane", "point_on_line")},
        line_along_direction=along, line_along_direction_sigma=np.full(3, 0.01),
        parallel_planes=np.array([[0, 1], [2, 3]]), parallel_planes_sigma=np.full(2, 1.0),
        perpendicular_planes=np.array([[1, 2]]), perpendicular_planes_sigma=np.ones(1),
    )  # fmt: skip
    count = start.num_frames
    return start.replace(
        directions=Directions(np.arange(3) + 7, directions),
        relations=relations,
        plane_observations=planes_seen(truth),
        pose_priors=PosePriors(np.arange(count), truth.frames.rig_from_world, np.full((count, 6), 0.01)),
    )


def pairs_of(scene, kind):
    """The relations of a kind as pairs of identifiers."""
    pairs = getattr(scene.relations, kind)
    names = {"point": "points", "line": "lines", "plane": "planes", "direction": "directions"}
    words = [word for word in kind.split("_") if word in names] or ["plane", "plane"]
    columns = [getattr(scene, names[word]).ids[pairs[:, side]] for side, word in enumerate(words)]
    return sorted(zip(*(column.tolist() for column in columns), strict=True))


def test_every_relation_and_measurement_is_in_one_part(scene, tmp_path):
    parts = [groma.read_scene(path) for path in write_parts(scene, tmp_path / "parts", SIZE)]
    assert len(parts) > 3 and all(len(part.relations) for part in parts)
    for part in parts:
        np.testing.assert_array_equal(part.planes.hesse, scene.planes.hesse)
        np.testing.assert_array_equal(part.directions.ids, scene.directions.ids)
    for kind in ("point_on_plane", "line_on_plane", "line_along_direction"):
        assert sorted(pair for part in parts for pair in pairs_of(part, kind)) == pairs_of(scene, kind)
    for table in ("plane_observations", "pose_priors"):
        assert [len(getattr(part, table)) for part in parts[1:]] == [0] * (len(parts) - 1)
        assert len(getattr(parts[0], table)) == len(getattr(scene, table))
    for kind in ("parallel_planes", "perpendicular_planes"):
        assert pairs_of(parts[0], kind) == pairs_of(scene, kind)
        assert not any(pairs_of(part, kind) for part in parts[1:])


def test_points_follow_the_first_of_their_lines(scene, tmp_path):
    """A point on two lines is tied to one of them at least; what is cut is counted."""
    more = scene.relations.point_on_line
    more = np.concatenate([more, np.column_stack([more[:, 0], (more[:, 1] + 15) % scene.num_lines])])
    twice = scene.replace(relations=scene.relations.take(point_on_line=[]))
    columns = {name: getattr(twice.relations, name) for name in twice.relations.kinds()} | {"point_on_line": more}
    twice = twice.replace(relations=type(twice.relations)(**columns))
    for one, all_kept in ((scene, True), (twice, False)):
        parts = [groma.read_scene(path) for path in write_parts(one, tmp_path / "parts", SIZE, force=True)]
        kept = [pair for part in parts for pair in pairs_of(part, "point_on_line")]
        cut = num_ties_cut(one, SIZE)
        assert (cut == 0) is all_kept
        assert len(kept) == len(one.relations.point_on_line) - cut
        assert {point for point, _ in kept} == {point for point, _ in pairs_of(one, "point_on_line")}


def test_parts_are_joined_to_what_was_cut(scene, tmp_path):
    joined = join_parts(write_parts(scene, tmp_path / "parts", SIZE))
    for kind in scene.relations.kinds():
        assert pairs_of(joined, kind) == pairs_of(scene, kind)
    for name in ("points", "lines"):
        mine, other = getattr(joined, name), getattr(scene, name)
        place = "xyz" if name == "points" else "plucker"
        order = np.argsort(mine.ids)
        np.testing.assert_array_equal(getattr(mine, place)[order], getattr(other, place)[np.argsort(other.ids)])
    costs = [solve(assemble(one, OPTIONS).problem, SolverOptions(max_iterations=0)).report for one in (joined, scene)]
    assert costs[0].initial_cost == pytest.approx(costs[1].initial_cost, rel=1e-12)
    assert costs[0].num_residuals == costs[1].num_residuals


OPTIONS = AssemblyOptions(max_coupled_lines=0)  # as in parts


@pytest.mark.compiled
def test_the_solution_is_that_of_the_whole(scene, tmp_path):
    """States of all kinds, to 1e-9 of their size: known poses hold the scene, so that the minimum is one point."""
    paths = write_parts(scene, tmp_path / "parts", SIZE)
    assert len(paths) > 3
    result = adjust_parts(paths, tmp_path / "out", options=GAUSS_NEWTON)
    whole = join_parts(paths)
    solution = solve(assemble(whole, OPTIONS).problem, GAUSS_NEWTON)
    expected, found = disassemble(whole, solution.problem), join_parts(result.paths)
    assert result.report.final_cost == pytest.approx(solution.report.final_cost, rel=1e-12)
    for table, column in (
        ("frames", "rig_from_world"), ("points", "xyz"), ("planes", "hesse"), ("directions", "vectors"),
    ):  # fmt: skip
        mine, other = (getattr(getattr(one, table), column) for one in (found, expected))
        np.testing.assert_allclose(mine, other, rtol=0, atol=1e-9 * max(1.0, np.abs(other).max()))
        assert np.abs(mine - getattr(getattr(whole, table), column)).max() > 1e-4
    assert line3.distance_to_point(found.lines.plucker[:, None], expected.lines.segments).max() < 1e-9
    assert result.adjustment.num_planes == scene.num_planes
    assert result.adjustment.relations["line_on_plane"] == {"held": len(scene.relations.line_on_plane), "dropped": 0}


@pytest.mark.compiled
def test_the_gauge_is_that_of_the_whole(tmp_path):
    """Without known poses the first camera is held, and of the farthest one what tells the scale."""
    scene = synthetic.corridor("tiny").start
    paths = write_parts(scene, tmp_path / "parts", 150)
    options = SolverOptions(threads=1, function_tolerance=1e-10)
    result = adjust_parts(paths, tmp_path / "out", options=options)
    whole = groma.adjust(scene, groma.AdjustOptions(loss="none", function_tolerance=1e-10, threads=1))
    assert result.report.final_cost == pytest.approx(whole.report.solve.final_cost, rel=1e-5)
    held = first_camera_gauge(scene).all(axis=1)
    found = [one.frames.rig_from_world for one in (groma.read_scene(result.paths[-1]), whole.scene, scene)]
    np.testing.assert_array_equal(held, (found[0] == found[2]).all(axis=1))
    np.testing.assert_array_equal(held, (found[1] == found[2]).all(axis=1))


@pytest.mark.compiled
def test_relations_that_fail_are_given_up_as_in_the_whole(scene, tmp_path):
    """Points that were said to lie on planes far away."""
    wrong = scene.relations.point_on_plane.copy()
    wrong[::9, 1] = (wrong[::9, 1] + 1) % scene.num_planes
    relations = scene.relations.take(point_on_plane=[], point_on_line=[])
    columns = {name: getattr(relations, name) for name in relations.kinds()} | {"point_on_plane": wrong}
    spoiled = scene.replace(relations=type(relations)(**columns), plane_observations=PlaneObservations())
    losses = Cauchy(1.0), GemanMcClure(2.0)
    result = adjust_parts(
        write_parts(spoiled, tmp_path / "parts", SIZE), tmp_path / "out", losses, SolverOptions(threads=1)
    )
    whole = groma.adjust(spoiled, groma.AdjustOptions(threads=1))
    assert whole.report.relations["point_on_plane"]["dropped"] > 3
    assert result.adjustment.relations == whole.report.relations
    found = join_parts(result.paths)
    assert pairs_of(found, "point_on_plane") == pairs_of(whole.scene, "point_on_plane")


@pytest.mark.compiled
def test_other_planes_are_refused_unless_left_out(scene, tmp_path, capsys):
    paths = write_parts(scene.replace(pose_priors=PosePriors()), tmp_path / "parts", SIZE)
    other = groma.read_scene(paths[1])
    groma.write_scene(other.with_planes(other.planes.hesse[::-1]), paths[1], force=True)
    with pytest.raises(InputError, match="other planes or directions"):
        adjust_parts(paths, tmp_path / "x")
    with pytest.raises(InputError, match="other planes or directions"):
        join_parts(paths)
    assert run(["adjust", str(tmp_path / "parts"), "-o", str(tmp_path / "x")]) == 1
    said = capsys.readouterr().err
    assert len(said.splitlines()) == 1 and "--no-planes" in said
    assert run(["adjust", str(tmp_path / "parts"), "-o", str(tmp_path / "y"), "--no-planes", "-q"]) == 0
    capsys.readouterr()


def test_convert_cuts_and_joins(scene, tmp_path, capsys):
    groma.write_scene(scene, tmp_path / "scene.npz")
    cut, back = str(tmp_path / "cut"), str(tmp_path / "back.npz")
    assert run(["convert", str(tmp_path / "scene.npz"), cut, "--parts", "--part-size", "90"]) == 0
    told = capsys.readouterr()
    lost = num_ties_cut(scene, 90)
    assert (f"{lost} of {len(scene.relations.point_on_line)}" in told.err) is (lost > 0)
    assert run(["convert", cut, back]) == 0
    joined = groma.read_scene(back)
    assert len(joined.relations) == len(scene.relations) - lost and joined.num_planes == scene.num_planes
    assert run(["convert", cut, back, "--parts"]) == 1
    assert len(capsys.readouterr().err.splitlines()) == 1


@needs_mpi
def test_two_ranks_write_what_one_process_writes(scene, tmp_path):
    """Relations of all kinds, in two robust stages; what travels has blocks between planes and cameras."""
    scene = scene.replace(plane_observations=PlaneObservations())
    write_parts(scene, tmp_path / "parts", SIZE)
    arguments = ["adjust", str(tmp_path / "parts"), "--threads", "1", "-o"]
    assert run([*arguments, str(tmp_path / "one"), "-q", "--json", str(tmp_path / "one.json")]) == 0
    ranks = ["-m", "groma", *arguments, tmp_path / "two", "--json", tmp_path / "two.json"]
    said = mpiexec(ranks, ranks)
    assert said.returncode == 0, said.stderr
    assert same_bytes(tmp_path / "one", tmp_path / "two")
    one, two = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("one", "two"))
    assert one["relations"] == two["relations"] and two["num_planes"] == scene.num_planes
    cameras = scene.num_images * 6 + scene.num_planes * 3 + scene.num_directions * 2
    assert two["bytes_per_step"] > 16 * cameras
