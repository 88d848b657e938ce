# SPDX-License-Identifier: BSD-3-Clause
"""Round trips: COLMAP (binary, text, rigs, structures, pycolmap in memory), BAL, archive, TUM; PLY and OBJ content.

Also: which format is recognised, what a format refuses, and numbers known for the shared data.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from _comparison import equal
from _models import rig_scene

from groma import cameras
from groma.errors import FileFormatError, GromaError, InputError, OutputError
from groma.geometry import se3
from groma.io import (
    Trajectory,
    check_target,
    from_pycolmap,
    read_bal,
    read_colmap,
    read_scene,
    read_tum,
    to_pycolmap,
    write_archive,
    write_colmap,
    write_scene,
    write_tum,
)
from groma.scene import Cameras, Scene
from groma.scene.survey import Kind
from groma.scene.synthetic.scenes import holistic

BAL = Path(__file__).parents[1] / "data" / "bal"


@pytest.mark.parametrize("form", ["binary", "text"])
def test_colmap_round_trip_is_exact(tmp_path, form):
    scene = rig_scene()
    write_colmap(scene, tmp_path / "model", form=form)
    result = equal(scene, read_scene(tmp_path / "model"))
    assert result, result.reason


def test_text_model_refuses_names_with_spaces(tmp_path):
    scene = rig_scene()
    scene = scene.replace(images=scene.images.replace(names=("a b", "c", "d", "e", "f")))
    write_colmap(scene, tmp_path / "binary")
    assert equal(scene, read_colmap(tmp_path / "binary"))
    with pytest.raises(InputError, match="white space"):
        write_colmap(scene, tmp_path / "text", form="text")


def test_names_with_spaces_are_read_whole_from_text_models_of_others(tmp_path):
    import pycolmap

    names = ("set 1/a  b.png", "c.png", "d e", "é f", "g")
    scene = rig_scene()
    write_colmap(scene.replace(images=scene.images.replace(names=names)), tmp_path / "binary")
    (tmp_path / "text").mkdir()
    pycolmap.Reconstruction(str(tmp_path / "binary")).write_text(str(tmp_path / "text"))
    assert read_colmap(tmp_path / "text").images.names == names


def test_colmap_poses_are_those_of_pycolmap(tmp_path):
    import pycolmap

    scene = rig_scene()
    write_colmap(scene, tmp_path / "model")
    model = pycolmap.Reconstruction(str(tmp_path / "model"))
    assert (len(model.rigs), len(model.frames), len(model.images)) == (2, 3, 5)
    for row, number in enumerate(scene.images.ids.tolist()):
        matrix = se3.to_matrix(scene.cam_from_world[row])[:3]
        np.testing.assert_allclose(model.images[number].cam_from_world().matrix(), matrix, atol=1e-13)
        assert model.images[number].num_points2D() == 4
        assert model.images[number].num_points3D == 3
    assert {element.image_id for element in model.points3D[4].track.elements} == {10, 11, 12, 13, 20}


def test_binary_models_are_the_files_that_pycolmap_writes(tmp_path):
    """Points are written as arrays, all else by pycolmap; landmarks that no image sees and free 2D points, too."""
    scene = rig_scene().points_only()
    unseen = scene.point_observations.point_idx != 1
    scene = scene.replace(point_observations=scene.point_observations.take(np.flatnonzero(unseen)))
    assert len(scene.keypoints) > 0
    for name, one in (("model", scene), ("none", scene.keep(points=[]))):
        write_colmap(one, tmp_path / name)
        (tmp_path / f"{name} by pycolmap").mkdir()
        to_pycolmap(one).write_binary(str(tmp_path / f"{name} by pycolmap"))
        for file in (tmp_path / f"{name} by pycolmap").iterdir():
            assert (tmp_path / name / file.name).read_bytes() == file.read_bytes(), file.name


def test_binary_models_are_read_as_pycolmap_reads_them(tmp_path):
    """2D points are taken from the file, all else from pycolmap; those without a point in space are keypoints."""
    import pycolmap

    scene = rig_scene().points_only()
    write_colmap(scene, tmp_path / "model")
    found, expected = read_colmap(tmp_path / "model"), from_pycolmap(pycolmap.Reconstruction(str(tmp_path / "model")))
    assert len(found.keypoints) > 0
    result = equal(found, expected)
    assert result, result.reason


def test_colmap_model_is_found_in_sparse_folders(tmp_path):
    scene = rig_scene().points_only()
    (tmp_path / "one").mkdir()
    write_colmap(scene, tmp_path / "one" / "sparse")
    (tmp_path / "two" / "sparse").mkdir(parents=True)
    write_colmap(scene, tmp_path / "two" / "sparse" / "0", form="text")
    assert equal(scene, read_colmap(tmp_path / "one"))
    assert equal(scene, read_colmap(tmp_path / "two"))
    assert equal(scene, read_scene(tmp_path / "one" / "sparse" / "cameras.bin"))


def test_structures_follow_identifiers_when_the_model_changes(tmp_path):
    scene = rig_scene()
    write_colmap(scene, tmp_path / "model")
    write_colmap(scene.points_only().subset([2, 4, 0]), tmp_path / "fewer")
    os.replace(tmp_path / "model" / "structures", tmp_path / "fewer" / "structures")
    read = read_colmap(tmp_path / "fewer")
    assert read.images.ids[read.line_observations.image_idx].tolist() == [10, 12, 20]
    assert read.points.ids[read.relations.point_on_line[:, 0]].tolist() == [1000]
    assert read.num_lines == 2


def test_keypoint_numbers_close_up_after_points_are_dropped(tmp_path):
    scene = rig_scene().points_only()
    kept = scene.point_observations.point_idx != 0
    fewer = scene.replace(point_observations=scene.point_observations.take(kept))
    read = from_pycolmap(to_pycolmap(fewer))
    assert read.point_observations.keypoint_idx.tolist() == [0, 1] * 5
    np.testing.assert_array_equal(read.point_observations.pixel, fewer.point_observations.pixel)


def test_images_without_pose_are_left_out():
    import pycolmap

    model = to_pycolmap(rig_scene())
    model.deregister_frame(6)
    scene = from_pycolmap(model)
    assert scene.images.ids.tolist() == [10, 11, 20]
    assert isinstance(model, pycolmap.Reconstruction)


def test_unknown_camera_model_is_named(monkeypatch):
    import pycolmap

    known = tuple(model for model in cameras.models() if model.name != "FOV")
    monkeypatch.setattr("groma.cameras.models", lambda: known)

    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera.create_from_model_name(1, "FOV", 500.0, 640, 480)
    model.add_camera_with_trivial_rig(camera)
    with pytest.raises(InputError, match="FOV"):
        from_pycolmap(model)


@pytest.mark.parametrize("form", ["binary", "text"])
def test_every_camera_model_of_colmap_goes_there_and_back(tmp_path, form):
    """Models are numbered, named and filled as pycolmap does; parameters come back to the last digit."""
    import pycolmap

    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction()
    kinds = [kind for name, kind in pycolmap.CameraModelId.__members__.items() if name != "INVALID"]
    for number, kind in enumerate(kinds, 1):
        camera = pycolmap.Camera.create_from_model_id(number, kind, 500.0, 640, 480)
        camera.params = camera.params + rng.uniform(0.0, 0.1, len(camera.params))
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{number}.png", camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    (tmp_path / "theirs").mkdir()
    (model.write_binary if form == "binary" else model.write_text)(str(tmp_path / "theirs"))
    scene = read_colmap(tmp_path / "theirs")
    assert len(scene.cameras) == 18
    write_colmap(scene, tmp_path / "ours", form)
    back = pycolmap.Reconstruction(str(tmp_path / "ours"))
    for number, kind in enumerate(kinds, 1):
        assert back.cameras[number].model == kind
        np.testing.assert_array_equal(back.cameras[number].params, model.cameras[number].params)
        assert scene.cameras.models[number - 1] == kind.name
        np.testing.assert_array_equal(scene.cameras.params_of(number - 1), model.cameras[number].params)


def test_archive_round_trip_is_exact_and_repeats(tmp_path):
    for scene in (rig_scene(), Scene(), holistic(6, seed=3).truth, read_bal(BAL / "dubrovnik-3-7-pre.txt")):
        path = tmp_path / "scene.npz"
        write_scene(scene, path, force=True)
        result = equal(scene, read_scene(path))
        assert result, result.reason
        first = path.read_bytes()
        write_scene(scene, path, force=True)
        assert path.read_bytes() == first


def test_archive_opens_in_numpy_and_holds_no_pickle(tmp_path):
    scene = rig_scene()
    write_archive(scene, tmp_path / "scene.npz")
    with np.load(tmp_path / "scene.npz", allow_pickle=False) as file:
        np.testing.assert_array_equal(file["points.xyz"], scene.points.xyz)
        assert file["images.names"].tolist() == list(scene.images.names)


def _changed(tmp_path: Path, **changes: object) -> Path:
    """Write an archive with some arrays replaced (or left out: None)."""
    write_archive(rig_scene(), tmp_path / "good.npz", force=True)
    with np.load(tmp_path / "good.npz") as file:
        arrays = {name: file[name] for name in file.files}
    arrays |= {name.replace("__", "."): value for name, value in changes.items()}
    np.savez(tmp_path / "bad.npz", **{name: value for name, value in arrays.items() if value is not None})
    return tmp_path / "bad.npz"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points__xyz": None}, "points.xyz is missing"),
        ({"points__xyz": np.zeros((3, 2))}, "must have shape"),
        ({"points__xyz": np.zeros((2, 3))}, "equally long"),
        ({"points__xyz": np.zeros((3, 3), np.float32)}, "dtype float64"),
        ({"points__xyz": np.full((3, 3), np.nan)}, "must be finite"),
        ({"points__ids": np.array([1, 1, 2])}, "unique"),
        ({"images__names": np.arange(5)}, "must hold text"),
        ({"images__names": np.array([{}] * 5, object)}, "numbers or text"),
        ({"point_observations__point_idx": np.full(15, 3)}, "not in the scene"),
        ({"relations__point_on_plane": np.array([[0, 1]])}, "not in the scene"),
        ({"frames__rig_from_world": np.ones((3, 7))}, "unit quaternion"),
        ({"version": np.array(99)}, "Update groma"),
        ({"format": np.array("other")}, "not a groma archive"),
        ({"cameras__models": np.array(["X", "Y", "Z"])}, "bad.npz"),
        ({"camera_distances__first_idx": np.array([0])}, "camera_distances.second_idx is missing"),
        ({"barometers__image_idx": np.array([0])}, "'barometers.image_idx', which this groma does not know"),
    ],
)
def test_archive_messages(tmp_path, changes, message):
    path = _changed(tmp_path, **changes)
    with pytest.raises(FileFormatError, match=message) as refused:
        read_scene(path)
    assert str(path) in str(refused.value)


def test_distances_of_earlier_archives_are_read(tmp_path):
    """Archives once held distances in two tables; read as none, these rows would be gone after the next write."""
    bars = {"first_idx": np.array([0, 3]), "second_idx": np.array([1, 2]), "distance": np.array([2.0, 3.0])}
    arrays = {f"camera_distances__{name}": column for name, column in bars.items()}
    path = _changed(tmp_path, **arrays, camera_distances__sigma=np.array([0.01, 0.02]))
    table = read_scene(path).distances
    np.testing.assert_array_equal(table.first_kind, [Kind.IMAGE] * 2)
    np.testing.assert_array_equal(table.second_kind, [Kind.IMAGE] * 2)
    for name, column in bars.items():
        np.testing.assert_array_equal(getattr(table, name), column)
    np.testing.assert_array_equal(table.sigma, [0.01, 0.02])
    write_scene(read_scene(path), tmp_path / "new.npz")
    np.testing.assert_array_equal(read_scene(tmp_path / "new.npz").distances.distance, [2.0, 3.0])
    both = _changed(
        tmp_path,
        **arrays,
        camera_distances__sigma=np.ones(2),
        point_distances__first_idx=np.array([0]),
        point_distances__second_idx=np.array([1]),
        point_distances__distance=np.array([0.5]),
        point_distances__sigma=np.array([0.1]),
        control_points__names=np.array(["a", "b"]),
        control_points__xyz=np.zeros((2, 3)),
        control_points__measured=np.zeros((2, 3)),
        control_points__covariance=np.tile(np.eye(3), (2, 1, 1)),
        control_points__role=np.zeros(2, np.int64),
    )
    assert read_scene(both).distances.first_kind.tolist() == [Kind.IMAGE] * 2 + [Kind.CONTROL_POINT]


@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("cameras.txt", "30 PINHOLE wide 480 1 1 1 1"),
        ("images.txt", "1 0 0 x 0 1 0 0 1 a.jpg"),
        ("points3D.txt", "7 nan 0 0 1 2 3 0.5 1 0"),
        ("points3D.txt", "7 1 0 0 1 2"),
    ],
)
def test_damaged_text_models_name_the_line(tmp_path, name, row):
    write_colmap(rig_scene(), tmp_path / "model", "text")
    path = tmp_path / "model" / name
    text = path.read_text()
    path.write_text(f"{text}{row}\n")
    with pytest.raises(FileFormatError) as caught:
        read_colmap(tmp_path / "model")
    number = text.count("\n") + 1
    assert f"damaged in {name}, line {number}: {row!r}" in str(caught.value)


def test_empty_binary_files_are_incomplete(tmp_path):
    write_colmap(rig_scene(), tmp_path / "model")
    (tmp_path / "model" / "frames.bin").write_bytes(b"")
    with pytest.raises(FileFormatError, match="ends after 0 bytes"):
        read_colmap(tmp_path / "model")


def test_what_a_target_can_hold_is_known_before(tmp_path):
    scene = rig_scene()
    assert check_target(scene, tmp_path / "a.npz") == "archive"
    assert check_target(scene, tmp_path / "a") == check_target(scene, tmp_path) == "colmap"
    assert check_target(scene, "a", "colmap_text") == "colmap_text"
    for path, words in (("a.xyz", "'.xyz'"), ("a.txt", "BAL")):
        with pytest.raises(InputError, match=words):
            check_target(scene, path)


def test_read_scene_says_what_it_wants(tmp_path):
    (tmp_path / "picture.jpg").write_bytes(b"\xff\xd8\xff\xe0 no scene")
    (tmp_path / "empty.npz").write_bytes(b"")
    (tmp_path / "folder").mkdir()
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "a.JPG").touch()
    (tmp_path / "maps" / "castle").mkdir(parents=True)
    for name in ("castle.index.npz", "castle/cameras.bin"):
        (tmp_path / "maps" / name).touch()
    for name, error, message in [
        ("nothing", InputError, "Cannot read"),
        ("picture.jpg", FileFormatError, "is not a scene"),
        ("empty.npz", FileFormatError, "groma archive"),
        ("folder", FileFormatError, "holds no COLMAP model: .* Check the path"),
        ("pictures", FileFormatError, "holds no COLMAP model: .* groma map"),
        ("maps", FileFormatError, "It holds castle: pass .*castle, for example"),  # the index of a map is no scene
        ("bad\0name", InputError, "Cannot read"),
    ]:
        with pytest.raises(error, match=message):
            read_scene(tmp_path / name)
    with pytest.raises(InputError, match=r"Cannot tell the format.*; \.glb or \.gltf for glTF; "):
        write_scene(Scene(), tmp_path / "scene.xyz")


def test_writers_refuse_to_overwrite(tmp_path):
    for name in ("a.npz", "a.txt", "a.ply", "a.obj", "model"):
        write_scene(Scene(), tmp_path / name)
        with pytest.raises(OutputError, match="exists already"):
            write_scene(Scene(), tmp_path / name)
        write_scene(Scene(), tmp_path / name, force=True)


def test_tum_round_trip(tmp_path):
    poses = rig_scene().frames.rig_from_world
    write_tum(Trajectory([0.5, 1.25, 1e9 + 0.125], poses), tmp_path / "t.txt")
    (tmp_path / "t.txt").write_text("# time tx ty tz\n\n" + (tmp_path / "t.txt").read_text())
    read = read_tum(tmp_path / "t.txt")
    np.testing.assert_allclose(read.world_from_cam, poses, rtol=0, atol=1e-15)
    assert read.timestamps[2] == 1e9 + 0.125
    for text in ("1 2 3\n", "0 0 0 0 0 0 0 0\n", "x 0 0 0 0 0 0 1\n", "0 nan 0 0 0 0 0 1\n"):
        (tmp_path / "bad.txt").write_text(text)
        with pytest.raises(FileFormatError):
            read_tum(tmp_path / "bad.txt")


def test_pycolmap_imported_first_does_no_harm(tmp_path):
    # pycolmap 4.2 breaks zlib's compression when it is imported before it; see groma.io.archive.
    code = (
        "import pycolmap, sys\n"
        "from groma.io import read_scene, write_scene\n"
        "from groma.errors import OutputError\n"
        f"scene = read_scene({str(BAL / 'dubrovnik-3-7-pre.txt')!r})\n"
        f"write_scene(scene, {str(tmp_path / 'a.npz')!r})\n"
        f"write_scene(read_scene({str(tmp_path / 'a.npz')!r}), {str(tmp_path / 'a.bz2')!r})\n"
        "try:\n"
        f"    write_scene(scene, {str(tmp_path / 'a.gz')!r})\n"
        "except OutputError as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert (tmp_path / "a.npz").exists() and (tmp_path / "a.bz2").exists()
    assert (tmp_path / "a.gz").exists() or "before zlib" in done.stdout


def test_camera_params_are_checked():
    with pytest.raises(GromaError, match="4 parameters"):
        Cameras([1], ("PINHOLE",), [[1.0, 2.0, 3.0]], [0], [0])
    with pytest.raises(GromaError, match="must be zero"):
        Cameras([1], ("SIMPLE_PINHOLE",), [[1.0, 2.0, 3.0, 4.0]], [0], [0])


@pytest.mark.shared
def test_castle_is_read_whole(shared_data, tmp_path):
    scene = read_scene(shared_data / "strecha_castle_p30" / "sparse_inc")
    assert (scene.num_images, scene.num_points, scene.num_observations) == (30, 24327, 120003)
    write_colmap(scene, tmp_path / "text", form="text")
    result = equal(scene, read_colmap(tmp_path / "text"))
    assert result, result.reason
