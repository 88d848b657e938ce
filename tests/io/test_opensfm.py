# SPDX-License-Identifier: BSD-3-Clause
"""OpenSfM files, written here by the formulas of its documentation, and the result that comes with its samples."""

import json

import numpy as np
import pytest
from _views import check_poses, errors, views

from groma.errors import FileFormatError
from groma.io import read_colmap, read_opensfm_reconstructions, read_scene, write_scene

SIZE = (640, 480)
#: What a camera says, by projection type, and the model that it becomes.
CAMERAS = {
    "perspective": ({"focal": 0.8, "k1": -0.1, "k2": 0.02}, "RADIAL"),
    "simple_radial": ({"focal_x": 0.8, "focal_y": 0.8, "c_x": 0.01, "c_y": -0.02, "k1": -0.1}, "SIMPLE_RADIAL"),
    "radial": ({"focal_x": 0.8, "focal_y": 0.79, "c_x": 0.01, "c_y": -0.02, "k1": -0.1, "k2": 0.03}, "OPENCV"),
    "brown": (
        {"focal_x": 0.8, "focal_y": 0.79, "c_x": 0.01, "c_y": -0.02, "k1": -0.1, "k2": 0.03, "k3": -0.01}
        | {"p1": 0.003, "p2": -0.002},
        "FULL_OPENCV",
    ),
    "fisheye": ({"focal": 0.8, "k1": -0.05, "k2": 0.02}, "RADIAL_FISHEYE"),
    "fisheye_opencv": (
        {
            "focal_x": 0.8,
            "focal_y": 0.79,
            "c_x": 0.01,
            "c_y": -0.02,
            "k1": 0.05,
            "k2": -0.01,
            "k3": 0.002,
            "k4": -0.001,
        },
        "OPENCV_FISHEYE",
    ),
    "spherical": ({}, "EQUIRECTANGULAR"),
}


def project(kind: str, said: dict, point: np.ndarray) -> np.ndarray:
    """Return normalised image coordinates."""
    if kind == "spherical":
        across, up = np.arctan2(point[0], point[2]), np.arctan2(-point[1], np.hypot(point[0], point[2]))
        return np.array([across, -up]) / (2 * np.pi)
    x, y = point[:2] / point[2]
    focal = np.array([said.get("focal_x", said.get("focal")), said.get("focal_y", said.get("focal"))])
    center = np.array([said.get("c_x", 0.0), said.get("c_y", 0.0)])
    k = [said.get(f"k{order}", 0.0) for order in range(1, 5)]
    radius = np.hypot(x, y)
    bend = np.arctan(radius) if kind.startswith("fisheye") else radius
    grown = bend / radius * (1 + sum(value * bend ** (2 * order + 2) for order, value in enumerate(k)))
    p1, p2 = said.get("p1", 0.0), said.get("p2", 0.0)
    shift = [2 * p1 * x * y + p2 * (radius**2 + 2 * x * x), 2 * p2 * x * y + p1 * (radius**2 + 2 * y * y)]
    return focal * (grown * np.array([x, y]) + shift) + center


def rotation_vector(rotation: np.ndarray) -> list[float]:
    angle = np.arccos(0.5 * (np.trace(rotation) - 1.0))
    skew = (rotation - rotation.T) / (2.0 * np.sin(angle))
    return (angle * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])).tolist()


def reconstruction(true, kind: str, said: dict) -> dict:
    size = (640, 320) if kind == "spherical" else SIZE
    return {
        "cameras": {"lens": {"projection_type": kind, "width": size[0], "height": size[1], **said}},
        "shots": {
            f"{row} x.jpg": {
                "rotation": rotation_vector(true.rotation[row]),
                "translation": true.translation[row].tolist(),
                "camera": "lens",
                "gps_dop": 5.0,
            }
            for row in range(len(true.rotation))
        },
        "points": {
            str(100 + number): {"coordinates": place, "color": [float(shade) for shade in color]}
            for number, (place, color) in enumerate(zip(true.points.tolist(), true.color.tolist(), strict=True))
        },
    }


