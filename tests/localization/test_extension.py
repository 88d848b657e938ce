# SPDX-License-Identifier: BSD-3-Clause
"""Photographs added to a map, and two maps joined: the embedded cabinet, by motion capture poses."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from groma.adjustment.adjust import AdjustOptions
from groma.adjustment.terms.principal_points import near_the_middle
from groma.cli.main import run
from groma.errors import InputError, OutputError
from groma.evaluation import cabinet
from groma.geometry import so3
from groma.io import read_scene, write_scene
from groma.io.colmap.masks import Masks
from groma.localization import extension, features
from groma.localization.calibration import CalibrationChoice
from groma.localization.extension import _with_new_lenses, extended_model, in_world_of
from groma.localization.joining.merging import _line_sigma, _one_to_one, _same_lines, merged_model
from groma.localization.localizer import Localizer
from groma.localization.pose.camera import QueryCamera
from groma.localization.posed_model import _own_points, gather_photographs
from groma.mapping.noise.landmarks import pixels_of
from groma.mapping.result import MapResult
from groma.scene import CameraPositions, Cameras, Distances, LineObservations, Scene, Similarity
from groma.scene.landmarks import Lines
from groma.scene.survey import Kind
from groma.scene.synthetic import holistic

FRAMES = [f"{number:04d}.jpg" for number in range(24, 32)]
HALVES = {"a": FRAMES[0::2], "b": FRAMES[1::2]}
#: The world of the second map.
MOVED = Similarity(2.5, so3.exp(np.array([0.3, -0.5, 1.0])), np.array([1.0, 2.0, 3.0]))


def quiet(stage, done, total):
    pass


def test_features_at_the_place_of_a_point_are_of_it_only_where_all_of_the_track_are():
    """Behind a point of the map, on its ray in the first image, lies another: the other images see it elsewhere."""
    scene = holistic(4, noise_px=0.0, seed=0).truth
    seen = scene.point_observations
    times = np.bincount(seen.point_idx, minlength=scene.num_points)
    point = int(times.argmax())
    rows = np.flatnonzero(seen.point_idx == point)
    center = scene.cam_centers_in_world[seen.image_idx[rows[0]]]
    behind = center + 1.5 * (scene.points.xyz[point] - center)
    image = np.concatenate([seen.image_idx[rows]] * 2)
    pixels = np.concatenate([seen.pixel[rows], pixels_of(scene, image[: len(rows)], np.tile(behind, (len(rows), 1)))])
    track = np.repeat([0, 1], len(rows))
    np.testing.assert_allclose(pixels[len(rows)], pixels[0], atol=1e-6)
    assert _own_points(scene, image, pixels, np.full(len(image), 2.0), track, 2).tolist() == [point, -1]


@pytest.fixture(scope="module", autouse=True)
def features_are_found_once():
    """The tests look at the same photographs, a hundred times: what was found in one is remembered."""
    known = {}

    def remembered(find):
        def found(image, *given):
            key = (find, image.shape, image.tobytes(), *map(str, given))
            if key not in known:
                known[key] = find(image, *given)
            return known[key]

        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(features, "find_blobs", remembered(features.find_blobs))
        patch.setattr(features, "find_corners", remembered(features.find_corners))
        yield


@pytest.fixture(scope="module")
def truth():
    return read_scene(cabinet.folder() / "model")


@pytest.fixture(scope="module")
def place(tmp_path_factory, truth):
    folder = tmp_path_factory.mktemp("halves")
    names = list(truth.images.names)
    for half, chosen in HALVES.items():
        scene = truth.subset([names.index(name) for name in chosen])
        write_scene(scene if half == "a" else scene.transformed(MOVED), folder / f"{half}.npz")
        (folder / half).mkdir()
        for name in chosen:
            shutil.copy(cabinet.folder() / "images" / name, folder / half / name)
    return folder


@pytest.fixture(scope="module")
def maps(place):
    return {half: Localizer(place / f"{half}.npz", place / half) for half in HALVES}


def test_photographs_that_the_map_has_are_left_out(maps, place, tmp_path):
    """A folder to which photographs were added is passed as a whole; old ones would be in the map twice."""
    files = {name: place / half / name for half in HALVES for name in HALVES[half]}
    (place / "copy.jpg").write_bytes(files[HALVES["b"][0]].read_bytes())
    files |= {"copy.jpg": place / "copy.jpg"}
    choice = CalibrationChoice()
    made = extended_model(maps["a"], files, tmp_path / "work", tmp_path / "images", choice, quiet)
    assert sorted(made.scene.images.names) == FRAMES
    assert made.warnings() == ["Left out, as the map has them already, or as copies: 5 photographs."]
    files = {name: place / "a" / name for name in HALVES["a"]}
    with pytest.raises(InputError, match="The map has all of the 4 photographs already"):
        extended_model(maps["a"], files, tmp_path / "work", tmp_path / "images", choice, quiet)


def _off(scene, truth):
    rows = [list(truth.images.names).index(name.rpartition("/")[2]) for name in scene.images.names]
    return np.linalg.norm(scene.cam_centers_in_world - truth.cam_centers_in_world[rows], axis=1)


def _extended(maps, place, tmp_path, names=HALVES["b"]):
    files = {name: place / "b" / name for name in names}
    return extended_model(maps["a"], files, tmp_path / "work", tmp_path / "images", CalibrationChoice(), quiet)


def test_new_photographs_get_poses_and_points_with_the_others(maps, place, truth, tmp_path):
    made = _extended(maps, place, tmp_path)
    scene = made.scene
    assert set(scene.images.names) == set(FRAMES) and not made.warnings()
    assert _off(scene, truth).max() < 0.2 and np.median(_off(scene, truth)[4:]) < 0.12
    np.testing.assert_array_equal(scene.cam_from_world[: len(HALVES["a"])], made.map.cam_from_world)
    assert scene.num_lines == 0 and scene.num_points > made.map.num_points
    # They were taken with the camera of the map, which was calibrated.
    assert scene.num_cameras == 1 and not len(scene.principal_point_priors)
    # Points tie the new photographs to those of the map and to each other.
    new = np.array([name in HALVES["b"] for name in scene.images.names])[scene.point_observations.image_idx]
    count = [np.bincount(scene.point_observations.point_idx[kind], minlength=scene.num_points) for kind in (~new, new)]
    assert ((count[0] > 0) & (count[1] > 0)).sum() > 100
    assert {path.name: path.resolve() for path in made.folder.iterdir()} == {
        name: (place / half / name).resolve() for half, names in HALVES.items() for name in names
    }


def test_masks_hide_parts_of_new_photographs_from_points_too(maps, place, tmp_path):
    """One that has the name of a photograph of the map has another in the model, and its mask by that."""
    name, other = HALVES["b"][1], HALVES["a"][0]
    cv2.imwrite(str(tmp_path / "mask.png"), np.repeat(np.uint8([[0, 255]]), 480, axis=0).repeat(320, axis=1))
    files = {other: place / "b" / name}
    made = extended_model(
        *(maps["a"], files, tmp_path / "work", tmp_path / "images", CalibrationChoice(), quiet),
        Masks.of(tmp_path / "mask.png", list(files)),
    )
    seen, image = made.scene.point_observations, list(made.scene.images.names).index(f"query/{other}")
    assert (seen.image_idx == image).sum() > 10 and (seen.pixel[seen.image_idx == image, 0] > 320.0).all()
    assert not made.masks.read(f"query/{other}", (640, 480))[:, :320].any()


def test_calibrations_of_new_cameras_are_estimated_unless_they_are_a_given_one():
    """The first camera of the map was calibrated, the second was not; of the new ones the first has its calibration."""
    params = [[500.0, 320.0, 240.0], [600.0, 330.0, 250.0], [500.0, 320.0, 240.0], [700.0, 400.0, 300.0]]
    cameras = Cameras.of([1, 2, 3, 4], ["SIMPLE_PINHOLE"] * 4, params, [[640, 480]] * 3 + [[800, 600]])
    poses = np.tile([0, 0, 0, 1, 0, 0, 0.0], (4, 1))
    scene = Scene.from_images(cameras, list("abcd"), np.arange(4), poses)
    told = near_the_middle(scene).principal_point_priors.take([1])
    before = Scene.from_images(cameras.take([0, 1]), ["a", "b"], np.arange(2), poses[:2], principal_point_priors=told)
    found = _with_new_lenses(scene, before).principal_point_priors
    assert found.camera_idx.tolist() == [1, 3] and found.pixel.tolist() == [[320.0, 240.0], [400.0, 300.0]]


def test_photographs_that_show_only_new_ones_follow_in_turn(maps, place, truth, tmp_path, monkeypatch):
    late, turns = HALVES["b"][2], []
    original = extension.localize_images

    def first_without(localizer, files, *others):
        turns.append((localizer.scene.num_images, sorted(files)))
        found = original(localizer, files, *others)
        if len(turns) > 1:
            return found
        return [extension.replace(one, status="failed") if one.name == late else one for one in found]

    monkeypatch.setattr(extension, "localize_images", first_without)
    made = _extended(maps, place, tmp_path, HALVES["b"][1:4])
    assert turns == [(4, HALVES["b"][1:4]), (6, [late])]
    assert late in made.scene.images.names and _off(made.scene, truth).max() < 0.2


def test_photographs_of_something_else_are_left_out(maps, place, tmp_path):
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((480, 640), 120, np.uint8))
    files = {"blank.png": tmp_path / "blank.png", HALVES["b"][1]: place / "b" / HALVES["b"][1]}
    made = extended_model(maps["a"], files, tmp_path / "w", tmp_path / "images", CalibrationChoice(), quiet)
    assert "blank.png" not in made.scene.images.names
    assert len(made.warnings()) == 1 and "1 of 2 photographs. blank.png" in made.warnings()[0]
    with pytest.raises(InputError, match="None of the 1 photographs"):
        extended_model(
            maps["a"], {"blank.png": files["blank.png"]}, tmp_path / "w", tmp_path / "i", CalibrationChoice(), quiet
        )


@pytest.mark.parametrize(
    ("measured", "expected"),
    [
        ({}, MOVED),
        # A distance knows its length, and a measured place is where it is.
        ({"distances": Distances.between(Kind.IMAGE, [0], [5], [1.0], [0.01])}, Similarity(1.0, MOVED.rotation)),
        ({"camera_positions": CameraPositions([0], np.zeros((1, 3)), np.eye(3)[None])}, Similarity()),
    ],
    ids=["nothing", "distance", "place"],
)
def test_what_was_measured_stays_where_a_map_is_extended(truth, measured, expected):
    scene = truth.replace(**measured)
    report = SimpleNamespace(warnings=())
    made: Any = MapResult(scene, scene, scene, scene, report, AdjustOptions(), {}, "", {}, ())  # type: ignore[arg-type]
    found = in_world_of(made, truth.transformed(MOVED)).scene
    turned = Similarity(expected.scale, expected.rotation).points(truth.points.xyz)
    away = found.points.xyz - turned
    np.testing.assert_allclose(away - away[0], 0.0, atol=1e-6 * np.ptp(turned))
    for name, table in measured.items():
        column = "distance" if name == "distances" else "xyz"
        np.testing.assert_allclose(getattr(getattr(found, name), column), getattr(table, column))


def test_two_maps_are_joined_with_their_scale(maps, truth, tmp_path):
    made = merged_model(maps["a"], maps["b"], tmp_path / "images", "similarity", quiet)
    assert abs(made.motion.similarity[7] * MOVED.scale - 1.0) < 0.02
    assert set(made.scene.images.names) == set(FRAMES) and made.num_common == 0
    assert _off(made.scene, truth).max() < 0.2
    assert "matched points" in made.sentence() and "scale 0.4" in made.sentence()


def test_photographs_of_both_maps_are_taken_once(place, maps, truth, tmp_path):
    names = list(truth.images.names)
    both = [*HALVES["b"], HALVES["a"][2]]
    scene = truth.subset([names.index(name) for name in both]).transformed(MOVED)
    gather_photographs(tmp_path / "b", {name: cabinet.folder() / "images" / name for name in both})
    made = merged_model(maps["a"], Localizer(scene, tmp_path / "b"), tmp_path / "images", "similarity", quiet)
    assert made.num_common == 1 and sorted(made.scene.images.names) == FRAMES


def test_a_photograph_that_one_map_has_in_a_wrong_place_gets_that_of_the_other(maps, place, truth, tmp_path):
    scene = read_scene(place / "b.npz")
    poses = scene.frames.rig_from_world.copy()
    poses[2, 4:] += 2.0
    other = Localizer(scene.replace(frames=replace(scene.frames, rig_from_world=poses)), place / "b")
    made = merged_model(maps["a"], other, tmp_path / "images", "similarity", quiet)
    assert _off(made.scene, truth).max() < 0.2


def test_a_photograph_that_is_found_at_the_wrong_side_keeps_its_own_pose(maps, truth, tmp_path, monkeypatch):
    """A thing whose sides look alike: one photograph is found two units off, by half of what its own map has of it."""
    localize, wrong = maps["a"].localize, maps["b"].files[2]

    def misled(path, camera):
        found = localize(path, camera)
        if path != wrong:
            return found
        pose, rows = found.pose.cam_from_world.copy(), np.flatnonzero(found.pose.point_inliers)
        pose[4:] += 2.0
        agree = np.zeros_like(found.pose.point_inliers)
        agree[rows[: (maps["b"].scene.point_observations.image_idx == 2).sum() // 2]] = True
        return replace(found, pose=replace(found.pose, cam_from_world=pose, point_inliers=agree))

    monkeypatch.setattr(maps["a"], "localize", misled)
    made = merged_model(maps["a"], maps["b"], tmp_path / "images", "similarity", quiet)
    assert _off(made.scene, truth).max() < 0.2


def test_maps_of_different_places_are_not_joined(place, maps, tmp_path):
    (tmp_path / "b").mkdir()
    for name in HALVES["b"]:
        image = cv2.imread(str(place / "b" / name))
        assert image is not None
        cv2.imwrite(str(tmp_path / "b" / name), image[:, ::-1])
    other = Localizer(read_scene(place / "b.npz"), tmp_path / "b")
    with pytest.raises(InputError, match="cannot be joined"):
        merged_model(maps["a"], other, tmp_path / "images", "similarity", quiet)


def test_segments_that_show_one_line_are_paired():
    observed = np.array([[100, 100, 200, 100], [100, 150, 200, 160], [300, 50, 300, 200.0]])
    query = np.array([[110, 100.5, 190, 101], [120, 153, 180, 157.5], [300, 260, 300, 400], [110, 120, 190, 120.0]])
    seen = SimpleNamespace(image_idx=np.array([4, 4, 4]), line_idx=np.array([7, 8, 9]), segment=observed)
    pose = SimpleNamespace(line_inliers=np.ones(4, bool), matches=SimpleNamespace(segments2d=query))
    found: Any = SimpleNamespace(pose=pose, line=np.array([30, 31, 32, 33]))
    second: Any = SimpleNamespace(scene=SimpleNamespace(line_observations=seen))
    pairs = _same_lines(second, 4, found)
    assert pairs.tolist() == [[7, 30], [8, 31]]


def test_pairs_that_most_photographs_show_win():
    votes = Counter({(1, 5): 3, (1, 6): 2, (2, 6): 1, (3, 5): 1})
    assert _one_to_one(votes).tolist() == [[1, 5], [2, 6]]


def test_noise_of_a_line_across_its_ends():
    """Against draws of the line's moment and direction."""
    rng = np.random.default_rng(3)
    ends = np.array([[1.0, 2.0, 0.5], [2.0, 2.5, 1.5]])
    direction = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    across = np.linalg.svd(direction[None])[2][1:].T
    shifts = rng.normal(0, 0.01, (20000, 2, 2)) @ across.T
    moved = ends + shifts
    step = moved[:, 1] - moved[:, 0]
    unit = step / np.linalg.norm(step, axis=1, keepdims=True)
    lines = np.concatenate([np.cross(moved[:, 0], unit), unit], axis=1)
    assert _line_sigma(ends[None], np.cov(lines.T).astype(np.float64)[None])[0] == pytest.approx(0.01, rel=0.03)


