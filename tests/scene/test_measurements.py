# SPDX-License-Identifier: BSD-3-Clause
"""Tables of measurements: what they refer to goes along, units follow the world, files hold them."""

import zipfile

import numpy as np
import pytest
from _comparison import equal, near
from _measured import with_measurements

from groma.errors import FileFormatError, InputError, ShapeError
from groma.io.archive import read_archive, write_archive
from groma.scene import LineDepths, PlaneObservations, PointDepths, PosePriors, Relations, RightColumns, Similarity
from groma.scene.synthetic.scenes import holistic

TABLES = ("point_depths", "right_columns", "line_depths", "plane_observations", "pose_priors")


@pytest.fixture(scope="module")
def scene():
    truth = holistic(12, seed=5).truth
    on_plane = truth.relations.line_on_plane
    relations = Relations(
        point_on_plane=truth.relations.point_on_plane,
        line_on_plane=on_plane,
        line_on_plane_sigma=np.linspace(0.01, 0.02, len(on_plane)),
        parallel_planes=[[0, 1]],
        parallel_planes_sigma=[0.3],
        perpendicular_planes=[[1, 0], [0, 1]],
    )
    return with_measurements(truth).replace(relations=relations)


def by_name(scene):
    """Every measurement with the identifiers of what it belongs to, so that rows may be compared between scenes."""
    names, points, lines, planes = scene.images.names, scene.points.ids, scene.lines.ids, scene.planes.ids
    d, r, s, p, q = (getattr(scene, table) for table in TABLES)
    seen, segments = scene.point_observations, scene.line_observations
    out = {("depth", names[i], points[j], x) for i, j, x in zip(d.image_idx, d.point_idx, d.depth, strict=True)}
    of = r.observation_idx
    out |= {
        ("right", names[i], points[j], x)
        for i, j, x in zip(seen.image_idx[of], seen.point_idx[of], r.u_right, strict=True)
    }
    of = s.observation_idx
    out |= {
        ("line", names[i], lines[j], *x)
        for i, j, x in zip(segments.image_idx[of], segments.line_idx[of], s.inverse_depth, strict=True)
    }
    out |= {
        ("plane", names[i], planes[j], *x) for i, j, x in zip(p.image_idx, p.plane_idx, p.plane_in_cam, strict=True)
    }
    frames = scene.frames.ids
    out |= {("prior", frames[i], *x) for i, x in zip(q.frame_idx, q.rig_from_world, strict=True)}
    on, sigma = scene.relations.line_on_plane, scene.relations.line_on_plane_sigma
    out |= {("on plane", lines[i], planes[j], x) for (i, j), x in zip(on, sigma, strict=True)}
    pairs = scene.relations.perpendicular_planes
    return out | {("perpendicular", planes[i], planes[j]) for i, j in pairs}


def test_measurements_go_with_their_landmarks(scene):
    points, lines = scene.points.ids % 3 != 0, scene.num_lines - 1 - np.arange(7)
    part = scene.keep(points=points, lines=lines, planes=[1])
    kept = {
        "depth": set(scene.points.ids[points]),
        "right": set(scene.points.ids[points]),
        "line": set(scene.lines.ids[lines]),
        "plane": {scene.planes.ids[1]},
    }
    expected = set()
    for row in by_name(scene):
        if row[0] == "prior" or (row[0] in kept and row[2] in kept[row[0]]):
            expected.add(row)
        if row[0] == "on plane" and row[1] in kept["line"] and row[2] == scene.planes.ids[1]:
            expected.add(row)
    assert by_name(part) == expected and len(expected) > 100
    assert part.relations.parallel_planes.shape == (0, 2) and len(part.relations.parallel_planes_sigma) == 0


def test_measurements_go_with_their_observations(scene):
    kept = np.arange(len(scene.point_observations)) % 2 == 1
    part = scene.keep(point_observations=kept, points=scene.points.ids > 20)
    seen = scene.point_observations
    left = {
        (scene.images.names[i], scene.points.ids[j])
        for i, j in zip(seen.image_idx[kept], seen.point_idx[kept], strict=True)
    }
    expected = {row for row in by_name(scene) if row[0] == "right" and row[1:3] in left and row[2] > 20}
    assert {row for row in by_name(part) if row[0] == "right"} == expected and expected
    with pytest.raises(InputError, match=r"right_columns.observation_idx refers to the .* rows of point_observations"):
        scene.replace(point_observations=seen.take(kept))


def test_measurements_go_with_their_images(scene):
    chosen = [7, 2, 5]
    part = scene.subset(chosen, min_observations=0)
    names = {scene.images.names[row] for row in chosen}
    frames = set(scene.frames.ids[chosen])
    expected = {
        row
        for row in by_name(scene)
        if row[0] in ("on plane", "perpendicular") or row[1] in (frames if row[0] == "prior" else names)
    }
    assert by_name(part) == expected
    assert equal(scene.subset(np.arange(12)), scene)
    without = scene.points_only()
    assert without.num_measurements.keys() == {"point depths", "right columns", "pose priors"}


