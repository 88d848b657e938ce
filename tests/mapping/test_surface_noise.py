# SPDX-License-Identifier: BSD-3-Clause
"""How flat planes are, from the landmarks on them: told apart from the landmarks' own noise, careful where little is
known, and of use to the lines.
"""

from dataclasses import replace

import numpy as np
import pytest

import groma
from groma.adjustment.terms.relations import lengths_per_pixel
from groma.mapping.noise.landmarks import project_points
from groma.mapping.structure.find import StructureOptions, find_structure, landmark_noise
from groma.mapping.structure.flatness import plane_noise_px, surface_noise_px, with_rough_planes
from groma.scene import Directions, Planes, Relations, synthetic

NOISE = 0.15
OPTIONS = StructureOptions(surface_sigma_px=0.5)
HELD = groma.AdjustOptions(refine_poses=False, loss="none", point_sigma_px=NOISE, line_sigma_px=NOISE)


def room(rough_px, seed=0):
    """A corridor whose points stand off its walls by so much, as it is found in noisy images."""
    rng = np.random.default_rng(seed)
    truth = synthetic.corridor("tiny", seed=seed).truth
    point, plane = truth.relations.point_on_plane.T
    away = rough_px * lengths_per_pixel(truth, "point")[point] * rng.normal(size=len(point))
    xyz = truth.points.xyz.copy()
    np.add.at(xyz, point, away[:, None] * truth.planes.hesse[plane, :3])
    truth = truth.replace(points=truth.points.replace(xyz=xyz))
    seen = truth.point_observations
    pixels, _ = project_points(truth, seen.image_idx, xyz[seen.point_idx])
    segments = truth.line_observations
    noisy = truth.replace(
        point_observations=seen.replace(pixel=pixels + NOISE * rng.normal(size=pixels.shape)),
        line_observations=segments.replace(segment=segments.segment + NOISE * rng.normal(size=(len(segments), 4))),
    )
    bare = noisy.replace(planes=Planes(), relations=Relations(), directions=Directions())
    return find_structure(groma.adjust(bare, HELD).scene, OPTIONS)


def without_lines(scene):
    return scene.replace(relations=replace(scene.relations, line_on_plane=np.zeros((0, 2), int)))


@pytest.mark.parametrize("rough", [0.1, 0.2])
def test_roughness_is_found(rough):
    found = room(rough)
    assert surface_noise_px(without_lines(found), OPTIONS) == pytest.approx(rough, rel=0.25)


def test_each_plane_has_its_own_roughness():
    found = without_lines(room(0.2))
    each = plane_noise_px(found, OPTIONS)
    count = np.bincount(found.relations.point_on_plane[:, 1], minlength=found.num_planes)
    assert each[count >= 30] == pytest.approx(0.2, rel=0.5)
    # One plane whose points are moved onto it is flat, and the others are as before.
    plane = int(count.argmax())
    point = found.relations.point_on_plane[found.relations.point_on_plane[:, 1] == plane, 0]
    normal, offset = found.planes.hesse[plane, :3], found.planes.hesse[plane, 3]
    xyz = found.points.xyz.copy()
    xyz[point] -= (xyz[point] @ normal + offset)[:, None] * normal
    flat = plane_noise_px(found.replace(points=found.points.replace(xyz=xyz)), OPTIONS)
    assert flat[plane] < 0.3 * each[plane]
    assert (plane_noise_px(found.replace(relations=Relations()), OPTIONS) == OPTIONS.surface_sigma_px).all()


def test_planes_that_deviate_more_have_a_deviation_of_their_own():
    found = room(0.2)
    noise, each = landmark_noise(found, OPTIONS), plane_noise_px(found, OPTIONS)
    bound = float(np.median(each))
    given = with_rough_planes(found, bound, OPTIONS, noise).relations
    for kind, of in (("point_on_plane", "point"), ("line_on_plane", "line")):
        landmark, plane = getattr(given, kind).T
        own = np.where(each[plane] > bound, each[plane] * lengths_per_pixel(found, of)[landmark], 0.0)
        np.testing.assert_array_equal(given.sigma(kind), own)
    assert 0 < np.count_nonzero(given.sigma("point_on_plane")) < len(given.point_on_plane)
    # What has a deviation keeps it, and nothing is asked of a scene without relations.
    again = with_rough_planes(found.replace(relations=given), 0.0, OPTIONS, noise).relations
    before = given.sigma("point_on_plane")
    np.testing.assert_array_equal(again.sigma("point_on_plane")[before > 0.0], before[before > 0.0])
    bare = found.replace(relations=Relations())
    assert with_rough_planes(bare, bound, OPTIONS, noise).relations.point_on_plane.shape == (0, 2)


def test_flat_walls_are_flat():
    """Landmarks with noise of their own on planes that are exact."""
    found = room(0.0)
    assert surface_noise_px(without_lines(found), OPTIONS) < 0.06


def test_what_is_not_known_stays_large():
    found = room(0.0)
    assert surface_noise_px(found.replace(relations=Relations()), OPTIONS) == OPTIONS.surface_sigma_px
    # Three points are on any plane.
    point, plane = found.relations.point_on_plane.T
    three = Relations(point_on_plane=np.column_stack([point, plane])[plane == plane[0]][:3])
    assert surface_noise_px(found.replace(relations=three), OPTIONS) == OPTIONS.surface_sigma_px


def test_no_more_than_the_relations_were_found_with():
    found = room(0.4)
    assert surface_noise_px(found, StructureOptions(surface_sigma_px=0.1)) == pytest.approx(0.1)
