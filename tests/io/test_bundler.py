# SPDX-License-Identifier: BSD-3-Clause
"""Bundler files, written here by the formulas of its manual: P = R X + t, p = -P / P.z, p' = f r(p) p, y up."""

import numpy as np
import pytest
from _views import HEIGHT, WIDTH, check_poses, errors, photographs, views

from groma.errors import FileFormatError
from groma.io import read_bundler, read_scene, write_scene

NAMES = [f"photos/{row}.jpg" for row in range(4)]
LENS = (500.0, -0.1, 0.03)
#: A camera of Bundler looks along -z with y up.
BACK = np.diag([1.0, -1.0, -1.0])


def project(point: np.ndarray) -> np.ndarray:
    focal, k1, k2 = LENS
    flat = -point[:2] / point[2]
    squared = flat @ flat
    return focal * (1.0 + k1 * squared + k2 * squared**2) * flat


def bundle(true, lost: int | None = None) -> str:
    rows = ["# Bundle file v0.3", f"{len(true.rotation)} {len(true.points)}"]
    for row, (rotation, translation) in enumerate(zip(true.rotation, true.translation, strict=True)):
        lens = (0.0, 0.0, 0.0) if row == lost else LENS
        rows += [" ".join(map(repr, lens))]
        rows += [" ".join(map(repr, line)) for line in np.vstack([BACK @ rotation, BACK @ translation]).tolist()]
    for number, (place, color) in enumerate(zip(true.points.tolist(), true.color.tolist(), strict=True)):
        rows += [" ".join(map(repr, place)), " ".join(map(str, color))]
        seen = [row for row in range(len(true.rotation)) if row != lost]
        pixels = [project(BACK @ true.in_cam[row, number]).tolist() for row in seen]
        rows.append(
            f"{len(seen)} " + " ".join(f"{row} {number} {u!r} {v!r}" for row, (u, v) in zip(seen, pixels, strict=True))
        )
    return "\n".join(rows) + "\n"


@pytest.fixture
def true():
    return views()


def test_without_photographs_pixels_count_from_the_centre(true, tmp_path):
    (tmp_path / "bundle.out").write_text(bundle(true))
    with pytest.warns(UserWarning, match=r"no list of its images beside it \(list.txt, .*00000000.jpg and"):
        scene = read_scene(tmp_path / "bundle.out")
    assert errors(scene).max() < 1e-9
    check_poses(scene, true)
    assert set(scene.cameras.models) == {"BAL"} and scene.cameras.width.max() == 0
    assert scene.images.names[3] == "00000003.jpg"
    np.testing.assert_allclose(scene.points.xyz, true.points, atol=1e-12)
    np.testing.assert_array_equal(scene.points.color, true.color)


@pytest.mark.parametrize("listed", ["list.txt", "prepare/list.txt"])
def test_with_photographs_pixels_count_from_the_corner(true, tmp_path, listed):
    """The image centre of Bundler is half the size; v grows downwards here."""
    photographs(tmp_path, NAMES)
    (tmp_path / listed).parent.mkdir(exist_ok=True)
    (tmp_path / listed).write_text("".join(f"./{name} 0 532.5\n" for name in NAMES))
    (tmp_path / "bundle").mkdir()
    (tmp_path / "bundle" / "bundle.out").write_text(bundle(true))
    scene = read_scene(tmp_path / "bundle")
    assert errors(scene).max() < 1e-9
    check_poses(scene, true)
    assert scene.images.names == tuple(NAMES)
    assert scene.cameras.models == ("RADIAL",) * 4
    assert scene.cameras.params_of(1).tolist() == [500.0, WIDTH / 2, HEIGHT / 2, -0.1, 0.03]
    u, v = project(BACK @ true.in_cam[0, 0])
    first = (scene.point_observations.image_idx == 0) & (scene.point_observations.point_idx == 0)
    np.testing.assert_allclose(scene.point_observations.pixel[first], [[WIDTH / 2 + u, HEIGHT / 2 - v]], atol=1e-9)


def test_a_camera_that_was_not_reconstructed_is_left_out(true, tmp_path):
    (tmp_path / "bundle.out").write_text(bundle(true, lost=1))
    (tmp_path / "list.txt").write_text("".join(f"./{name}\n" for name in NAMES))
    scene = read_bundler(tmp_path / "bundle.out")
    assert scene.images.names == (NAMES[0], NAMES[2], NAMES[3])
    check_poses(scene, true, [0, 2, 3])
    assert errors(scene).max() < 1e-9 and len(scene.point_observations) == 3 * len(true.points)


def test_it_becomes_a_colmap_model(true, tmp_path):
    photographs(tmp_path, NAMES)
    (tmp_path / "list.txt").write_text("\n".join(NAMES))
    (tmp_path / "bundle.out").write_text(bundle(true))
    write_scene(read_scene(tmp_path / "bundle.out"), tmp_path / "model")
    assert errors(read_scene(tmp_path / "model")).max() < 1e-9


def test_photographs_outside_of_the_folder_are_not_opened(true, tmp_path):
    photographs(tmp_path, NAMES)
    (tmp_path / "inner").mkdir()
    (tmp_path / "inner" / "list.txt").write_text("".join(f"../{name}\n" for name in NAMES))
    (tmp_path / "inner" / "bundle.out").write_text(bundle(true))
    assert read_scene(tmp_path / "inner" / "bundle.out").cameras.width.max() == 0


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("4 12\n", "4 13\n", "point 13 of 13"),
        ("4 12\n", "4 11\n", "numbers too many"),
        ("4 12\n", "9000000000 12\n", "promises 9000000000 cameras"),
        ("4 12\n", "four 12\n", "how many cameras"),
        ("500.0", "nan", "not finite"),
        ("500.0", "-500.0", "positive focal lengths"),
        ("\n4 0 0 ", "\n4 7 0 ", "image 7, but there are 4"),
        ("\n4 0 0 ", "\n4 0.5 0 ", "not whole"),
    ],
)
def test_damage_is_named(true, tmp_path, old, new, words):
    text = bundle(true)
    assert old in text
    (tmp_path / "bundle.out").write_text(text.replace(old, new, 1))
    with pytest.raises(FileFormatError, match=words):
        read_scene(tmp_path / "bundle.out")


def test_a_matrix_that_is_no_rotation_is_named(true, tmp_path):
    true.rotation[2] *= 1.1
    (tmp_path / "bundle.out").write_text(bundle(true))
    with pytest.raises(FileFormatError, match="image 3 stretches"):
        read_scene(tmp_path / "bundle.out")
    true.rotation[2] *= -1 / 1.1
    (tmp_path / "bundle.out").write_text(bundle(true))
    with pytest.raises(FileFormatError, match="image 3 mirrors"):
        read_scene(tmp_path / "bundle.out")


def test_a_list_of_other_images_is_refused(true, tmp_path):
    (tmp_path / "bundle.out").write_text(bundle(true))
    (tmp_path / "list.txt").write_text("a.jpg\nb.jpg\n")
    with pytest.raises(FileFormatError, match="should name 4 images"):
        read_scene(tmp_path / "bundle.out")
