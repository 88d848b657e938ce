# SPDX-License-Identifier: BSD-3-Clause
"""Files of Meshroom, written here: numbers as texts, R (X - c) with R by columns, the first pixel at 0, 0."""

import json

import numpy as np
import pytest
from _views import HEIGHT, WIDTH, check_poses, errors, views
from test_openmvg import CENTER, FOCAL, KINDS, project

from groma.errors import FileFormatError
from groma.io import read_meshroom, read_scene

#: Lenses of ours in the tests of OpenMVG, by their older and newer names here.
OLD = {"pinhole_radial_k1": "radial1", "pinhole_radial_k3": "radial3", "pinhole_brown_t2": "brown"}
NEW = {"pinhole_radial_k1": "radialk1", "pinhole_radial_k3": "radialk3", "pinhole_brown_t2": "brown"}
OLD |= {"pinhole": "pinhole"}
NEW |= {"pinhole": "none", "fisheye": "fisheye4"}


def texts(values) -> list[str]:
    return [repr(float(value)) for value in np.ravel(values)]


def lens(kind: str, values: list[float], version: str) -> dict:
    found = {"intrinsicId": "7", "width": str(WIDTH), "height": str(HEIGHT), "distortionParams": texts(values) or ""}
    if version == "1.0.0":
        place = {"pxFocalLength": repr(FOCAL), "principalPoint": texts(CENTER)}
        return {**found, **place, "type": OLD[kind]}
    offset = texts(CENTER - (WIDTH / 2, HEIGHT / 2))
    place = {"sensorWidth": "32.0", "focalLength": repr(FOCAL * 32.0 / WIDTH), "pixelRatio": "1"}
    return {**found, **place, "principalPoint": offset, "type": "pinhole", "distortionType": NEW[kind]}


def document(true, kind: str = "pinhole", values: list[float] = (), version: str = "1.2.6") -> dict:
    count = range(len(true.rotation))
    return {
        "version": version.split("."),
        "featuresFolders": "",
        "views": [
            {"viewId": str(10 + row), "poseId": str(20 + row), "intrinsicId": "7", "path": f"D:/all/day\\{row}.jpg"}
            for row in count
        ],
        "intrinsics": [lens(kind, list(values), version)],
        "poses": [
            {
                "poseId": str(20 + row),
                "pose": {"transform": {"rotation": texts(true.rotation[row].T), "center": texts(true.center[row])}},
            }
            for row in count
        ],
        "structure": [
            {
                "landmarkId": str(number),
                "color": ["1", "2", "3"],
                "X": texts(place),
                "observations": [
                    {"observationId": str(10 + row), "x": texts(project(kind, values, true.in_cam[row, number]))}
                    for row in count
                ],
            }
            for number, place in enumerate(true.points)
        ],
    }


@pytest.fixture
def true():
    return views()


def write(folder, found: dict):
    (folder / "cameras.sfm").write_text(json.dumps(found, indent=4))
    return folder / "cameras.sfm"


@pytest.mark.parametrize(("kind", "version"), [*((kind, "1.0.0") for kind in OLD), *((kind, "1.2.6") for kind in NEW)])
def test_every_camera_of_every_version_reproduces_its_pixels(true, tmp_path, kind, version):
    _, values, model = KINDS[kind]
    scene = read_scene(write(tmp_path, document(true, kind, values, version)))
    assert len(scene.point_observations) == 48 and errors(scene).max() < 1e-9
    check_poses(scene, true)
    assert scene.cameras.models == (model,)
    assert scene.images.names == ("0.jpg", "1.jpg", "2.jpg", "3.jpg")
    np.testing.assert_allclose(scene.points.xyz, true.points, atol=1e-12)


def test_views_without_a_pose_are_left_out_and_folders_are_kept(true, tmp_path):
    found = document(true)
    del found["poses"][1], found["structure"]
    found["views"][0]["path"] = "D:/all/night/0.jpg"
    scene = read_meshroom(write(tmp_path, found))
    assert scene.images.names == ("night/0.jpg", "day/2.jpg", "day/3.jpg")
    check_poses(scene, true, [0, 2, 3])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d["intrinsics"][0].update(distortionType="3deradial4"), "'3deradial4' is not read"),
        (lambda d: d["intrinsics"][0].update(pixelRatio="2"), "not square"),
        (lambda d: d["intrinsics"][0].update(width="0"), "size in pixels"),
        (lambda d: d["intrinsics"][0].update(width="640.5"), "'width', a size in pixels; got 640.5"),
        (lambda d: d["intrinsics"][0].update(sensorWidth="0"), "damaged or incomplete"),
        (lambda d: d["intrinsics"][0].pop("focalLength"), "'focalLength': expected finite numbers"),
        (lambda d: d["views"][0].pop("path"), "expected 'path', which is missing"),
        (lambda d: d["poses"].clear(), "no view with intrinsics and a pose"),
        (lambda d: d["poses"][0]["pose"]["transform"].update(center=["1"]), "'center': expected 3 numbers; got 1"),
        (lambda d: d["structure"][0].update(X=["a", "b", "c"]), "'X'"),
        (lambda d: d.update(rigs=[{"rigId": "1"}]), "rigs, which are not read"),
    ],
)
def test_damage_is_named(true, tmp_path, change, words):
    found = document(true)
    change(found)
    with pytest.raises(FileFormatError, match=words):
        read_scene(write(tmp_path, found))
