# SPDX-License-Identifier: BSD-3-Clause
"""Depth maps in a map: unit of length, a unit of each map, noise, depths of lines, what is refused."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from _facade_depth import facade_depths

from groma.cli.main import run
from groma.errors import FileFormatError, InputError
from groma.evaluation.poses import evaluate_poses
from groma.geometry import quaternion, se3
from groma.io import read_scene
from groma.io.depth_maps import DepthMaps
from groma.mapping.depth.noise import cells_of, fitted_noise, shared_errors
from groma.mapping.depth.points import measure_depths
from groma.mapping.depth.unit import own_units
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions
from groma.mapping.plan import planned_stages
from groma.scene import Frames, Images, PlaneObservations, Planes, Rigs, Sensors, Similarity

SIGMA = 0.01  # units of the world, of a depth map


def write_depths(folder, scene, factors=None, sigma=SIGMA, seed=1):
    """Write depths with noise that 8 x 8 pixels share half of, as .npy; each map times its factor."""
    folder.mkdir()
    rng = np.random.default_rng(seed)
    for i, (stem, depth) in enumerate(facade_depths(scene).items()):
        coarse = cv2.resize(rng.normal(0, 1, (depth.shape[0] // 8, depth.shape[1] // 8)), depth.shape[::-1],
                            interpolation=cv2.INTER_NEAREST)  # fmt: skip
        noisy = depth + sigma * np.sqrt(0.5) * (rng.normal(0, 1, depth.shape) + coarse)
        known = np.where(depth > 0, noisy * (1.0 if factors is None else factors[i]), 0.0)
        np.save(folder / f"{stem}.npy", known.astype(np.float32))
    return folder


@pytest.fixture(scope="module")
def small(corner):
    """The model of the house corner, three times as small and turned, as a model of photographs would be."""
    turn = quaternion.to_matrix(np.array([[0.1, 0.2, -0.3, 0.9]]) / np.linalg.norm([0.1, 0.2, -0.3, 0.9]))[0]
    return corner[1].transformed(Similarity(1.0 / 3.0, turn, np.array([1.0, 2.0, 3.0])))


@pytest.fixture(scope="module")
def mapped(corner, small, tmp_path_factory):
    place = tmp_path_factory.mktemp("depth")
    maps = DepthMaps(write_depths(place / "depth", corner[1]))
    options, named = MapOptions(min_confidence=0.0), set()
    result = map_images(corner[0], place / "work", small, options, lambda name, done, all_: named.add(name), depth=maps)
    assert set(planned_stages(options, "model", depth=True)) == named
    return result


def test_the_map_has_the_unit_of_the_depths(corner, mapped):
    scores = evaluate_poses(mapped.scene, corner[1])
    assert scores.alignment.scale == pytest.approx(1.0, abs=2e-3)
    assert mapped.depths.scale == pytest.approx(3.0, rel=5e-3)
    assert mapped.summary()["depth"]["num_maps"] == 4
    assert mapped.scene.num_measurements["point depths"] > 200
    assert not any("depth" in sentence for sentence in mapped.warnings)


def test_lines_have_depths_that_are_right(corner, mapped):
    """Points of mapped lines at the measured ends lie on a wall: the inverse depth there is that of the depth map."""
    scene, truth = mapped.scene, facade_depths(corner[1])
    table, seen = scene.line_depths, scene.line_observations
    assert len(table) > 0.5 * len(seen) > 10
    away = []
    for row, q, sigma in zip(table.observation_idx, table.inverse_depth, table.sigma, strict=True):
        depth = truth[scene.images.names[seen.image_idx[row]].split(".")[0]]
        for end in range(2):
            u, v = seen.segment[row, 2 * end : 2 * end + 2].astype(int)
            exact = depth[min(v, len(depth) - 1), min(u, depth.shape[1] - 1)]
            if exact > 0:
                away.append((q[end] - 1.0 / exact) / sigma[end])
    assert np.median(np.abs(away)) < 1.5
    assert np.mean(np.abs(away) > 5.0) < 0.1
    # The map agrees with them, too: lines were adjusted with their depths.
    assert mapped.report.num_measurements["line depths"] == len(table)


def test_noise_is_estimated(mapped):
    depth = mapped.scene.point_depths.depth
    stated = mapped.depths.noise.sigma(depth)
    # The median of nine pixels has less noise than one of them, but not less than what all nine share.
    assert np.all(stated > 0.4 * SIGMA)
    assert np.median(stated) < 2.0 * SIGMA


def test_every_map_may_have_a_unit_of_its_own(corner, small, tmp_path):
    factors = np.array([0.5, 3.0, 1.0, 7.0])
    maps = DepthMaps(write_depths(tmp_path / "depth", corner[1], factors), relative=True)
    result = map_images(corner[0], tmp_path / "work", small, MapOptions(min_confidence=0.0), depth=maps)
    # The unit is that of the model, and the maps are told apart by their factors.
    assert evaluate_poses(result.scene, small).alignment.scale == pytest.approx(1.0, abs=0.02)
    ratio = result.depths.units / result.depths.units[2]
    assert np.allclose(ratio, factors, rtol=5e-3)
    assert result.summary()["depth"]["scale"] is None
    metric = measure_depths(small, replace(maps, relative=False))
    assert any("do not agree on a unit" in sentence for sentence in metric.warnings)


@pytest.mark.parametrize("refined", [False, True])
def test_cameras_on_a_rig_have_depths_too(corner, small, tmp_path, refined):
    """The four photographs as one moment of a rig: held or estimated, its cameras are apart in the unit of the maps."""
    poses, rows = corner[1].cam_from_world, np.arange(4)
    mounted = se3.compose(poses, se3.inverse(np.repeat(poses[:1], 4, axis=0)))
    sensors = Sensors(rows * 0, np.repeat(small.sensors.kind[:1], 4), rows + 1, small.images.camera_idx, mounted,
                      (rows == 0).astype(int), rows * 0 + 1)  # fmt: skip
    images = Images(rows + 1, small.images.names, small.images.camera_idx, rows * 0, rows)
    whole = corner[1].replace(rigs=Rigs([1]), sensors=sensors, frames=Frames([1], [0], poses[:1]), images=images)
    maps = DepthMaps(write_depths(tmp_path / "depth", corner[1]))
    model = whole.transformed(Similarity(1.0 / 3.0))
    result = map_images(corner[0], tmp_path / "work", model, MapOptions(refine_rigs=refined), depth=maps)
    assert result.depths.scale == pytest.approx(3.0, rel=5e-3)
    assert result.scene.num_measurements["point depths"] > 200
    np.testing.assert_allclose(result.scene.sensors.cam_from_rig, mounted, atol=5e-3)


def test_depths_beside_a_rolling_shutter_are_refused_at_once(corner, small, tmp_path):
    """Before minutes are spent on features: here no stage may begin."""
    named = []
    with pytest.raises(InputError, match="Depths do not support a rolling shutter"):
        map_images(
            corner[0], tmp_path / "work", small, MapOptions(rolling_shutter="rows"),
            lambda name, done, all_: named.append(name), depth=DepthMaps(tmp_path),
        )  # fmt: skip
    assert not named


def test_maps_of_something_else_are_refused(corner, small, tmp_path):
    """Inverse depths fall where depths grow."""
    folder = tmp_path / "depth"
    folder.mkdir()
    for stem, depth in facade_depths(corner[1]).items():
        np.save(folder / f"{stem}.npy", np.where(depth > 0, 1.0 / np.maximum(depth, 0.1), 0).astype(np.float32))
    with pytest.raises(InputError, match=r"fits the points by a scale of its own .* inverse depths"):
        measure_depths(small, DepthMaps(folder, relative=True))


def test_units_of_maps_that_scatter_are_left_out():
    rng = np.random.default_rng(0)
    image, true = np.repeat(np.arange(3), 50), rng.uniform(2.0, 6.0, 150)
    ratio = np.repeat([2.0, 0.5, 1.0], 50) * np.exp(np.repeat([0.01, 0.01, 0.6], 50) * rng.normal(size=150))
    units, said = own_units(ratio, ratio * true, image, ("a", "b", "c"))
    assert units[:2] == pytest.approx([2.0, 0.5], rel=0.01)
    assert np.isnan(units[2])
    assert "1 for" in said[0]


def test_noise_of_both_kinds_is_told_apart():
    rng = np.random.default_rng(0)
    depth = rng.uniform(1.0, 8.0, 5000)
    for constant, quadratic in ((0.02, 0.0), (0.0, 0.004), (0.01, 0.002)):
        found = fitted_noise(depth, rng.normal(size=5000) * (constant + quadratic * depth**2), np.full(5000, 1e-4))
        assert found.sigma(depth) == pytest.approx(constant + quadratic * depth**2, rel=0.25)
    few = fitted_noise(depth[:20], np.zeros(20), np.full(20, 1e-4))
    assert few.sigma(1.0) > 1e-3  # that of a Kinect


def test_means_of_depths_with_shared_errors_are_as_uncertain_as_stated():
    """Errors shared by cells and by images: the weighted mean of an image has the variance that its weights say."""
    rng = np.random.default_rng(3)
    images, each = 200, 60
    image = np.repeat(np.arange(images), each)
    pixel = rng.uniform(0, 600, (len(image), 2))
    cell = cells_of(image, pixel, np.full(len(image), 600.0))
    errors = rng.normal(size=len(image)) + rng.normal(size=cell.max() + 1)[cell] + 0.5 * rng.normal(size=images)[image]
    sigma = np.sqrt(2.25)
    found = shared_errors(errors / sigma, image, cell)
    assert found.near == pytest.approx(1.25 / 2.25, abs=0.05)
    assert found.far == pytest.approx(0.25 / 2.25, abs=0.04)
    weight = 1.0 / (sigma * found.factors(image, cell)) ** 2
    mean = np.bincount(image, weight * errors) / np.bincount(image, weight)
    assert np.mean(mean**2 * np.bincount(image, weight)) == pytest.approx(1.0, abs=0.25)
    assert shared_errors(rng.normal(size=len(image)), image, cell).near < 0.05


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda depth: np.zeros_like(depth), "holds any depth"),
        (lambda depth: depth[:, :-1], "479x360 pixels, its photograph 480x360"),
        (lambda depth: depth.T.copy(), "turned by 90 degrees"),
        (lambda depth: np.round(1000 * depth), "whole numbers .* --depth-scale 1000"),
    ],
)
def test_wrong_maps_are_refused(corner, small, tmp_path, spoil, said):
    folder = tmp_path / "depth"
    folder.mkdir()
    for stem, depth in facade_depths(corner[1]).items():
        np.save(folder / f"{stem}.npy", spoil(depth).astype(np.float32))
    with pytest.raises((InputError, FileFormatError), match=said):
        measure_depths(small, DepthMaps(folder))


def test_photographs_without_a_map_are_named(corner, small, tmp_path):
    folder = write_depths(tmp_path / "depth", corner[1])
    (folder / "0001.npy").unlink()
    found = measure_depths(small, DepthMaps(folder))
    assert found.warnings == ("1 of 4 photographs without a depth map, or with an empty one: 0001.png.",)
    assert np.isnan(found.units).tolist() == [False, True, False, False]


def test_a_unit_that_contradicts_other_measurements_is_refused(corner, small, tmp_path):
    maps = DepthMaps(write_depths(tmp_path / "depth", corner[1]))
    with pytest.raises(InputError, match=r"Lengths in the depth maps are 3 times those that positions"):
        measure_depths(small, maps, known=1.0)
    found = measure_depths(small, maps, known=1.0 / 3.0)
    assert found.scale == 1.0
    assert np.median(found.scene.point_depths.depth) < 2.5  # in units of the model


def test_the_command_says_the_unit(corner, small, tmp_path, capsys):
    from groma.io import write_scene

    write_scene(small, tmp_path / "model.npz")
    folder = tmp_path / "depth"
    folder.mkdir()
    for stem, depth in facade_depths(corner[1]).items():
        cv2.imwrite(str(folder / f"{stem}.png"), np.round(5000 * depth).astype(np.uint16))
    common = ["map", str(corner[0]), "--model", str(tmp_path / "model.npz"), "-o", str(tmp_path / "out")]
    assert run([*common, "--depth-scale", "5000"]) == 1
    assert "--depth-scale acts only with --depth" in capsys.readouterr().err
    assert run([*common, "--depth", str(folder), "--depth-scale", "5000", "--min-confidence", "0"]) == 0
    told = " ".join(capsys.readouterr().out.split())
    assert "The map has their unit of length (1 unit of the model was 2.99" in told
    numbers = json.loads((tmp_path / "out" / "summary.json").read_text())["depth"]
    assert numbers["scale"] == pytest.approx(3.0, rel=2e-3)
    written = read_scene(tmp_path / "out" / "scene.npz")
    assert evaluate_poses(written, corner[1]).alignment.scale == pytest.approx(1.0, abs=2e-3)
    assert len(written.line_depths) and len(written.point_depths)


def test_what_cameras_measured_of_lines_and_planes_goes_along_when_a_map_is_mapped_again(corner, mapped, tmp_path):
    """Depths of the same segments, and planes: the same ones where they are found, one that nothing shows as it is."""
    scene, hidden = mapped.scene, np.array([[0.6, 0.0, 0.8, -0.3]])
    planes = np.concatenate([scene.planes.hesse, hidden])
    model = scene.replace(planes=Planes(np.arange(len(planes)) + 1, planes))
    image, plane = (grid.ravel() for grid in np.meshgrid(np.arange(scene.num_images), np.arange(len(planes))))
    poses = scene.cam_from_world[image]
    normal = quaternion.rotate(poses[:, :4], planes[plane, :3])
    measured = np.column_stack([normal, planes[plane, 3] - (normal * poses[:, 4:]).sum(axis=1)])
    noise = np.tile(np.diag([1e2, 1e2, 1 / SIGMA]), (len(image), 1, 1))  # a hundredth, and the noise of depths
    model = model.replace(plane_observations=PlaneObservations(image, plane, measured, noise))
    again = map_images(corner[0], tmp_path / "work", model, MapOptions(min_confidence=0.0))
    assert not [sentence for sentence in again.warnings if "plane observations" in sentence]
    depths = [
        {tuple(segment): q for segment, q in zip(one.line_observations.segment[rows].round(3), q, strict=True)}
        for one in (scene, again.scene)
        for rows, q in [(one.line_depths.observation_idx, one.line_depths.inverse_depth)]
    ]
    both = depths[0].keys() & depths[1].keys()
    assert len(both) > 0.9 * len(depths[0])
    np.testing.assert_allclose([depths[1][key] for key in both], [depths[0][key] for key in both], rtol=1e-6)
    # Of the planes of the walls there are no two.
    found = again.scene.plane_observations
    assert len(found) == len(image) and again.scene.num_planes == len(planes)
    near = np.abs(again.scene.planes.hesse @ (hidden[0] * [1, 1, 1, 0]))
    assert (near > 0.999).sum() == 1