def test_a_similarity_there_and_back_is_none(scene):
    there = Similarity(3.0, np.diag([1.0, -1.0, -1.0]), np.array([1.0, 2.0, 3.0]))
    moved = scene.transformed(there)
    np.testing.assert_allclose(moved.point_depths.depth, 3 * scene.point_depths.depth)
    np.testing.assert_allclose(moved.line_depths.inverse_depth, scene.line_depths.inverse_depth / 3)
    np.testing.assert_allclose(moved.relations.line_on_plane_sigma, 3 * scene.relations.line_on_plane_sigma)
    np.testing.assert_array_equal(moved.relations.parallel_planes_sigma, [0.3])
    back = near(moved.transformed(there.inverse()), scene, 1e-12)
    assert back, back.reason


def test_archives_hold_measurements(scene, tmp_path):
    write_archive(scene, tmp_path / "all.npz")
    same = equal(read_archive(tmp_path / "all.npz"), scene)
    assert same, same.reason


def test_archives_without_measurements_are_those_of_before(tmp_path):
    """A scene without measurements has the members that every version of groma knows."""
    truth = holistic(6, seed=0).truth
    write_archive(truth, tmp_path / "plain.npz")
    with zipfile.ZipFile(tmp_path / "plain.npz") as file:
        members = {name.removesuffix(".npy") for name in file.namelist()}
    assert not {name for name in members if name.split(".")[0] in TABLES or "sigma" in name}
    assert {name for name in members if name.startswith("relations.")} == {
        f"relations.{kind}" for kind in ("point_on_plane", "line_on_plane", "line_along_direction", "point_on_line")
    }
    assert equal(read_archive(tmp_path / "plain.npz"), truth)


def test_an_archive_with_half_a_table_is_refused(scene, tmp_path):
    write_archive(scene, tmp_path / "all.npz")
    with zipfile.ZipFile(tmp_path / "all.npz") as whole, zipfile.ZipFile(tmp_path / "half.npz", "w") as half:
        for name in whole.namelist():
            if name != "point_depths.depth.npy":
                half.writestr(name, whole.read(name))
    with pytest.raises((FileFormatError, ShapeError), match="PointDepths must be equally long"):
        read_archive(tmp_path / "half.npz")


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"point_depths": PointDepths([99], [0], [1.0], [0.1])}, r"point_depths.image_idx\[0\] is 99"),
        ({"point_depths": PointDepths([0], [9999], [1.0], [0.1])}, r"point_depths.point_idx\[0\] is 9999"),
        ({"right_columns": RightColumns([99999], [1.0], [0.1])}, r"not in the scene \(point observations"),
        ({"line_depths": LineDepths([-1], [[1, 1]], [[1, 1]], [0.1])}, r"line_depths.observation_idx\[0\] is -1"),
        (
            {"plane_observations": PlaneObservations([0], [7], [[0, 0, 1, 0.0]], [np.eye(3)])},
            r"plane_observations.plane_idx\[0\] is 7",
        ),
        ({"pose_priors": PosePriors([0], [[0, 0, 0, 2, 0, 0, 0]], np.ones((1, 6)))}, "unit quaternion"),
        ({"relations": Relations(parallel_planes=[[0, 9]])}, r"relations.parallel_planes\[:, 1\]\[0\] is 9"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_what_is_not_in_the_scene_is_named(tables, message):
    with pytest.raises(InputError, match=message):
        holistic(12, seed=5).truth.replace(**tables)


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: PointDepths([0], [0], [1.0], [0.0]), InputError, "PointDepths.sigma must be positive; row 0"),
        (lambda: PointDepths([0], [0], [1.0], [1e-160]), InputError, "PointDepths.sigma must be between 1e-100 and 1e"),
        (lambda: PointDepths([0], [0], [1.0], [1e160]), InputError, "PointDepths.sigma must be between 1e-100 and 1e"),
        (lambda: RightColumns([0], [1.0], [-0.1]), InputError, "RightColumns.baseline must be positive"),
        (lambda: LineDepths([0], [[1, 1]], [[1, 0]], [0.1]), InputError, "LineDepths.sigma must be positive"),
        (lambda: PlaneObservations([0], [0], [[0, 0, 2, 0]], [np.eye(3)]), InputError, "must be unit vectors"),
        (lambda: Relations(line_on_plane=[[0, 0]], line_on_plane_sigma=[1, 2]), ShapeError, "one row for each of 1"),
        (lambda: Relations(line_on_plane=[[0, 0]], line_on_plane_sigma=[-1]), InputError, "must not be negative"),
    ],
)
def test_messages(make, error, message):
    with pytest.raises(error, match=message):
        make()


def test_a_scene_is_shown_with_its_measurements(scene):
    assert repr(scene).endswith("line depths, 24 plane observations, 12 pose priors)")
    assert scene.is_metric and not holistic(6, seed=0).truth.is_metric