def tracks(true, kind: str, said: dict, version: int) -> str:
    rows = [f"OPENSFM_TRACKS_VERSION_v{version}"] if version else []
    last = {0: ["7", "8", "9"], 1: ["0.002", "7", "8", "9"], 2: ["0.002", "7", "8", "9", "-1", "-1"]}[version]
    for row in range(len(true.rotation)):
        for number in range(len(true.points)):
            x, y = project(kind, said, true.in_cam[row, number]).tolist()
            rows.append("\t".join([f"{row} x.jpg", str(100 + number), str(number), repr(x), repr(y), *last]))
        rows.append("\t".join([f"{row} x.jpg", "999", "99", "0.1", "0.1", *last]))  # a track without a point
    rows.append("\t".join(["lost.jpg", "100", "1", "0.1", "0.1", *last]))
    return "\n".join(rows) + "\n"


@pytest.fixture
def true():
    return views()


def write(folder, listed: list[dict], text: str | None = None, name: str = ""):
    (folder / f"reconstruction{name}.json").write_text(json.dumps(listed))
    if text is not None:
        (folder / f"tracks{name}.csv").write_text(text)
    return folder / f"reconstruction{name}.json"


@pytest.mark.parametrize("kind", CAMERAS)
def test_every_projection_type_reproduces_its_pixels(true, tmp_path, kind):
    said, model = CAMERAS[kind]
    scene = read_scene(write(tmp_path, [reconstruction(true, kind, said)], tracks(true, kind, said, 2)))
    assert scene.cameras.models == (model,)
    assert len(scene.point_observations) == 48 and errors(scene).max() < 1e-9
    check_poses(scene, true)
    assert scene.images.names[2] == "2 x.jpg" and scene.points.ids.tolist() == list(range(100, 112))
    np.testing.assert_array_equal(scene.points.color, true.color)
    width, height = (640, 320) if kind == "spherical" else SIZE
    first = (scene.point_observations.image_idx == 3) & (scene.point_observations.point_idx == 4)
    expected = max(width, height) * project(kind, said, true.in_cam[3, 4]) + [width / 2, height / 2]
    np.testing.assert_allclose(scene.point_observations.pixel[first][0], expected, atol=1e-9)


@pytest.mark.parametrize("version", [0, 1, 2])
def test_versions_of_the_tracks(true, tmp_path, version):
    said, _ = CAMERAS["perspective"]
    path = write(
        tmp_path, [reconstruction(true, "perspective", said)], tracks(true, "perspective", said, version), "_b"
    )
    scene = read_scene(path)
    assert len(scene.point_observations) == 48 and errors(scene).max() < 1e-9


def test_portrait_images_are_divided_by_their_height(true, tmp_path):
    said, _ = CAMERAS["brown"]
    found = reconstruction(true, "brown", said)
    found["cameras"]["lens"] |= {"width": 480, "height": 640}
    scene = read_scene(write(tmp_path, [found], tracks(true, "brown", said, 2)))
    assert errors(scene).max() < 1e-9
    assert scene.cameras.params_of(0)[:4].tolist() == pytest.approx([512.0, 505.6, 246.4, 307.2])


def test_a_brown_camera_without_k3_is_opencv(true, tmp_path):
    said = {name: value for name, value in CAMERAS["brown"][0].items() if name != "k3"}
    scene = read_scene(write(tmp_path, [reconstruction(true, "brown", said)], tracks(true, "brown", said, 2)))
    assert scene.cameras.models == ("OPENCV",) and errors(scene).max() < 1e-9


def test_of_several_reconstructions_the_largest_is_the_scene(true, tmp_path):
    said, _ = CAMERAS["perspective"]
    whole, part = (reconstruction(true, "perspective", said) for _ in range(2))
    for name in ("0 x.jpg", "3 x.jpg"):
        del part["shots"][name]
    whole["reference_lla"] = {"latitude": 52.5, "longitude": 13.4, "altitude": 30.0}
    path = write(tmp_path, [part, whole], tracks(true, "perspective", said, 2))
    with pytest.warns(UserWarning, match=r"most images \(4\) is read, the other \(2 images\) is not"):
        assert read_scene(tmp_path).num_images == 4
    first, second = read_opensfm_reconstructions(path)
    assert first.scene.images.names == ("1 x.jpg", "2 x.jpg") and first.reference_lla is None
    check_poses(first.scene, true, [1, 2])
    assert len(first.scene.point_observations) == 24 and errors(first.scene).max() < 1e-9
    assert second.reference_lla == (52.5, 13.4, 30.0)


