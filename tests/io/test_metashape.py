# SPDX-License-Identifier: BSD-3-Clause
"""Files of Metashape, written here: matrices from camera to chunk, a similarity to the world, p1 and p2 exchanged."""

import numpy as np
import pytest
from _views import HEIGHT, WIDTH, check_poses, views
from scipy.spatial.transform import Rotation
from test_openmvg import project

from groma import cameras
from groma.errors import FileFormatError
from groma.geometry import se3
from groma.io import read_metashape, read_scene

#: From the world to a chunk, in which cameras are written.
TURN, SCALE, SHIFT = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_matrix(), 2.5, np.array([3.0, -1.0, 7.0])
#: Coefficients, in the order of OpenMVG's test, and the model that they become.
LENSES = {
    "pinhole_radial_k3": ({"k1": -0.1, "k2": 0.02}, [-0.1, 0.02, 0.0], "RADIAL"),
    "pinhole_brown_t2": (
        {"k1": -0.1, "k2": 0.02, "k3": -0.004, "p1": -0.002, "p2": 0.003},
        [-0.1, 0.02, -0.004, 0.003, -0.002],
        "FULL_OPENCV",
    ),
    "fisheye": ({"k1": 0.05, "k2": -0.01, "k3": 0.002, "k4": -0.001}, [0.05, -0.01, 0.002, -0.001], "OPENCV_FISHEYE"),
}


def words(values) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def document(
    rotation, center, lens=None, kind="frame", reference='LOCAL_CS["m"]', turn=TURN, scale=SCALE, shift=SHIFT, more=""
) -> str:
    """Return the file of cameras of given rotations (from the world) and centres."""
    local = np.zeros((len(rotation), 4, 4))
    local[:, :3, :3] = turn.T @ rotation.transpose(0, 2, 1)
    local[:, :3, 3] = (center - shift) @ turn / scale
    local[:, 3, 3] = 1.0
    inner = "".join(f"<{name}>{value!r}</{name}>" for name, value in (lens or {}).items())
    posed = "".join(
        f'<camera id="{row}" sensor_id="3" component_id="0" label="day\\{row}">'
        f"<transform>{words(one)}</transform></camera>"
        for row, one in enumerate(local)
    )
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="4"><sensor id="3" label="unknown" type="{kind}"><resolution width="{WIDTH}" height="{HEIGHT}"/>
      <calibration type="{kind}" class="initial"><f>1</f></calibration>
      <calibration type="{kind}" class="adjusted"><resolution width="{WIDTH}" height="{HEIGHT}"/>
        <f>500.0</f><cx>2.5</cx><cy>-1.5</cy>{inner}</calibration></sensor></sensors>
    <components next_id="1" active_id="0"><component id="0" label="Component 1"><transform>
      <rotation locked="false">{words(turn)}</rotation><translation locked="false">{words(shift)}</translation>
      <scale locked="false">{scale!r}</scale></transform></component></components>
    <cameras next_id="9"><group id="0" label="Group 1">{posed}</group>
      <camera id="8" sensor_id="3" label="lost"/>{more}</cameras>
    <reference>{reference}</reference>
  </chunk>
