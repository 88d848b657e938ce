"""Lines of a photographed church front with surveyed poses: as many as published tools find, as well observed."""

import cv2
import numpy as np
import pytest

from groma.features.lsd import LsdDetector
from groma.io import read_scene
from groma.mapping.lines.build import map_lines


@pytest.mark.shared
def test_herz_jesus(shared_data):
    folder = shared_data / "strecha_herz_jesus_p8"
    scene = read_scene(folder / "sparse_gt")
    detector = LsdDetector()
    segments = [detector.detect(cv2.imread(str(folder / "images" / name), 0)) for name in scene.images.names]
    result = map_lines(scene, segments)
    # LIMAP 2.0 from segments of 40 pixels and more: 242 lines, 169 of them in four images, 4.6 images each.
    assert result.num_lines >= 3 * 242
    assert (result.num_images >= 4).sum() >= 3 * 169
    assert result.num_images.mean() >= 4.6
    assert np.median(result.residual) < 0.15