def test_a_folder_of_links_holds_nothing_else(tmp_path):
    (tmp_path / "one.jpg").write_bytes(b"1")
    (tmp_path / "two.jpg").write_bytes(b"2")
    gather_photographs(tmp_path / "links", {"a/x.jpg": tmp_path / "one.jpg"})
    gather_photographs(tmp_path / "links", {"a/x.jpg": tmp_path / "one.jpg"})
    with pytest.raises(InputError, match="there already"):
        gather_photographs(tmp_path / "links", {"a/x.jpg": tmp_path / "two.jpg"})
    with pytest.raises(InputError, match="leads out"):
        gather_photographs(tmp_path / "links", {"../x.jpg": tmp_path / "one.jpg"})


def test_the_command_extends_a_map(place, truth, tmp_path, capsys):
    out = tmp_path / "out"
    (tmp_path / "new").mkdir()
    for name in HALVES["b"][1:4]:
        shutil.copy(place / "b" / name, tmp_path / "new")
    masked = [HALVES["a"][0], HALVES["b"][1]]  # one of the map, one of the new ones
    (tmp_path / "masks").mkdir()
    for name in masked:
        mask = np.repeat(np.uint8([[0]] * 40 + [[255]] * 440), 640, axis=1)
        cv2.imwrite(str(tmp_path / "masks" / f"{name}.png"), mask)
    given = ["map", tmp_path / "new", "--extend", place / "a.npz", "--map-images", place / "a", "-o", out]
    assert run([*map(str, given), "--no-diagnosis", "--no-planes", "--masks", str(tmp_path / "masks")]) == 0
    assert "Masks leave out 8.3 % of 2 photographs; 5 have none." in " ".join(capsys.readouterr().out.split())
    scene = read_scene(out / "scene.npz")
    seen, row = scene.point_observations, scene.images.names.index(masked[1])
    assert (seen.image_idx == row).sum() > 10 and (seen.pixel[seen.image_idx == row, 1] > 39.0).all()
    assert sorted(scene.images.names) == sorted([*HALVES["a"], *HALVES["b"][1:4]])
    # The result is in the world of the map, and can be extended or asked itself.
    assert np.median(_off(scene, truth)) < 0.1
    assert Localizer(out).files[0].parent == tmp_path / "out.images"
    assert not (tmp_path / "out.queries").exists() and not (tmp_path / "out.work").exists()


