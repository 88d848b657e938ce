# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of which nothing is known: a second coefficient of distortion where residuals show it, and only there."""

import numpy as np
import pytest

from groma.cameras import model as camera_model
from groma.geometry import se3
from groma.mapping.options import MapOptions
from groma.mapping.start import LENS_NOTE, WIDER_LENS, _is_unknown, with_fitting_lens
from groma.scene import synthetic


def _seen_through(distortion: list[float]):
    """A scene as reconstructed with one coefficient, of photographs by a lens with others."""
    truth = synthetic.holistic(12, seed=3).truth.points_only()
    rng, seen = np.random.default_rng(0), truth.point_observations
    focal, cx, cy = truth.cameras.params[0][0], *truth.cameras.params[0][-2:]
    lens = np.array([focal, cx, cy, *distortion])
    in_camera = se3.transform_points(truth.cam_from_world[seen.image_idx], truth.points.xyz[seen.point_idx])
    pixel = camera_model("RADIAL").project(lens, in_camera) + rng.normal(0.0, 0.3, (len(seen), 2))
    return truth.replace(
        cameras=truth.cameras.with_model("SIMPLE_RADIAL"), point_observations=seen.replace(pixel=pixel)
    )


def test_a_lens_that_needs_two_coefficients_gets_them():
    found = with_fitting_lens(_seen_through([-0.25, 0.3]), MapOptions())
    assert set(found.cameras.models) == {WIDER_LENS}
    assert found.cameras.params[0][3:] == pytest.approx([-0.25, 0.3], abs=0.02)


def test_one_that_needs_one_keeps_it():
    scene = _seen_through([-0.1, 0.0])
    assert with_fitting_lens(scene, MapOptions(refine_intrinsics=False)) is scene
    found = with_fitting_lens(scene, MapOptions())
    assert set(found.cameras.models) == {"SIMPLE_RADIAL"}
    assert found.cameras.params[0][3] == pytest.approx(-0.1, abs=0.01)


def test_steps_are_limited():
    scene = _seen_through([-0.1, 0.0])
    told = {"camera_model": "SIMPLE_RADIAL", "refine_intrinsics": True}
    none, some = (with_fitting_lens(scene, MapOptions(max_iterations=most, **told)) for most in (0, 50))
    assert none.cameras.params_of(0) == pytest.approx(scene.cameras.params_of(0), abs=1e-9)
    assert np.abs(some.cameras.params_of(0) - scene.cameras.params_of(0)).max() > 1e-3


@pytest.mark.parametrize("said", [{"camera_model": "SIMPLE_RADIAL"}, {"camera_params": (500.0, 320.0, 240.0, 0.0)}])
def test_what_the_user_says_of_the_cameras_stays(said):
    assert _is_unknown(MapOptions())
    assert not _is_unknown(MapOptions(**said))


def test_the_note_names_the_model():
    assert WIDER_LENS in LENS_NOTE
