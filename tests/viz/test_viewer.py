# SPDX-License-Identifier: BSD-3-Clause
"""The viewer: what is drawn, what a click finds, that the page is served, and that Ctrl-C ends it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import urllib.request
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from _scene import exact_scene

from groma.cli.main import run
from groma.errors import InputError
from groma.geometry import se3
from groma.io import write_scene
from groma.scene import Directions, Lines, Points, Relations, Scene, Similarity, synthetic
from groma.scene.patches import plane_patches
from groma.viz.pictures import folder_of_images
from groma.viz.viewer import nodes as _scene_view
from groma.viz.viewer import scene as viewer
from groma.viz.viewer.content import LINE_MODES, REACH, view_content
from groma.viz.viewer.scene import open_viewer, serving


@pytest.fixture(scope="module")
def scene():
    return synthetic.holistic(10, seed=2).truth


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    cv2.imwrite(str(folder / "first.jpg"), np.full((480, 640, 3), 90, np.uint8))
    return folder


@pytest.fixture
def view(folder):
    with serving(exact_scene(), folder, port=0) as view:
        yield view


# --------------------------------------------------------------------------------------------------------- Content


def test_everything_is_moved_together(scene):
    content = view_content(scene)
    frame = content.view_from_world
    np.testing.assert_allclose(content.segments, frame.points(scene.lines.segments), rtol=1e-12)
    np.testing.assert_allclose(content.camera_centers, frame.points(scene.cam_centers_in_world), atol=1e-9)
    # The optical axis of each camera, turned by its quaternion, leads to a point that the camera sees in its middle.
    w, x, y, z = content.camera_wxyz.T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    ahead = frame.inverse().points(content.camera_centers + axis)
    in_cam = np.concatenate([ahead, np.ones((len(ahead), 1))], axis=1)
    in_cam = np.einsum("nij,nj->ni", se3.to_matrix(scene.cam_from_world), in_cam)
    np.testing.assert_allclose(in_cam[:, :2], 0, atol=1e-9)
    assert (in_cam[:, 2] > 0).all()


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e4])
def test_size_and_place_of_the_world_do_not_matter(scene, scale):
    there = Similarity(scale, np.eye(3), np.array([5e5, -2e6, 300.0]) * scale)
    here, away = view_content(scene), view_content(scene.transformed(there))
    np.testing.assert_allclose(away.segments, here.segments, atol=1e-6)
    np.testing.assert_allclose(away.points, here.points, atol=1e-6)
    np.testing.assert_allclose(away.statistics.length, scale * here.statistics.length, rtol=1e-6)
    assert REACH / 2 < np.abs(here.segments).max() < 4 * REACH


def test_openings_are_those_of_the_camera(scene):
    content = view_content(scene)
    np.testing.assert_allclose(content.camera_openings, 2 * np.arctan(384 / 800), rtol=1e-12)
    np.testing.assert_allclose(content.camera_aspects, 1024 / 768, rtol=1e-12)


@pytest.mark.parametrize("mode", LINE_MODES)
def test_line_colours(scene, mode):
    lines = scene.lines.replace(confidence=np.linspace(0.0, 1.0, scene.num_lines))
    shared = {"directions": Directions(np.array([1]), np.eye(3)[:1])}
    shared["relations"] = Relations(line_along_direction=np.array([[0, 0], [1, 0]]))
    content = view_content(scene.replace(lines=lines, **shared))
    found = content.line_colours(mode)
    assert found.colours.shape == (scene.num_lines, 3) and found.colours.dtype == np.uint8
    assert len(np.unique(found.colours, axis=0)) > 1
    assert (found.low is None) == (mode in ("direction", "shared direction"))


def test_long_lines_are_red_and_short_ones_blue(scene):
    content = view_content(scene)
    colours, length = content.line_colours("length").colours, content.statistics.length
    assert colours[length.argmax()].tolist() == [217, 71, 43]
    assert colours[length.argmin()].tolist() == [44, 111, 187]


def test_lines_of_one_direction_have_one_colour(scene):
    along = np.array([[0, 0], [3, 0], [1, 1], [4, 1]])
    shared = scene.replace(
        directions=Directions(np.array([1, 2]), np.eye(3)[:2]), relations=Relations(line_along_direction=along)
    )
    colours = view_content(shared).line_colours("shared direction").colours
    assert (colours[0] == colours[3]).all() and (colours[1] == colours[4]).all()
    assert len(np.unique(colours[[0, 1, 2]], axis=0)) == 3  # the third follows none


def test_lines_at_right_angles_have_three_colours_in_any_frame():
    """Lines along the axes of a turned building, and as many in no direction of their own: three colours, and grey."""
    rng = np.random.default_rng(4)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    along = np.repeat(axes, [40, 20, 10], axis=0) + 0.01 * rng.normal(size=(70, 3))
    start = rng.normal(size=(100, 3))
    odd = rng.normal(size=(30, 3))
    odd *= 0.8 / np.linalg.norm(odd, axis=1, keepdims=True)
    scene = Scene(lines=Lines.through(np.stack([start, start + np.concatenate([along, odd])], axis=1)))
    colours = view_content(scene).line_colours("direction").colours
    kinds = [np.unique(part, axis=0) for part in (colours[:40], colours[40:60], colours[60:70])]
    assert [len(kind) for kind in kinds] == [1, 1, 1]
    red, blue, green = (kind[0].tolist() for kind in kinds)
    assert np.argmax(red) == 0 and np.argmax(blue) == 2 and np.argmax(green) == 1  # the most length first
    far = np.abs(odd @ axes.T / 0.8).max(axis=1) < np.cos(np.deg2rad(27.0))
    assert far.any() and (colours[70:][far] == [150, 152, 156]).all()


def test_first_points_are_an_even_sample():
    xyz = np.zeros((20_000, 3))
    xyz[:, 0] = np.linspace(-1, 1, len(xyz))
    content = view_content(Scene(points=Points.at(xyz)))
    # The mean of 500 of evenly spread numbers: standard deviation below 0.058 of their half range.
    assert abs(content.points[:500].mean(axis=0) @ [1, 1, 1]) < 4 * 0.058 * np.abs(content.points).max()


# --------------------------------------------------------------------------------------------------------- Patches


def test_patches_hold_their_members(scene):
    polygons, members = plane_patches(scene)
    assert len(polygons) == scene.num_planes
    for plane, polygon in enumerate(polygons):
        normal, offset = scene.planes.hesse[plane, :3], scene.planes.hesse[plane, 3]
        np.testing.assert_allclose(polygon @ normal + offset, 0, atol=1e-9)
        edges = np.roll(polygon, -1, axis=0) - polygon
        turns = np.cross(edges, np.roll(edges, -1, axis=0)) @ normal
        assert (turns > 0).all() or (turns < 0).all()
        relations = scene.relations
        lines = relations.line_on_plane[relations.line_on_plane[:, 1] == plane, 0]
        points = relations.point_on_plane[relations.point_on_plane[:, 1] == plane, 0]
        assert members[plane] == len(lines) + len(points)
        places = np.concatenate([scene.points.xyz[points], scene.lines.segments[lines].reshape(-1, 3)])
        sides = np.einsum("nei,i->ne", np.cross(edges[None], places[:, None] - polygon[None]), normal)
        assert (np.sign(turns[0]) * sides > -1e-9).all()


def test_one_member_far_away_does_not_stretch_a_patch():
    scene = exact_scene()
    xyz = scene.points.xyz.copy()
    xyz[4, :2] = 1e4
    polygon = plane_patches(scene.with_points(xyz))[0][0]
    assert np.abs(polygon).max() < 10


def test_planes_without_members_get_a_square():
    scene = exact_scene()
    polygons, members = plane_patches(scene.points_only().replace(planes=scene.planes))
    assert polygons[0].shape == (4, 3) and members.tolist() == [0]
    np.testing.assert_allclose(polygons[0][:, 2], 0.25, atol=1e-12)


# ----------------------------------------------------------------------------------------------------------- Server


def test_the_page_is_served(view):
    address = f"http://127.0.0.1:{view.server.get_port()}"
    with urllib.request.urlopen(address, timeout=20) as answer:
        assert answer.status == 200
        assert b"<html" in answer.read()[:2000].lower()
    assert view.server.get_host() == "127.0.0.1"


def test_every_kind_is_drawn(view):
    names = ["/points", "/lines", "/cameras/0", "/cameras/1", "/planes/faces/0", "/planes/edges"]
    assert all(view.server.scene.get_handle_by_name(name) is not None for name in names)
    assert view.num_pictures == 1
    assert view.server.scene.get_handle_by_name("/cameras/0").image is not None
    assert view.server.scene.get_handle_by_name("/cameras/1").image is None


def test_switches(view):
    for name, node in [
        ("points", "/points"),
        ("lines", "/lines"),
        ("cameras", "/cameras/1"),
        ("planes", "/planes/faces/0"),
    ]:
        for shown in (False, True):
            view.shown[name].value = shown
            assert view.server.scene.get_handle_by_name(node).visible is shown
    view.shown["photographs"].value = False
    assert view.server.scene.get_handle_by_name("/cameras/0").image is None
    view.shown["photographs"].value = True
    assert view.server.scene.get_handle_by_name("/cameras/0").image is not None


def test_fewer_points_and_lines(view):
    view.point_count.value = 5
    assert view.points.points.shape == (5, 3)
    view.min_images.value = 3
    assert view.lines.points.shape == (0, 2, 3) and "0 of 4" in view.legend.content
    view.min_images.value = 0
    assert view.lines.points.shape == (4, 2, 3)


def test_colours_of_lines_change(view):
    before = np.array(view.lines.colors)
    view.line_mode.value = "length"
    assert view.lines.colors.shape == before.shape and (view.lines.colors != before).any()


def test_looking_from_a_photograph(view):
    camera = SimpleNamespace(image_width=1400, image_height=700)
    client = SimpleNamespace(camera=camera, atomic=contextlib.nullcontext)
    view.look_from.value = "2: second.jpg"
    view._move_to_camera(SimpleNamespace(client=client))
    np.testing.assert_array_equal(camera.position, view.content.camera_centers[1])
    np.testing.assert_array_equal(camera.wxyz, view.content.camera_wxyz[1])
    assert not view.server.scene.get_handle_by_name("/cameras/1").visible
    view.look_from.value = "outside"
    view._move_to_camera(SimpleNamespace(client=client))
    np.testing.assert_array_equal(camera.position, view.content.start_position)
    assert view.server.scene.get_handle_by_name("/cameras/1").visible


def test_a_narrow_window_shows_the_whole_scene(view):
    """The view is made for a scene 0.83 / 0.6 times as wide as high."""
    start = view.content.start_position
    for size, away in (((1400, 700), 1.0), ((1120, 800), 0.83 / 0.6), ((400, 800), 0.83 / 0.6 / 0.5)):
        camera = SimpleNamespace(image_width=size[0], image_height=size[1], position=start)
        view._look_from_outside(SimpleNamespace(camera=camera))
        np.testing.assert_allclose(camera.position, away * start)


def test_a_click_lists_the_observations(view):
    content = view.content
    camera = SimpleNamespace(image_height=900, fov=0.9)
    ray = content.segments[2].mean(axis=0) - content.start_position
    event = SimpleNamespace(
        client=SimpleNamespace(camera=camera), ray_origin=tuple(content.start_position), ray_direction=tuple(ray)
    )
    view._clicked(event)
    assert view.selected == 2
    said = view.selection.content
    assert "<b>Line 3</b>" in said and "2 images" in said and "first.jpg" in said and "second.jpg" in said
    assert said.count("<svg") == 1  # there is one photograph
    assert view.server.scene.get_handle_by_name("/selection/line") is not None
    event.ray_direction = tuple(-ray)
    view._clicked(event)
    assert view.selected is None and "Click a line" in view.selection.content
    assert view.server.scene.get_handle_by_name("/selection/line") is None


def test_names_of_images_are_text():
    with serving(exact_scene(("<b>one</b>", "two")), port=0) as view:
        view.select(0)
        assert "<b>one" not in view.selection.content and "&lt;b&gt;one" in view.selection.content


def test_much_is_thinned_out(monkeypatch, scene):
    monkeypatch.setattr(_scene_view, "FIRST_POINTS", 30)
    monkeypatch.setattr(_scene_view, "MAX_CAMERAS", 4)
    with serving(scene, port=0) as view:
        assert len(view.points.points) == 30 < scene.num_points
        assert len(view._nodes["cameras"]) == 4


def test_points_alone_can_be_seen():
    with serving(Scene(points=Points.at(np.eye(3))), port=0) as view:
        assert len(view.points.points) == 3 and len(view.lines.points) == 0


def test_nothing_to_see_is_said():
    with pytest.raises(InputError, match="nothing to look at"):
        open_viewer(Scene(), port=0)


def test_a_folder_that_is_none_is_refused(tmp_path):
    with pytest.raises(InputError, match="not a folder"):
        open_viewer(exact_scene(), tmp_path / "none", port=0)


# --------------------------------------------------------------------------------------------------------- Command


def test_command(tmp_path, monkeypatch, capsys):
    write_scene(exact_scene(), tmp_path / "scene.npz")
    (tmp_path / "images").mkdir()
    monkeypatch.chdir(tmp_path)

    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(viewer, "wait_for_interrupt", interrupt)
    assert run(["view", "scene.npz", "--images", "images", "--port", "0", "--no-browser", "--json", "r.json"]) == 0
    said = capsys.readouterr()
    assert "Open http://localhost:" in said.out and "viser" not in said.out
    assert "holds none of the images" in said.err
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["num_lines"] == 4 and report["address"].startswith("http://localhost:")
    assert not any(thread.name.startswith("viser") for thread in threading.enumerate())


def test_command_refuses_in_one_line(tmp_path, capsys):
    write_scene(exact_scene(), tmp_path / "scene.npz")
    assert run(["view", str(tmp_path / "scene.npz"), "--images", str(tmp_path / "no"), "--no-browser"]) == 1
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")
@pytest.mark.parametrize("signals", [[signal.SIGINT], [signal.SIGTERM, signal.SIGINT]])
def test_ctrl_c_ends_it(tmp_path, signals):
    write_scene(exact_scene(), tmp_path / "scene.npz")
    process = subprocess.Popen(
        [sys.executable, "-m", "groma.cli.main", "view", "scene.npz", "--port", "0", "--no-browser"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        lines = [process.stdout.readline(), process.stdout.readline()]
        assert "Ctrl-C ends" in lines[1]
        for number in signals:  # as when Ctrl-C is pressed twice
            process.send_signal(number)
        rest, errors = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 0
    assert errors == "" and "Closed" in rest


# ------------------------------------------------------------------------------------------------------ Photographs


def test_photographs_are_found_by_what_lies_beside_a_model(tmp_path):
    names = ("first.jpg", "deep/second.jpg")
    model = tmp_path / "project" / "sparse" / "0"
    model.mkdir(parents=True)
    assert folder_of_images(model, names) is None
    beside = tmp_path / "project" / "images"
    (beside / "deep").mkdir(parents=True)
    assert folder_of_images(model, names) is None  # it holds none of them
    (beside / "deep" / "second.jpg").write_bytes(b"")
    assert folder_of_images(model, names) == beside
    named = tmp_path / "photographs"
    named.mkdir()
    (named / "first.jpg").write_bytes(b"")
    (model / "summary.json").write_text(json.dumps({"images": str(named)}))
    assert folder_of_images(model, names) == named
    for damage in ("[", "[]", '{"images": 5}', '{"images": "nowhere"}'):
        (model / "summary.json").write_text(damage)
        assert folder_of_images(model, names) == beside
    assert folder_of_images(model, ["../secret.jpg"]) is None
    assert folder_of_images(tmp_path / "project" / "scene.npz", names) == beside
    for place in (beside, beside / "transforms.json"):  # names as paths from the folder of the file
        assert folder_of_images(place, names) == beside