def test_the_command_joins_maps_and_keeps_lines(place, truth, tmp_path):
    """The first map has a line that the photographs do not show: it is kept where it was."""
    scene = read_scene(place / "a.npz")
    middle = np.median(scene.points.xyz, axis=0)
    ends = np.array([middle, middle + 0.1 * scene.points.xyz.std(axis=0)])
    camera = QueryCamera.of(scene.cameras, 0)
    segments = np.stack([camera.project(pose, ends).ravel() for pose in scene.cam_from_world])
    images = np.flatnonzero(np.isfinite(segments).all(axis=1))
    seen = LineObservations(images, np.zeros(len(images), int), segments[images], np.ones(len(images)))
    write_scene(scene.replace(lines=Lines.through(ends[None]), line_observations=seen), tmp_path / "a.npz")
    given = ["merge", tmp_path / "a.npz", place / "b.npz", "-o", tmp_path / "out"]
    given += ["--images-a", place / "a", "--images-b", place / "b"]
    assert run([*map(str, given), "--quiet"]) == 0
    out = read_scene(tmp_path / "out" / "scene.npz")
    assert sorted(out.images.names) == FRAMES
    numbers = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert numbers["num_kept_lines"] == 1
    assert numbers["diagnosis"] is not None and numbers["pose_uncertainty"]["center"]["undetermined"] == 0
    kept = out.line_observations.line_idx == out.num_lines - 1
    np.testing.assert_allclose(out.line_observations.segment[kept], segments[images])
    assert np.abs(out.lines.segments[-1] - ends).max() < 0.2


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["map", "b", "--extend", "a.npz", "--model", "a.npz"], "--extend and --model exclude each other"),
        (["map", "b", "--map-images", "a"], "Add --extend"),
        (["map", "b", "--extend", "nothing.npz"], "nothing.npz"),
        (["map", "b", "--extend", "a/0024.jpg"], "0024.jpg"),
        (["merge", "a.npz", "nothing"], "nothing"),
        (["merge", "a.npz", "a"], "a"),
    ],
)
def test_one_line_for_what_cannot_be_used(place, tmp_path, capsys, monkeypatch, given, words):
    monkeypatch.chdir(place)
    assert run([*given, "-o", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err
    assert words in said and len(said.strip().splitlines()) == 1 and not (tmp_path / "out").exists()


def test_a_folder_with_other_files_is_not_replaced(tmp_path):
    from groma.cli.shared.extending import photograph_folder

    (tmp_path / "out.images").mkdir()
    (tmp_path / "out.images" / "mine.jpg").write_bytes(b"1")
    with pytest.raises(OutputError, match="no links"):
        photograph_folder(tmp_path / "out", force=True)