def test_without_tracks_nothing_observes_the_points(true, tmp_path):
    scene = read_scene(write(tmp_path, [reconstruction(true, "perspective", CAMERAS["perspective"][0])]))
    assert (scene.num_images, scene.num_points, len(scene.point_observations)) == (4, 12, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (
            lambda one: one["cameras"]["lens"].update(projection_type="dual"),
            "'dual' is not read; known are perspective",
        ),
        (lambda one: one["cameras"]["lens"].pop("focal"), "expected 'focal_x', a finite number; got nothing"),
        (lambda one: one["cameras"]["lens"].update(width=0.5), "expected 'width', a size in pixels"),
        (lambda one: one["shots"]["1 x.jpg"].update(camera="other"), "taken by 'other'"),
        (lambda one: one["shots"]["1 x.jpg"].update(rotation=[1, 2]), "rotation of a shot: expected 3 finite numbers"),
        (lambda one: one["shots"].update({"1 x.jpg": 5}), r"expected an object \{...\}; got 5"),
        (lambda one: one["points"]["103"].update(coordinates=["1", "2", "3"]), "coordinates of a point: expected 3"),
        (lambda one: one["points"].update({"0100": one["points"]["100"]}), "the same identifier"),
    ],
)
def test_damage_is_named(true, tmp_path, change, words):
    one = reconstruction(true, "perspective", CAMERAS["perspective"][0])
    change(one)
    with pytest.raises(FileFormatError, match=words):
        read_scene(write(tmp_path, [one]))


def test_damaged_tracks_are_named(true, tmp_path):
    said, _ = CAMERAS["perspective"]
    text = tracks(true, "perspective", said, 2)
    for old, new, words in (
        ("\t100\t0\t", "\t100\t0\tnan\t", "x and y, finite numbers; got 'nan'"),
        ("_v2\n", "_v2\n0 x.jpg 100 0 0.1 0.1\n", "line 2: expected image, track, feature, x and y"),
        ("_v2", "_v9", "a version of tracks from 0 to 2"),
    ):
        with pytest.raises(FileFormatError, match=words):
            read_scene(write(tmp_path, [reconstruction(true, "perspective", said)], text.replace(old, new, 1)))


def test_a_panorama_of_another_shape_is_refused(true, tmp_path):
    one = reconstruction(true, "spherical", {})
    one["cameras"]["lens"]["height"] = 300
    with pytest.raises(FileFormatError, match="twice as wide as high; got 640x300"):
        read_scene(write(tmp_path, [one]))


@pytest.mark.shared
def test_the_sample_of_berlin(shared_data, tmp_path):
    """OpenSfM's own result fits its own tracks to a pixel of 3264, and goes to COLMAP and back."""
    path = shared_data / "opensfm_berlin" / "original" / "reconstruction_example.json"
    scene = read_scene(path)
    assert (scene.num_images, scene.num_points, len(scene.point_observations)) == (3, 1430, 3082)
    assert np.median(errors(scene)) < 1.0
    assert read_opensfm_reconstructions(path)[0].reference_lla == pytest.approx((52.518963, 13.400377, 0.0))
    write_scene(scene, tmp_path / "model")
    again = read_colmap(tmp_path / "model")
    assert again.images.names == scene.images.names
    np.testing.assert_allclose(again.cam_from_world, scene.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(again.cameras.params, scene.cameras.params, atol=1e-9)
    order = np.argsort(scene.points.ids)  # COLMAP sorts
    np.testing.assert_allclose(again.points.xyz, scene.points.xyz[order], atol=1e-9)
    np.testing.assert_array_equal(again.points.color, scene.points.color[order])
    np.testing.assert_allclose(np.sort(errors(again)), np.sort(errors(scene)), atol=1e-9)
