"""Lines of a photographed church front with surveyed poses: as many as published tools find, as well observed."""

import cv2
import numpy as np
import pytest

from groma.features.lsd import LsdDetector
from groma.io import read_scene
from groma.mapping.lines.build import map_lines


@pytest.mark.shared
@pytest.mark.parametrize("count", [4, pytest.param(8, marks=pytest.mark.slow)])
def test_herz_jesus(shared_data, count):
    folder = shared_data / "strecha_herz_jesus_p8"
    scene = read_scene(folder / "sparse_gt").subset(range(count))
    detector = LsdDetector()
    segments = [detector.detect(cv2.imread(str(folder / "images" / name), 0)) for name in scene.images.names]
    result = map_lines(scene, segments)
    assert np.median(result.residual) < 0.15
    # LIMAP 2.0 from segments of 40 pixels and more of all eight: 242 lines, 169 in four images, 4.6 images each.
    assert result.num_lines >= (3 if count == 8 else 1) * 242
    assert (result.num_images >= 4).sum() >= (3 if count == 8 else 1) * 169
    assert count < 8 or result.num_images.mean() >= 4.6