</document>
"""


@pytest.fixture
def true():
    return views()


def write(folder, text: str):
    (folder / "cameras.xml").write_text(text)
    return folder / "cameras.xml"


@pytest.mark.parametrize("kind", LENSES)
def test_poses_and_every_kind_of_lens(true, tmp_path, kind):
    lens, values, model = LENSES[kind]
    sensor = "fisheye" if kind == "fisheye" else "frame"
    scene = read_scene(write(tmp_path, document(true.rotation, true.center, lens, sensor)))
    check_poses(scene, true)
    assert scene.images.names == ("day/0", "day/1", "day/2", "day/3") and scene.cameras.models == (model,)
    pixel = cameras.model(model).project(scene.cameras.params_of(0), true.in_cam[1])
    for found, point in zip(pixel, true.in_cam[1], strict=True):  # the principal point of that test is (322, 238)
        np.testing.assert_allclose(found, project(kind, values, point) + 0.5, atol=1e-9)


def test_pixels_that_are_not_square(true, tmp_path):
    scene = read_scene(write(tmp_path, document(true.rotation, true.center, {"b1": 4.0})))
    assert scene.cameras.models == ("PINHOLE",) and scene.cameras.params_of(0).tolist() == [504, 500, 322.5, 238.5]


def test_geocentric_worlds_become_level(true, tmp_path):
    """A scene at a latitude of 60 and longitude of 30 degrees, whose z is up: the same but for its origin."""
    latitude, longitude = np.radians([60.0, 30.0])
    radius = 6378137.0 / np.sqrt(1.0 - 0.0066943799901413165 * np.sin(latitude) ** 2)
    up = [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)]
    origin = radius * np.array(up) * (1.0, 1.0, 1.0 - 0.0066943799901413165)
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    level = np.array([east, np.cross(up, east), up])  # from geocentric axes
    center = true.center @ level + origin
    text = document(true.rotation @ level, center, reference='PROJCS["WGS 84 / UTM zone 36N"]', shift=origin)
    scene = read_metashape(write(tmp_path, text))
    matrices = se3.to_matrix(scene.cam_from_world)
    # 6.4e6 m have 1e-9 m; the middle of the cameras is 2 m away, seen from which the vertical differs by 3e-7
    np.testing.assert_allclose(matrices[:, :3, :3], true.rotation, atol=1e-6)
    found = -np.einsum("nji,nj->ni", matrices[:, :3, :3], matrices[:, :3, 3])
    np.testing.assert_allclose(found, true.center - true.center.mean(axis=0), atol=5e-6)


def test_disabled_cameras_and_smaller_components_are_left_out(true, tmp_path):
    pose = words(np.eye(4))
    other = f'<camera id="6" sensor_id="3" component_id="1" label="6"><transform>{pose}</transform></camera>'
    text = document(true.rotation, true.center, more=other)
    text = text.replace('label="day\\2"', 'label="day\\2" enabled="false"')
    with pytest.warns(UserWarning, match="2 reconstructions"):
        scene = read_scene(write(tmp_path, text))
    check_poses(scene, true, [0, 1, 3])


def test_without_a_similarity_the_world_is_the_chunk(true, tmp_path):
    text = document(true.rotation, true.center, turn=np.eye(3), scale=1.0, shift=np.zeros(3))
    start, end = text.index("<components"), text.index("</components>") + len("</components>")
    check_poses(read_scene(write(tmp_path, text[:start] + text[end:])), true)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<k1>-0.1</k1>", "<b2>0.5</b2>", "a lens with b2 is not read"),
        ("<k1>-0.1</k1>", "<k4>0.5</k4>", "a lens with k4 is not read"),
        ("<k1>-0.1</k1>", "<k1>much</k1>", "k1"),
        ('type="frame"', 'type="cylindrical"', "type 'cylindrical' are not read"),
        (f'width="{WIDTH}"', 'width="0"', "size in pixels"),
        (f'width="{WIDTH}"', 'width="640.5"', "'width', a size in pixels; got 640.5"),
        ("sensor_id", "sensor_ie", "expected a calibration, which is missing"),
        ("transform>", "transfer>", "no camera with a pose"),
        ("</chunk>", "", "is not XML"),
        ("<document", '<!DOCTYPE x [<!ENTITY a "b">]><document', "document type or entities"),
        (" 0.0 0.0 0.0 1.0<", "<", "expected 16 numbers; got 12"),
    ],
)
def test_damage_is_named(true, tmp_path, old, new, message):
    text = document(true.rotation, true.center, {"k1": -0.1})
    assert old in text
    with pytest.raises(FileFormatError, match=message):
        read_scene(write(tmp_path, text.replace(old, new)))
