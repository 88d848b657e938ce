# SPDX-License-Identifier: BSD-3-Clause
"""Segments under a lens that bends lines: found straight and whole, and given back as pixels of the image as it is."""

import cv2
import numpy as np
import pytest
from _facade import HEIGHT, WIDTH, facade

from groma import cameras
from groma.features.lsd import LsdDetector
from groma.features.segments import Segments
from groma.mapping.image_segments import Straightener, detect_segments

pytestmark = pytest.mark.kernels


def quiet(*_):
    pass


def straightener(extra, name="SIMPLE_RADIAL"):
    model = cameras.model(name)
    focal = [300.0] * len(model.focal_indices)
    params = np.array([*focal, 160.0, 120.0, *extra])
    return Straightener.of(model, params, 320, 240), model, params


def test_a_lens_that_bends_nothing_is_left_alone():
    assert straightener([0.0])[0] is None
    assert straightener([], "SIMPLE_PINHOLE")[0] is None
    assert straightener([1e-2])[0] is not None


@pytest.mark.compiled
@pytest.mark.parametrize(
    ("name", "extra"),
    [
        ("SIMPLE_RADIAL", [-0.3]),
        ("SIMPLE_RADIAL", [0.2]),
        ("OPENCV_FISHEYE", [0.1, 0.02, 0.0, 0.0]),
        ("SIMPLE_FISHEYE", []),
        ("RADIAL_FISHEYE", [0.05, -0.01]),
        ("THIN_PRISM_FISHEYE", [0.05, -0.01, 0.001, -0.002, 0.0, 0.0, 0.003, -0.001]),
        ("FOV", [0.9]),
        ("SIMPLE_DIVISION", [-0.3]),
        ("DIVISION", [0.2]),
        ("EUCM", [0.6, 1.1]),
    ],
)
def test_end_points_come_back_to_the_image(name, extra):
    made, model, params = straightener(extra, name)
    assert made is not None
    straight = np.array([[60.0, 50.0, 250.0, 70.0], [100.0, 200.0, 220.0, 190.0], [-900.0, 100.0, 900.0, 110.0]])
    shift = np.tile(made.K[:2, 2] - params[list(model.principal_point_indices)], 2)

    class Given:
        def detect(self, image):
            assert image.shape == made.source.shape[:2]
            return Segments.from_ends(straight + shift)

    found = made.detect(Given(), np.zeros((240, 320), np.uint8))
    assert len(found) == 3
    back = model.undistort_pixels(params, found.ends.reshape(-1, 2)).reshape(-1, 4)
    np.testing.assert_allclose(back[:2], straight[:2], atol=1e-6)
    # what reaches beyond the image is cut, and stays on its line
    assert (found.ends[2] >= 0).all() and (found.ends[2, [0, 2]] <= 320).all()
    line = np.cross([-900.0, 100.0, 1.0], [900.0, 110.0, 1.0])
    np.testing.assert_allclose(np.column_stack([back[2].reshape(2, 2), [1, 1]]) @ line / 1800.0, 0.0, atol=1e-6)


@pytest.mark.compiled
def test_bent_lines_are_found_whole(tmp_path):
    """Segments of a bent photograph: longer in all, and as close to the true lines as those of a lens without bend."""
    total = {}
    for extra in (0.0, -0.25):
        folder = tmp_path / str(extra)
        scene = facade(folder, 2, model="SIMPLE_RADIAL", extra=(extra,))
        detector = LsdDetector(min_length=40.0)
        model, params = cameras.model("SIMPLE_RADIAL"), scene.cameras.params_of(0)
        straightened = detect_segments(folder, scene, detector, quiet)[0]
        image = cv2.imread(str(folder / scene.images.names[0]), cv2.IMREAD_GRAYSCALE)
        total["plain", extra] = straight_length(model, params, detector.detect(image))
        total["straightened", extra] = straight_length(model, params, straightened)
        assert ((straightened.ends >= 0) & (straightened.ends <= [WIDTH, HEIGHT, WIDTH, HEIGHT])).all()
    assert total["straightened", 0.0] == total["plain", 0.0]
    assert total["straightened", -0.25] > 1.15 * total["plain", -0.25]


def straight_length(model, params, segments):
    ends = model.undistort_pixels(params, segments.ends.reshape(-1, 2)).reshape(-1, 4)
    return float(np.hypot(ends[:, 2] - ends[:, 0], ends[:, 3] - ends[:, 1]).sum())
