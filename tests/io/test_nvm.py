# SPDX-License-Identifier: BSD-3-Clause
"""NVM files, written here from VisualSFM's formula: f x/z = (1 + r (u^2 + v^2) / f^2) u, from the image centre."""

import numpy as np
import pytest
from _views import HEIGHT, WIDTH, check_poses, errors, photographs, views

from groma.errors import FileFormatError
from groma.io import read_nvm, read_scene

NAMES = [f"photos/{row} a.jpg" for row in range(4)]
FOCAL = 400.0


def distort(ray: np.ndarray, coefficient: float) -> np.ndarray:
    """Solve m (1 + r m^2) = |ray| for the radius m by bisection, which knows nothing of series or fits."""
    radius = np.linalg.norm(ray)
    low, high = 0.0, 3.0 * radius
    for _ in range(200):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if middle * (1 + coefficient * middle**2) < radius else (low, middle)
    return low / radius * ray


def quaternion_wxyz(rotation: np.ndarray) -> np.ndarray:
    """Return the quaternion of a rotation by less than pi."""
    w = 0.5 * np.sqrt(1.0 + np.trace(rotation))
    skew = (rotation - rotation.T) / (4.0 * w)
    return np.array([w, skew[2, 1], skew[0, 2], skew[1, 0]])


def points_text(true, pixels) -> list[str]:
    rows = [str(len(true.points))]
    for number, (place, color) in enumerate(zip(true.points.tolist(), true.color.tolist(), strict=True)):
        seen = " ".join(f"{row} {number} {u!r} {v!r}" for row, (u, v) in enumerate(pixels[:, number].tolist()))
        rows.append(f"{' '.join(map(repr, place))} {' '.join(map(str, color))} {len(pixels)} {seen}")
    return rows


def nvm(true, coefficient: float, head: str = "NVM_V3", tab: str = "\t") -> str:
    rows = [head, "", str(len(true.rotation))]
    for name, rotation, center in zip(NAMES, true.rotation, true.center, strict=True):
        numbers = [FOCAL, *quaternion_wxyz(rotation).tolist(), *center.tolist(), coefficient]
        rows.append(f"{name}{tab}{' '.join(map(repr, numbers))} 0")
    rays = true.in_cam[..., :2] / true.in_cam[..., 2:]
    pixels = FOCAL * np.array([[distort(ray, coefficient) for ray in image] for image in rays])
    return "\n".join([*rows, *points_text(true, pixels), "0", "# the end", "0"]) + "\n"


@pytest.fixture
def true():
    return views()


@pytest.mark.parametrize("coefficient", [0.0, -0.08, 0.05, 0.3, 1e-9])
def test_pixels_are_reproduced_through_the_inverse_polynomial(true, tmp_path, coefficient):
    photographs(tmp_path, NAMES)
    (tmp_path / "a.nvm").write_text(nvm(true, coefficient))
    scene = read_scene(tmp_path / "a.nvm")
    assert errors(scene).max() < 1e-3
    check_poses(scene, true)
    assert scene.images.names == tuple(NAMES)
    assert set(scene.cameras.models) == {"SIMPLE_PINHOLE" if coefficient == 0.0 else "FULL_OPENCV"}
    shifted = scene.point_observations.pixel - [WIDTH / 2, HEIGHT / 2]
    ray = true.in_cam[scene.point_observations.image_idx, scene.point_observations.point_idx]
    expected = FOCAL * np.array([distort(one[:2] / one[2], coefficient) for one in ray])
    np.testing.assert_allclose(shifted, expected, atol=1e-9)


def test_without_photographs_pixels_count_from_the_centre(true, tmp_path):
    (tmp_path / "a.nvm").write_text(nvm(true, 0.05, tab=" "))
    scene = read_nvm(tmp_path / "a.nvm")
    assert errors(scene).max() < 1e-3
    assert scene.cameras.width.max() == 0 and scene.images.names == tuple(NAMES)
    np.testing.assert_array_equal(scene.points.color, true.color)


