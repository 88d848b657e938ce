# SPDX-License-Identifier: BSD-3-Clause
"""Which calibration a query begins with: that of the map, what its file says, or none."""

from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from groma.errors import InputError
from groma.localization import run
from groma.localization.calibration import CalibrationChoice, calibration_of
from groma.localization.localizer import Localizer
from groma.localization.pose.camera import QueryCamera

SIZE = (64, 48)
OF_MAP = QueryCamera("SIMPLE_PINHOLE", np.array([100.0, 32.0, 24.0]), *SIZE)


def _photograph(path, millimetres):
    """A photograph whose file tells a focal length on film of 36 mm, or none."""
    exif = Image.Exif()
    if millimetres:
        exif.get_ifd(0x8769)[0xA405] = millimetres
    Image.new("L", SIZE).save(path, exif=exif)
    return path


@pytest.mark.parametrize(
    ("own", "of_the_map", "is_that_of_the_map"),
    [
        (None, None, True),
        (54, None, True),  # 54 / 43.3 * 80 is 100 pixels
        (24, None, False),
        (24, 24, True),  # files that tell the focal length of photographs before they were cropped
        (54, 24, False),  # another camera than that of the map
        (None, 24, True),
    ],
)
def test_what_a_file_tells_is_compared_with_what_files_of_the_map_tell(tmp_path, own, of_the_map, is_that_of_the_map):
    query, other = _photograph(tmp_path / "query.jpg", own), _photograph(tmp_path / "map.jpg", of_the_map)
    found = calibration_of(query, SIZE, OF_MAP, CalibrationChoice(), other)
    assert (found.camera is None, found.refine) == (is_that_of_the_map, not is_that_of_the_map)
    if not is_that_of_the_map:
        assert found.camera.params[0] == pytest.approx(own / np.hypot(36, 24) * np.hypot(*SIZE), rel=1e-3)


class _Map:
    """Two photographs of two sizes; it tells with which camera a query is looked for."""

    scene = SimpleNamespace(
        cameras=SimpleNamespace(width=np.array([80, 64]), height=np.array([48, 48])),
        images=SimpleNamespace(camera_idx=np.array([0, 1])),
    )

    def __init__(self, files):
        self.files, self.asked = files, []

    photograph_of_map = Localizer.photograph_of_map

    def camera_of_map(self, *size):
        return OF_MAP

    def localize(self, image, camera, refine, used):
        self.asked.append((camera, refine))
        raise InputError("That is enough.")


def test_a_query_is_compared_with_a_photograph_of_its_size(tmp_path):
    files = [_photograph(tmp_path / "other.jpg", 54), _photograph(tmp_path / "same.jpg", 24)]
    map_ = _Map(files)
    assert Localizer.photograph_of_map(map_, 10, 10) is None
    run._localize(map_, "query.jpg", _photograph(tmp_path / "query.jpg", 24), CalibrationChoice(), None)
    assert map_.asked == [(None, False)]  # that of the map
