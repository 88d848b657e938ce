# SPDX-License-Identifier: BSD-3-Clause
"""Photographs at poses from elsewhere: motions, averaging, noise, gross errors, axes; and the command on photographs.

The truth is that of scenes that were made; the noise found is compared with the noise that was added.
"""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from _facade import facade
from scipy.stats import chi2

from groma.cli.main import run
from groma.errors import InputError
from groma.evaluation import evaluate_poses
from groma.gates import NORMAL
from groma.geometry import quaternion
from groma.io import read_scene, write_scene
from groma.io.colmap.at_poses import MatchedPair
from groma.mapping.posed.averaging import average_centers, average_rotations
from groma.mapping.posed.axes import check_axes
from groma.mapping.posed.motions import motions_of
from groma.mapping.posed.noise import noise_of_given
from groma.mapping.posed.register import averaged, more_seen
from groma.mapping.posed.sentences import about_contradiction
from groma.scene import Cameras, Scene

FOCAL, COUNT = 800.0, 14


@pytest.fixture(scope="module")
def world():
    """Cameras around a cloud of points, and motions of pairs of images from rays with noise of half a pixel."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-2.0, 2.0, (80, 3))
    turn = np.linspace(0.0, 1.5 * np.pi, COUNT)
    centers = np.stack([7.0 * np.cos(turn), 7.0 * np.sin(turn), rng.uniform(-1.5, 1.5, COUNT)], axis=1)
    rotations = []
    for center in centers:
        forward = -center / np.linalg.norm(center)
        right = np.cross(forward, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(forward, [0.0, 0.0, 1.0]))
        rotations.append([right, np.cross(forward, right), forward])
    rotation = np.array(rotations)
    poses = np.hstack([quaternion.from_matrix(rotation), -np.einsum("nij,nj->ni", rotation, centers)])
    cameras = Cameras(np.array([1]), ("SIMPLE_PINHOLE",), np.array([[FOCAL, 0.0, 0.0]]), np.array([1]), np.array([1]))
    scene = Scene.from_images(cameras, [f"{k}.jpg" for k in range(COUNT)], np.zeros(COUNT, int), poses)
    rays = (points - centers[:, None]) @ np.swapaxes(rotation, 1, 2)
    rays = rays / np.linalg.norm(rays, axis=2, keepdims=True) + rng.normal(0.0, 0.5 / FOCAL, rays.shape)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return scene, motions_of(pairs(poses, rays, rng))


def pairs(poses, rays, rng):
    """Yield neighbours with their motions, a fifth of which were estimated wrongly."""
    for first in range(COUNT):
        for second in range(first + 1, min(first + 5, COUNT)):
            between = quaternion.multiply(poses[second, :4], quaternion.conjugate(poses[first, :4]))
            shift = poses[second, 4:] - quaternion.rotate(between, poses[first, 4:])
            x, y = rays[first], rays[second]
            if (first + 3 * second) % 5 == 0:  # of structure that repeats itself: consistent, and wrong
                wrong = quaternion.exp(rng.normal(0.0, 0.5, 3))
                between, shift, y = (
                    quaternion.multiply(wrong, between),
                    quaternion.rotate(wrong, shift),
                    quaternion.rotate(wrong, y),
                )
            start = quaternion.multiply(quaternion.exp(rng.normal(0.0, 0.01, 3)), between)
            shift = shift / np.linalg.norm(shift) + rng.normal(0.0, 0.01, 3)
            yield MatchedPair(first, second, x, y, np.concatenate([start, shift / np.linalg.norm(shift)]), FOCAL)


def disturbed(scene, place, degrees, wrong, seed):
    rng, count = np.random.default_rng(seed), scene.num_images
    centers = scene.cam_centers_in_world + place * rng.normal(size=(count, 3))
    turns = quaternion.exp(np.radians(degrees) * rng.normal(size=(count, 3)))
    turned = quaternion.multiply(turns, scene.cam_from_world[:, :4])
    centers[wrong] += rng.normal(size=(len(wrong), 3)) * 5.0
    turned[wrong] = quaternion.multiply(quaternion.exp(rng.normal(size=(len(wrong), 3))), turned[wrong])
    return placed(scene, turned, centers)


def placed(scene, turned, centers):
    return scene.with_poses(np.hstack([turned, -quaternion.rotate(turned, centers)]))


def test_motions_are_as_good_as_they_say(world):
    scene, motions = world
    poses, centers = scene.cam_from_world, scene.cam_centers_in_world
    between = quaternion.multiply(poses[motions.second, :4], quaternion.conjugate(poses[motions.first, :4]))
    off = quaternion.log(quaternion.multiply(between, quaternion.conjugate(motions.rotation)))
    way = centers[motions.first] - centers[motions.second]
    way = quaternion.rotate(poses[motions.second, :4], way / np.linalg.norm(way, axis=1, keepdims=True))
    right = np.linalg.norm(off, axis=1) < 0.05
    assert 0.6 < right.mean() < 0.95
    for error, sigma in ((off, motions.rotation_sigma), (motions.direction - way, motions.direction_sigma)):
        ratio = np.sqrt(np.mean((np.linalg.norm(error, axis=1)[right] / sigma[right]) ** 2) / 3.0)
        assert 0.2 < ratio < 1.3, ratio  # the noise of a match is taken as one pixel at least


@pytest.mark.parametrize(("place", "degrees"), [(0.05, 0.5), (0.5, 3.0), (1e-5, 1e-4)])
def test_poses_that_agree_with_motions_tell_noise_and_gross_errors(world, place, degrees):
    scene, motions = world
    given = disturbed(scene, place, degrees, [3, 9], seed=1)
    found, known = averaged(given, motions)
    assert np.flatnonzero(known.gross).tolist() == [3, 9]
    errors = evaluate_poses(found, scene)
    assert errors.center_max < 0.1 and errors.rotation_deg_mean < 0.3
    if place > 1e-3:  # else they are better than motions can tell
        assert 0.6 * place < known.sigma[0] < 1.5 * place
        assert 0.6 * degrees < np.degrees(known.sigma[1]) < 1.5 * degrees
    size = np.ptp(found.cam_centers_in_world, axis=0) / np.ptp(scene.cam_centers_in_world, axis=0)
    assert np.abs(size - 1.0).max() < max(0.02, place)  # metric


def test_poses_that_claim_much_do_not_outvote_motions(world):
    scene, motions = world
    given = disturbed(scene, 0.0, 0.0, [5], seed=2)
    turned = average_rotations(given.cam_from_world[:, :4], motions)
    between = quaternion.multiply(quaternion.conjugate(scene.cam_from_world[:, :4]), turned.values)
    assert np.degrees(np.linalg.norm(quaternion.log(between), axis=1)).max() < 0.5
    centers = average_centers(given.cam_centers_in_world, turned.values, motions, np.arange(COUNT) != 5)
    assert np.linalg.norm(centers.values - scene.cam_centers_in_world, axis=1).max() < 0.1


def test_matches_of_sides_that_look_alike_contradict_poses_and_are_told(world):
    """Four groups of images, each of another side of a box, match as if all had seen one side."""
    scene, motions = world
    rotation, side = scene.cam_from_world[:, :4], np.arange(COUNT) % 4
    seen = quaternion.multiply(rotation, quaternion.exp(np.outer(0.5 * np.pi * side, [0.0, 0.0, 1.0])))
    between = quaternion.multiply(seen[motions.second], quaternion.conjugate(seen[motions.first]))
    found, known = averaged(scene, replace(motions, rotation=between))
    assert "contradict each other" in " ".join(about_contradiction(known.turn.sigma))
    noisy = disturbed(scene, 0.2, 5.0, [], 0)
    other, noise = averaged(noisy, motions)
    assert not about_contradiction(noise.turn.sigma) and not about_contradiction(None)
    # Where more matches meet at the given poses these are kept, at the noise of motions; else the others.
    for given, averages, told in ((scene, found, known), (noisy, other, noise)):
        for kept in (given, averages):
            photographs = SimpleNamespace(
                triangulate=lambda one, _, more=kept: SimpleNamespace(point_observations=range(8 + (one is more)))
            )
            start, start_noise = more_seen(photographs, given, averages, told, motions)
            assert start is kept and (start_noise is told) == (kept is averages)
    # Poses as good as motions are not asked for; nothing is triangulated.
    good = averaged(disturbed(scene, 1e-5, 1e-4, [], 0), motions)
    assert more_seen(SimpleNamespace(), scene, *good, motions) == good


@pytest.mark.parametrize("seed", range(4))
def test_images_that_contradict_each_other_do_not_gather_at_one_place(world, seed):
    """A group of three images a few noises apart whose motions are wrong: at one place these would all be right."""
    scene, motions = world
    rng = np.random.default_rng(seed)
    group = np.isin(motions.first, [0, 1, 2]) & np.isin(motions.second, [0, 1, 2])
    alone = group | ((motions.first > 2) & (motions.second > 2))
    wrong = rng.normal(size=(int(group.sum()), 3))
    direction = motions.direction.copy()
    direction[group] = wrong / np.linalg.norm(wrong, axis=1, keepdims=True)
    fields = {name: value[alone] for name, value in vars(replace(motions, direction=direction)).items()}
    true = scene.cam_centers_in_world
    given = true + rng.normal(0.0, 0.7, true.shape)
    found = average_centers(given, scene.cam_from_world[:, :4], replace(motions, **fields), np.ones(COUNT, bool))
    apart, before = (np.linalg.norm(some[[0, 1, 2]] - some[[1, 2, 0]], axis=1) for some in (found.values, given))
    assert apart.sum() > 0.5 * before.sum()


def test_noise_is_estimated_and_gross_errors_are_tested_for():
    rng, alarms, sigmas = np.random.default_rng(3), 0, []
    redundancy = np.linspace(0.4, 1.0, 25)
    for _ in range(300):
        squared = 0.04 * redundancy * chi2.rvs(3, size=25, random_state=rng)
        noise = noise_of_given(squared, redundancy)
        alarms += bool(noise.gross.any())
        sigmas.append(noise.sigma)
    assert alarms / 300 < 3.0 * NORMAL.false_alarm
    assert abs(np.mean(sigmas) / 0.2 - 1.0) < 0.02
    squared[[2, 7, 11]] = 4.0
    noise = noise_of_given(squared, redundancy)
    assert np.flatnonzero(noise.gross).tolist() == [2, 7, 11] and noise.sigma == pytest.approx(0.2, rel=0.3)
    few = noise_of_given(squared, np.full(25, 0.01))
    assert few.sigma is None and not few.gross.any()  # values better than what they are compared with


MIRROR, SWAP = np.diag([1.0, -1.0, 1.0]), np.eye(3)[[1, 0, 2]]
NORTH, MIXED = 111_195.0, np.random.default_rng(6).permutation(COUNT)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda turn, place: (np.diag([1.0, -1.0, -1.0]) @ turn, place),
            r"y up and look along -z .* \(OpenGL, OpenCV\)",
        ),
        (lambda turn, place: (np.swapaxes(turn, 1, 2), -np.einsum("nij,nj->ni", turn, place)), "if they are inverted"),
        (lambda turn, place: (MIRROR @ turn @ MIRROR, place @ MIRROR), "axes are left-handed, as in Unity"),
        (lambda turn, place: (turn, place @ SWAP), r"x and y of the places are exchanged \(east and north, latitude"),
        (lambda turn, place: (turn, place @ np.diag([1.0, 1.0, -1.0])), "places have the axes x, y, -z of the file"),
        (lambda turn, place: (SWAP @ np.diag([1.0, -1.0, 1.0]) @ turn, place), "the axes of the cameras, x right"),
        (
            lambda turn, place: (
                turn,
                place[:, [1, 0, 2]] / [NORTH, NORTH * np.cos(np.radians(55.0)), 1.0] + [55, 13, 9],
            ),
            "latitudes and longitudes in degrees",
        ),
        (lambda turn, place: (turn[MIXED], place[MIXED]), "random orders of the poses. Check that names and poses"),
    ],
)
def test_axes_that_the_photographs_contradict_are_refused(world, change, said):
    scene, motions = world
    given = disturbed(scene, 0.05, 0.5, [4], seed=4)
    check_axes(given, motions)
    turned, centers = change(quaternion.to_matrix(given.cam_from_world[:, :4]), given.cam_centers_in_world)
    with pytest.raises(InputError, match=said):
        check_axes(placed(scene, quaternion.from_matrix(turned), centers), motions)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """Photographs of a house corner, their cameras, and a file of disturbed poses of which one is wrong."""
    folder = tmp_path_factory.mktemp("posed") / "images"
    scene = facade(folder, 7).keep(points=[])
    given = disturbed(scene, 0.05, 1.0, [2], seed=5)
    write_scene(given, folder.parent / "transforms.json")
    return folder, scene, given


def test_photographs_are_mapped_at_the_poses_of_a_file(photographed, tmp_path, monkeypatch, capsys):
    folder, scene, given = photographed
    monkeypatch.chdir(tmp_path)
    command = ["map", str(folder), "--poses", str(folder.parent / "transforms.json"), "-o", "out", "--no-planes"]
    assert run(command) == 0
    said = capsys.readouterr()
    assert "The given pose of 0002.png" in said.err and "is wrong beyond its noise" in said.err
    assert "Noise of the 6 given poses" in said.out
    found = read_scene(tmp_path / "out" / "scene.npz")
    assert found.num_images == 7 and found.num_lines > 10
    assert sorted(set(range(7)) - set(found.pose_priors.frame_idx.tolist())) == [2]
    errors = evaluate_poses(found, scene)
    assert errors.center_max < 0.02 < evaluate_poses(given, scene).center_rmse
    # In the frame and the unit of the file.
    assert np.linalg.norm(found.cam_centers_in_world - scene.cam_centers_in_world, axis=1).max() < 0.15
    words = json.loads((tmp_path / "out" / "summary.json").read_text())["warnings"]
    assert any("0002.png" in sentence for sentence in words)
    assert run([*command, "--model", "out", "--force"]) == 1
    assert "--model and --poses exclude each other" in capsys.readouterr().err


def test_poses_that_are_held_stay(photographed, tmp_path, monkeypatch):
    folder, scene, _ = photographed
    monkeypatch.chdir(tmp_path)
    scene = scene.subset([0, 1, 2, 3])
    cameras = scene.cameras.with_model("FULL_OPENCV")
    params = cameras.params.copy()
    params[:, [8, 11]] = 5.0  # k3 and k6, which cancel: the same lens, by numbers that COLMAP takes for bogus
    scene = scene.replace(cameras=cameras.replace(params=params))
    write_scene(scene, tmp_path / "true")  # a COLMAP model without points
    assert run(["map", str(folder), "--model", "true", "-o", "out", "--no-planes", "--fix-poses", "--quiet"]) == 0
    found = read_scene(tmp_path / "out" / "scene.npz")
    assert found.num_points > 100
    np.testing.assert_allclose(found.cam_from_world, scene.cam_from_world, atol=1e-9)
    told = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert told["estimated"]["poses"] is False
    assert told["pose_uncertainty"] is None
