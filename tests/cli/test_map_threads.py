# SPDX-License-Identifier: BSD-3-Clause
"""``groma map`` uses the threads it was given, and no others."""

import cv2
import pytest

from groma.cli.main import run
from groma.errors import InputError
from groma.mapping import map as mapping


@pytest.fixture
def opencv_threads():
    """OpenCV's own number is two, and what it was afterwards."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    yield
    cv2.setNumThreads(before)


def test_opencv_has_no_threads_of_its_own(tmp_path, monkeypatch, opencv_threads):
    seen = []

    def look(*arguments):
        seen.append(cv2.getNumThreads())
        raise InputError("enough was seen")

    (tmp_path / "photos").mkdir()
    monkeypatch.setattr(mapping, "map_images", look)
    assert cv2.getNumThreads() == 2
    assert run(["map", str(tmp_path / "photos"), "-o", str(tmp_path / "out")]) == 1
    assert seen == [1]