def test_a_fixed_calibration_is_that_of_all_images(true, tmp_path):
    """Pixels then count from the principal point."""
    photographs(tmp_path, NAMES)
    fx, cx, fy, cy = 410.0, 330.0, 405.0, 235.0
    rows = [f"NVM_V3 FixedK {fx} {cx} {fy} {cy}", "", "4"]
    for name, rotation, center in zip(NAMES, true.rotation, true.center, strict=True):
        rows.append(f"{name}\t{fx} {' '.join(map(repr, [*quaternion_wxyz(rotation).tolist(), *center.tolist()]))} 0 0")
    pixels = true.in_cam[..., :2] / true.in_cam[..., 2:] * [fx, fy]
    (tmp_path / "a.nvm").write_text("\n".join([*rows, *points_text(true, pixels)]))
    scene = read_scene(tmp_path / "a.nvm")
    assert errors(scene).max() < 1e-9
    assert scene.cameras.params_of(2).tolist() == [fx, fy, cx, cy]
    photographs(tmp_path, NAMES)
    for name in NAMES:
        (tmp_path / name).unlink()
    assert errors(read_scene(tmp_path / "a.nvm")).max() < 1e-9


def test_matrices_and_translations(true, tmp_path):
    rows = ["NVM_V3_R9T", "", "4"]
    for name, rotation, shift in zip(NAMES, true.rotation, true.translation, strict=True):
        numbers = [FOCAL, *rotation.ravel().tolist(), *shift.tolist(), 0.0]
        rows.append(f"{name}\t{' '.join(map(repr, numbers))} 0")
    pixels = FOCAL * true.in_cam[..., :2] / true.in_cam[..., 2:]
    (tmp_path / "a.nvm").write_text("\n".join([*rows, *points_text(true, pixels)]))
    scene = read_scene(tmp_path / "a.nvm")
    check_poses(scene, true)
    assert errors(scene).max() < 1e-9


def test_the_largest_of_several_models_is_read(true, tmp_path):
    whole = nvm(true, 0.0).split("\n")
    small = ["1", f"lone.jpg\t{FOCAL} 1 0 0 0 0 0 0 0 0", "0", ""]
    (tmp_path / "a.nvm").write_text("\n".join([whole[0], *small, *whole[1:]]))
    with pytest.warns(UserWarning, match=r"2 reconstructions .* \(4\) is read, the other \(1 image\) is not"):
        assert read_scene(tmp_path / "a.nvm").images.names == tuple(NAMES)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("\n4\n", "\n5\n", "camera 5: expected a name"),
        ("\n4\n", "\n400\n", "ends before its points"),
        ("\n4\n", "\n0\n", "no cameras"),
        ("\n4\n", "\nfour\n", "a number of cameras"),
        ("\n12\n", "\n99\n", "promises 99 points"),
        ("\n12\n", "\n11\n", "a number of cameras"),
        ("400.0", "-400.0", "positive focal lengths"),
        ("400.0", "nan", "finite"),
        (" 4 0 0 ", " 4 9 0 ", "image 9, but there are 4"),
        (" 4 0 0 ", " 5 0 0 ", "point 1 of 12|list is damaged|names an image"),
    ],
)
def test_damage_is_named(true, tmp_path, old, new, words):
    text = nvm(true, 0.05)
    assert old in text
    (tmp_path / "a.nvm").write_text(text.replace(old, new, 1))
    with pytest.raises(FileFormatError, match=words):
        read_scene(tmp_path / "a.nvm")


def test_a_lens_that_folds_the_image_is_named(true, tmp_path):
    photographs(tmp_path, NAMES)
    (tmp_path / "a.nvm").write_text(nvm(true, 0.0).replace(" 0.0 0\n", " -0.9 0\n"))
    with pytest.raises(FileFormatError, match="folds the image"):
        read_scene(tmp_path / "a.nvm")
