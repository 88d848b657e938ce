# SPDX-License-Identifier: BSD-3-Clause
"""OpenMVG files, written here: R (X - c), coefficients from undistorted to distorted, the first pixel at 0, 0."""

import json

import numpy as np
import pytest
from _views import check_poses, errors, views

from groma.errors import FileFormatError
from groma.io import read_openmvg, read_scene

NEW = 1 << 31
FOCAL, CENTER = 500.0, np.array([322.0, 238.0])
#: Kind, its entry, its coefficients, and the model that it becomes.
KINDS = {
    "pinhole": ("", [], "SIMPLE_PINHOLE"),
    "pinhole_radial_k1": ("disto_k1", [-0.1], "SIMPLE_RADIAL"),
    "pinhole_radial_k3": ("disto_k3", [-0.1, 0.02, 0.0], "RADIAL"),
    "pinhole_brown_t2": ("disto_t2", [-0.1, 0.02, 0.0, 0.003, -0.002], "OPENCV"),
    "fisheye": ("fisheye", [0.05, -0.01, 0.002, -0.001], "OPENCV_FISHEYE"),
}


def project(kind: str, values: list[float], point: np.ndarray) -> np.ndarray:
    x, y = point[:2] / point[2]
    radius = np.hypot(x, y)
    if kind == "spherical":  # from the middle of 640 x 320 pixels
        across, up = np.arctan2(point[0], point[2]), np.arctan2(-point[1], np.hypot(point[0], point[2]))
        return np.array([320.0, 160.0]) + 640.0 * np.array([across, -up]) / (2 * np.pi)
    if kind == "fisheye":
        angle = np.arctan(radius)
        bent = angle * (1 + sum(k * angle ** (2 * order + 2) for order, k in enumerate(values)))
        return FOCAL * bent / radius * np.array([x, y]) + CENTER
    k1, k2, k3, t1, t2 = (*values, 0.0, 0.0, 0.0, 0.0, 0.0)[:5]
    grown = 1 + k1 * radius**2 + k2 * radius**4 + k3 * radius**6
    tangential_x = t2 * (radius**2 + 2 * x * x) + 2 * t1 * x * y
    tangential_y = t1 * (radius**2 + 2 * y * y) + 2 * t2 * x * y
    return FOCAL * np.array([x * grown + tangential_x, y * grown + tangential_y]) + CENTER


def intrinsics(kind: str, values: list[float], key: int = 7) -> dict:
    data = {"width": 640, "height": 480, "focal_length": FOCAL, "principal_point": CENTER.tolist()}
    if kind == "spherical":
        data = {"value0": {"width": 640, "height": 320}}
    elif values:
        data[KINDS[kind][0]] = values
    kinds = {"polymorphic_id": NEW + 1, "polymorphic_name": kind}
    return {"key": key, "value": {**kinds, "ptr_wrapper": {"id": NEW + 9, "data": data}}}


def view(row: int) -> dict:
    size = {"width": 640, "height": 480}
    return {"local_path": "/", "filename": f"{row}.jpg", **size, "id_view": row, "id_intrinsic": 7, "id_pose": 20 + row}


def document(true, kind: str, values: list[float]) -> dict:
    count = range(len(true.rotation))
    return {
        "sfm_data_version": "0.3",
        "root_path": "/somewhere/else",
        "views": [
            {"key": 10 + row, "value": {"polymorphic_id": 1 << 30, "ptr_wrapper": {"id": NEW + row, "data": view(row)}}}
            for row in count
        ],
        "intrinsics": [intrinsics(kind, values)],
        "extrinsics": [
            {"key": 20 + row, "value": {"rotation": true.rotation[row].tolist(), "center": true.center[row].tolist()}}
            for row in count
        ],
        "structure": [
            {
                "key": 3 * number,
                "value": {
                    "X": place,
                    "observations": [
                        {
                            "key": 10 + row,
                            "value": {"id_feat": 1, "x": project(kind, values, true.in_cam[row, number]).tolist()},
                        }
                        for row in count
                    ],
                },
            }
            for number, place in enumerate(true.points.tolist())
        ],
        "control_points": [],
    }


@pytest.fixture
def true():
    return views()


