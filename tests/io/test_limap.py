# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP 2's structures: files written by LIMAP (tests/data/limap), mapping to scenes, and through the commands."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _comparison import equal, near
from _limap import LIMAP_PYTHON, through_limap
from _models import rig_scene

from groma.cli.main import run
from groma.errors import FileFormatError, OutputError
from groma.io import read_scene, structures_of, write_archive, write_colmap
from groma.io.limap.files import LINE_2D, MEMBER_2D, MEMBER_3D, NONE
from groma.io.limap.structures import (
    Group2d,
    Group3d,
    Lines3d,
    Structures,
    from_scene,
    read_limap,
    with_structures,
    write_limap,
)
from groma.scene import Directions, LineObservations, Lines, Planes, Relations, Scene
from groma.scene.synthetic.scenes import holistic

DATA = Path(__file__).parents[1] / "data" / "limap"
FILES = ("structures2d", "lines3D", "groups3D", "wireframe3D")


@pytest.mark.parametrize(("form", "suffix"), [("binary", ".bin"), ("text", ".txt")])
def test_files_of_limap_come_back_byte_by_byte(tmp_path, form, suffix):
    write_limap(read_limap(DATA / form), tmp_path / "copy", form)
    for name in FILES:
        assert (tmp_path / "copy" / (name + suffix)).read_bytes() == (
            DATA / form / "structures" / (name + suffix)
        ).read_bytes(), name


def test_content_of_the_files():
    read = read_limap(DATA / "binary")
    assert [image.image_id for image in read.images] == [1, 2, 3, 4]
    first = read.images[0]
    assert (first.num_points, first.lines["score"].tolist()) == (6, [0.5, 1.25, 2.0, 3.0])
    assert first.lines["line_id"].tolist() == [3, 2, 7, NONE]
    assert [(group.kind, len(group.points), len(group.lines)) for group in first.groups] == [(1, 2, 1), (0, 0, 2)]
    assert first.wireframe.tolist() == [(2, 1, 0.75)]
    assert read.lines.ids.tolist() == [2, 3, 7]
    assert read.lines.uncertainty.tolist() == [0.25, 0.375, 0.875]
    assert read.lines.track[2:6].tolist() == [(1, 0), (2, 0), (3, 0), (4, 0)]
    assert [(group.id, group.kind) for group in read.groups] == [(4, 1), (5, 2), (9, 0)]
    assert read.groups[0].params.tolist() == [0, 0.6, 0.8, 1]
    assert read.groups[0].points.tolist() == [(10, 0.5), (40, 1.0)]
    assert read.groups[0].track.tolist() == [(1, 0), (2, 0)]
    assert sorted(read.wireframe.tolist()) == [(20, 7, 0.5), (30, 2, 1.5)]


def test_text_holds_the_same_up_to_its_six_digits():
    binary, text = (read_limap(DATA / form) for form in ("binary", "text"))
    assert text.images[0].lines["line_id"].tolist() == [3, 2, 7, NONE]  # not in the file: from the tracks
    np.testing.assert_allclose(text.lines.segments, binary.lines.segments, rtol=5e-6)
    for one, two in zip(text.images, binary.images, strict=True):
        np.testing.assert_allclose(one.lines["ends"], two.lines["ends"], rtol=5e-6)
        assert [group.points.tolist() for group in one.groups] == [group.points.tolist() for group in two.groups]
    assert near(read_scene(DATA / "text"), read_scene(DATA / "binary"), 1e-5)


def test_scene_of_the_files():
    scene = read_scene(DATA / "binary")
    assert scene.lines.ids.tolist() == [2, 3, 7]
    # Image 3 has no pose: its observation of line 3 is left out.
    seen = scene.line_observations
    pairs = list(zip(scene.images.ids[seen.image_idx].tolist(), scene.lines.ids[seen.line_idx].tolist(), strict=True))
    assert pairs == [(1, 3), (1, 2), (1, 7), (2, 3), (4, 3), (4, 2), (4, 7)]
    assert seen.segment[3].tolist() == read_limap(DATA / "binary").images[1].lines["ends"][0].tolist()
    assert scene.planes.ids.tolist() == [4]
    assert scene.directions.ids.tolist() == [9]
    np.testing.assert_allclose(scene.directions.vectors, [[2 / 3, 1 / 3, -2 / 3]], rtol=1e-15)
    assert scene.points.ids[scene.relations.point_on_plane[:, 0]].tolist() == [10, 40]
    assert scene.relations.line_on_plane.tolist() == [[0, 0]]
    assert scene.relations.line_along_direction.tolist() == [[1, 0], [2, 0]]
    assert sorted(scene.points.ids[scene.relations.point_on_line[:, 0]].tolist()) == [20, 30]


