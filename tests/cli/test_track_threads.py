# SPDX-License-Identifier: BSD-3-Clause
"""``groma track`` leaves OpenCV one thread where its own are at work; pairs of images keep those of disparities."""

from types import SimpleNamespace

import cv2
import pytest

from groma.cli.main import run
from groma.errors import InputError
from groma.io import sequences
from groma.tracking import sequence


@pytest.mark.parametrize(("baseline", "threads"), [(None, 1), (0.1, 2)])
def test_opencv_has_threads_of_its_own_for_pairs_alone(tmp_path, monkeypatch, baseline, threads):
    seen = []

    def look(*arguments, **options):
        seen.append(cv2.getNumThreads())
        raise InputError("enough was seen")

    (tmp_path / "frames").mkdir()
    opened = SimpleNamespace(camera=SimpleNamespace(baseline=baseline))
    monkeypatch.setattr(sequences, "open_sequence", lambda *arguments, **options: opened)
    monkeypatch.setattr(sequence, "track", look)
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        assert run(["track", str(tmp_path / "frames"), "-o", str(tmp_path / "out")]) == 1
    finally:
        cv2.setNumThreads(before)
    assert seen == [threads]