def write(folder, found: dict):
    (folder / "sfm_data.json").write_text(json.dumps(found, indent=4))
    return folder / "sfm_data.json"


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_camera_reproduces_its_pixels(true, tmp_path, kind):
    _, values, model = KINDS[kind]
    scene = read_scene(write(tmp_path, document(true, kind, values)))
    assert errors(scene).max() < 1e-9
    check_poses(scene, true)
    assert scene.cameras.models == (model,)
    assert scene.points.ids.tolist() == [3 * number for number in range(12)]
    np.testing.assert_allclose(scene.points.xyz, true.points, atol=1e-12)
    first = (scene.point_observations.image_idx == 2) & (scene.point_observations.point_idx == 5)
    expected = project(kind, values, true.in_cam[2, 5]) + 0.5
    np.testing.assert_allclose(scene.point_observations.pixel[first][0], expected, atol=1e-12)


@pytest.mark.parametrize("kind", ["pinhole_radial_k3", "pinhole_brown_t2"])
def test_a_third_radial_coefficient(true, tmp_path, kind):
    values = list(KINDS[kind][1])
    values[2] = -0.004
    scene = read_scene(write(tmp_path, document(true, kind, values)))
    assert scene.cameras.models == ("FULL_OPENCV",) and errors(scene).max() < 1e-9


def test_panoramas_are_measured_from_the_image_centre(true, tmp_path):
    scene = read_scene(write(tmp_path, document(true, "spherical", [])))
    assert scene.cameras.models == ("EQUIRECTANGULAR",) and errors(scene).max() < 1e-9
    true_pixel = project("spherical", [], true.in_cam[1, 3])
    first = (scene.point_observations.image_idx == 1) & (scene.point_observations.point_idx == 3)
    np.testing.assert_allclose(scene.point_observations.pixel[first][0], true_pixel, atol=1e-9)


def test_the_older_form_of_brown_and_fisheye_cameras(true, tmp_path):
    """What all pinhole cameras share stood in ``value0``; kinds are named where they first occur."""
    found = document(true, "pinhole_brown_t2", KINDS["pinhole_brown_t2"][1])
    data = found["intrinsics"][0]["value"]["ptr_wrapper"]["data"]
    coefficients = data.pop("disto_t2")
    older = {"value0": data, "disto_t2": coefficients}
    found["intrinsics"][0]["value"]["ptr_wrapper"]["data"] = older
    second = {"key": 8, "value": {"polymorphic_id": 1, "ptr_wrapper": {"id": NEW + 10, "data": older}}}
    found["intrinsics"].append(second)
    found["views"][1]["value"]["ptr_wrapper"]["data"]["id_intrinsic"] = 8
    scene = read_scene(write(tmp_path, found))
    assert scene.cameras.models == ("OPENCV", "OPENCV") and errors(scene).max() < 1e-9
    assert scene.images.camera_idx.tolist() == [0, 1, 0, 0]


def test_views_without_a_pose_are_left_out_and_folders_are_kept(true, tmp_path):
    found = document(true, "pinhole", [])
    del found["extrinsics"][1]
    found["views"][0]["value"]["ptr_wrapper"]["data"]["local_path"] = "left\\"
    scene = read_openmvg(write(tmp_path, found).parent)
    assert scene.images.names == ("left/0.jpg", "2.jpg", "3.jpg")
    check_poses(scene, true, [0, 2, 3])
    assert len(scene.point_observations) == 36 and errors(scene).max() < 1e-9


def test_poses_alone_are_a_scene(true, tmp_path):
    found = document(true, "pinhole", [])
    del found["structure"]
    scene = read_scene(write(tmp_path, found))
    assert (scene.num_images, scene.num_points) == (4, 0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d["intrinsics"][0]["value"].update(polymorphic_name="pinhole_magic"), "'pinhole_magic' is not read"),
        (lambda d: d["intrinsics"][0].pop("value"), "intrinsics, entry 1: expected 'value', which is missing"),
        (lambda d: d.pop("views"), "expected 'views', which is missing"),
        (lambda d: d["extrinsics"].clear(), "no view with intrinsics and a pose"),
        (lambda d: d["extrinsics"][0]["value"].update(rotation=[[1, 0, 0]]), "rotation: expected 3 x 3 finite"),
        (lambda d: d["structure"][3]["value"].update(X="here"), "X of the structure: expected 3 finite"),
        (lambda d: d["structure"][3]["value"]["observations"][0]["value"].update(x=[1]), "observation"),
        (lambda d: d["structure"][3]["value"].update(observations=5), r"expected a list \[...\]; got 5"),
        (lambda d: d["structure"][3].update(key=0), "the same identifier"),
    ],
)
def test_damage_is_named(true, tmp_path, change, words):
    found = document(true, "pinhole", [])
    change(found)
    with pytest.raises(FileFormatError, match=words):
        read_scene(write(tmp_path, found))