@pytest.mark.parametrize("form", ["binary", "text"])
def test_scene_from_limap_and_back(tmp_path, form):
    scene = read_scene(DATA / "binary")
    write_colmap(scene, tmp_path / "model", form)
    assert not (tmp_path / "model" / "structures" / "groma.npz").exists()
    result = equal(scene, read_scene(tmp_path / "model"))
    assert result, result.reason


def test_what_a_scene_cannot_hold_stays_where_it_came_from():
    before = read_limap(DATA / "binary")
    after = from_scene(read_scene(DATA / "binary"), before)
    assert [image.image_id for image in after.images] == [1, 2, 4]  # image 3 has no pose
    for image in after.images:
        old = next(old for old in before.images if old.image_id == image.image_id)
        assert image.lines[["ends", "score"]].tobytes() == old.lines[["ends", "score"]].tobytes()
        assert image.wireframe.tobytes() == old.wireframe.tobytes()
        assert [group.points.tolist() for group in image.groups] == [group.points.tolist() for group in old.groups]
    assert after.lines.uncertainty.tolist() == before.lines.uncertainty.tolist()
    assert sorted(group.id for group in after.groups) == [4, 5, 9]
    for group in after.groups:
        old = next(old for old in before.groups if old.id == group.id)
        for name in ("params", "points", "lines", "track"):
            assert getattr(group, name).tobytes() == getattr(old, name).tobytes(), (group.id, name)
    assert sorted(after.wireframe.tolist()) == sorted(before.wireframe.tolist())


def test_lines_that_left_the_scene_leave_the_structures():
    before = read_limap(DATA / "binary")
    scene = read_scene(DATA / "binary")
    fewer = scene.replace(
        line_observations=LineObservations(),
        relations=Relations(),
        lines=Lines.through([[[0, 0, 0], [1, 0, 0]]], ids=[11]),
        planes=Planes(),
    )
    after = from_scene(fewer, before)
    assert after.lines.ids.tolist() == [11]
    assert after.lines.uncertainty.tolist() == [-1]
    assert len(after.lines.track) == len(after.wireframe) == 0
    assert {number for image in after.images for number in image.lines["line_id"].tolist()} == {NONE}
    assert {group.group_id for image in after.images for group in image.groups} == {9, NONE}
    assert sorted(group.id for group in after.groups) == [5, 9]


def test_two_dimensional_groups_and_wireframes_follow_from_relations():
    scene = holistic(12, seed=3).truth
    made = from_scene(scene)
    images = {image.image_id: image for image in made.images}
    points = {
        (scene.images.ids[i], k): scene.points.ids[p]
        for i, p, k in zip(
            scene.point_observations.image_idx,
            scene.point_observations.point_idx,
            scene.point_observations.keypoint_idx,
            strict=True,
        )
    }
    assert len(made.groups) == scene.num_planes + scene.num_directions
    for group in made.groups:
        on = set(group.points["id"].tolist()), set(group.lines["id"].tolist())
        assert len(group.track)
        for image_id, idx in group.track.tolist():
            flat = images[image_id].groups[idx]
            assert flat.group_id == group.id
            assert {points[image_id, k] for k in flat.points["idx"].tolist()} <= on[0]
            assert set(images[image_id].lines["line_id"][flat.lines["idx"]].tolist()) <= on[1]
            assert not len(flat.points) or flat.points["idx"].max() < images[image_id].num_points
    edges = {(point, line) for point, line, _ in made.wireframe.tolist()}
    flat = {
        (points[image.image_id, k], int(image.lines["line_id"][n]))
        for image in made.images
        for k, n, _ in image.wireframe.tolist()
    }
    assert flat
    assert flat <= edges


def test_plucker_vectors_and_common_identifiers_are_kept_beside(tmp_path):
    scene = rig_scene()
    moved = scene.with_lines(scene.lines.plucker + np.random.default_rng(0).normal(0, 0.1, (2, 6)))
    moved = moved.replace(
        planes=Planes([1, 3], np.tile([[0, 0.6, 0.8, -2.5]], (2, 1))), directions=Directions([3, 1], np.eye(3)[:2])
    )
    assert not np.array_equal(Lines.through(moved.lines.segments).plucker, moved.lines.plucker)
    for form in ("binary", "text"):
        write_colmap(moved, tmp_path / form, form)
        result = equal(moved, read_scene(tmp_path / form))
        assert result, result.reason
    groups = read_limap(tmp_path / "binary").groups
    assert [(group.id, group.kind) for group in groups] == [(1, 1), (3, 1), (4, 0), (5, 0)]


def test_changed_end_points_win_over_what_is_kept_beside(tmp_path):
    scene = rig_scene()
    moved = scene.with_lines(scene.lines.plucker + np.random.default_rng(0).normal(0, 0.1, (2, 6)))
    write_colmap(moved, tmp_path / "model")
    structures = read_limap(tmp_path / "model")
    segments = structures.lines.segments.copy()
    segments[0, 1] += [0, 0, 1]
    changed = replace(structures, lines=replace(structures.lines, segments=segments))
    shutil.move(tmp_path / "model" / "structures" / "groma.npz", tmp_path / "groma.npz")
    write_limap(changed, tmp_path / "model" / "structures", force=True)
    shutil.move(tmp_path / "groma.npz", tmp_path / "model" / "structures" / "groma.npz")
    read = read_scene(tmp_path / "model")
    assert read.lines.plucker[0].tolist() == Lines.through(segments[:1]).plucker[0].tolist()
    assert read.lines.plucker[1].tolist() == moved.lines.plucker[1].tolist()


def test_segments_without_length_are_left_out_unless_known():
    line = Lines3d(np.array([5, 6], "<u8"), np.ones((2, 2, 3)), np.full(2, -1.0), np.array([0, 0, 0]))
    assert with_structures(Scene(), Structures(lines=line)).num_lines == 0
    exact = Scene(lines=Lines([6], [[0, 0, 0, 1, 0, 0]], np.ones((1, 2, 3))))
    assert with_structures(Scene(), Structures(lines=line), exact).lines.ids.tolist() == [6]


@pytest.mark.parametrize("form", ["binary", "text"])
def test_lines_of_no_place_are_left_out_and_counted(tmp_path, form):
    """LIMAP writes lines that it could not triangulate with NaN, and short ones with ends that coincide in text."""
    scene = holistic(6, seed=1).truth
    write_colmap(scene, tmp_path / "model", form)
    structures = read_limap(tmp_path / "model")
    segments = structures.lines.segments.copy()
    segments[1], segments[3] = np.nan, 1.0
    spoilt = replace(structures, lines=replace(structures.lines, segments=segments))
    write_limap(spoilt, tmp_path / "model" / "structures", form, force=True)
    with pytest.warns(UserWarning, match=f"2 of {scene.num_lines} lines in .*structures have no direction"):
        read = read_scene(tmp_path / "model")
    assert read.lines.ids.tolist() == np.delete(scene.lines.ids, [1, 3]).tolist()
    seen = np.isin(scene.line_observations.line_idx, [1, 3])
    assert read.num_line_observations == (~seen).sum()


def test_what_was_deleted_is_left_out():
    scene = read_scene(DATA / "binary")
    structures = read_limap(DATA / "binary")
    gone = np.array([(777, 1.0), (NONE, 1.0)], MEMBER_3D)
    group = Group3d(1, 1, np.array([0, 0, 2.0, 4.0]), gone, gone)
    read = with_structures(scene, replace(structures, groups=(group,)))
    assert read.planes.hesse.tolist() == [[0, 0, 1, 2]]
    assert len(read.relations.point_on_plane) == len(read.relations.line_on_plane) == 0
    fewer = with_structures(scene, replace(structures, images=structures.images[1:]))
    assert fewer.images.ids[fewer.line_observations.image_idx].min() == 2


@pytest.mark.parametrize("form", ["binary", "text"])
def test_nothing_is_nothing(tmp_path, form):
    write_limap(Structures(), tmp_path / "empty", form)
    read = read_limap(tmp_path / "empty")
    assert len(read.images) == len(read.lines.ids) == len(read.groups) == len(read.wireframe) == 0
    scene = read_scene(DATA / "binary").points_only()
    write_colmap(scene, tmp_path / "model", form)
    assert not (tmp_path / "model" / "structures").exists()
    with pytest.raises(FileFormatError, match="No LIMAP structures"):
        read_limap(tmp_path / "model")
    with pytest.raises(OutputError, match="exists"):
        write_limap(Structures(), tmp_path / "empty")


# Through the commands


def _as_from_limap(folder: Path, form: str) -> Structures:
    """Write a model to adjust beside structures with everything that a scene does not hold; return these."""
    pair = holistic(8, seed=4)
    write_colmap(pair.start, folder, form)
    (folder / "structures" / "groma.npz").unlink(missing_ok=True)
    made = read_limap(folder)
    rng = np.random.default_rng(5)
    images = []
    for image in made.images:
        # 2D lines come in another order, with scores, and more of them than there are in 3D.
        more = np.zeros(3, LINE_2D)
        more["ends"], more["line_id"] = rng.uniform(0, 500, (3, 4)).round(3), NONE
        lines = np.concatenate([more, image.lines])
        lines["score"] = rng.uniform(1, 9, len(lines)).round(2)
        groups = tuple(replace(group, lines=_shifted(group.lines, "idx", 3)) for group in image.groups)
        other = Group2d(2, group_id=NONE, lines=np.array([(0, 0.5), (1, 1.5)], MEMBER_2D))
        images.append(
            replace(image, lines=lines, groups=(*groups, other), wireframe=_shifted(image.wireframe, "line", 3))
        )
    lines = replace(
        made.lines,
        uncertainty=rng.uniform(0.1, 2, len(made.lines.ids)).round(3),
        track=_shifted(made.lines.track, "idx", 3),
    )
    wireframe = made.wireframe.copy()
    wireframe["weight"] = rng.uniform(1, 2, len(wireframe)).round(3)
    groups = (*made.groups, Group3d(900, 2, np.array([1.0, 2.0, 3.0, 0.5])))
    result = Structures(tuple(images), lines, groups, wireframe)
    write_limap(result, folder / "structures", form, force=True)
    return read_limap(folder)


def _shifted(table: np.ndarray, name: str, by: int) -> np.ndarray:
    moved = table.copy()
    moved[name] += by
    return moved


@pytest.mark.parametrize("form", ["binary", "text"])
def test_adjust_keeps_what_it_does_not_model(tmp_path, form):
    """`groma adjust` on LIMAP's output: landmarks move, all else of the structures stays."""
    before = _as_from_limap(tmp_path / "limap", form)
    done = ["adjust", str(tmp_path / "limap"), "-o", str(tmp_path / "out"), "--max-iterations", "2", "-q"]
    assert run(done) == 0
    after = read_limap(tmp_path / "out")
    for old, new in zip(before.images, after.images, strict=True):
        assert new.lines.tobytes() == old.lines.tobytes()
        assert new.wireframe.tobytes() == old.wireframe.tobytes()
        for one, two in zip(old.groups, new.groups, strict=True):
            assert (one.kind, one.group_id) == (two.kind, two.group_id)
            assert one.lines.tobytes() == two.lines.tobytes() and one.points.tobytes() == two.points.tobytes()
    assert after.lines.ids.tolist() == before.lines.ids.tolist()
    assert after.lines.uncertainty.tolist() == before.lines.uncertainty.tolist()
    assert after.lines.track.tobytes() == before.lines.track.tobytes()
    assert not np.array_equal(after.lines.segments, before.lines.segments)
    assert sorted(after.wireframe.tolist()) == sorted(before.wireframe.tolist()) and len(after.wireframe)
    assert [group.id for group in after.groups] == [group.id for group in before.groups]
    for old, new in zip(before.groups, after.groups, strict=True):
        assert new.track.tobytes() == old.track.tobytes() and new.points.tobytes() == old.points.tobytes()
        assert np.array_equal(new.params, old.params) == (old.kind == 2)
    if LIMAP_PYTHON:
        told = through_limap(tmp_path / "out", tmp_path / "again_binary")
        assert told["valid"] and len(told["groups"]) == len(before.groups)
        assert [tuple(edge) for edge in told["edges"]] == sorted(before.wireframe.tolist())


def test_convert_keeps_what_it_does_not_model(tmp_path):
    before = _as_from_limap(tmp_path / "limap", "binary")
    assert run(["convert", str(tmp_path / "limap"), str(tmp_path / "copy"), "-q"]) == 0
    after = read_limap(tmp_path / "copy")
    assert [image.lines.tobytes() for image in after.images] == [image.lines.tobytes() for image in before.images]
    np.testing.assert_array_equal(after.lines.segments, before.lines.segments)


def test_structures_of_what_has_none(tmp_path):
    write_colmap(rig_scene().points_only(), tmp_path / "model")
    (tmp_path / "scene.npz").write_bytes(b"")
    assert structures_of(tmp_path / "model") is None and structures_of(tmp_path / "scene.npz") is None
    assert structures_of(DATA / "binary") is not None


def test_results_are_read_with_what_a_colmap_model_cannot_hold(tmp_path):
    scene = holistic(4, seed=1).start
    write_colmap(scene.keep(lines=[]), tmp_path / "out")
    write_archive(scene, tmp_path / "out" / "scene.npz")
    assert read_scene(tmp_path / "out").num_lines == 0  # an archive of that name beside a model of someone else
    (tmp_path / "out" / "summary.json").write_text("{}")
    assert equal(scene, read_scene(tmp_path / "out")) and structures_of(tmp_path / "out") is None
    (tmp_path / "submap_2").mkdir()
    write_archive(scene, tmp_path / "submap_2" / "scene.npz")
    assert equal(scene, read_scene(tmp_path / "submap_2"))
