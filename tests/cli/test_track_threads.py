# SPDX-License-Identifier: BSD-3-Clause
"""``groma track`` leaves OpenCV one thread where its own are at work; pairs of images keep those of disparities."""

from types import SimpleNamespace

import cv2
import pytest

from groma.cli.main import run
from groma.errors import InputError
from groma.io import sequences
from groma.tracking import sequence


@pytest.mark.parametrize(
    ("baseline", "asked", "seen"),
    [(None, [], (1, True)), (0.1, [], (2, True)), (0.1, ["--threads", "2"], (2, True)),
     (0.1, ["--threads", "1"], (1, False))],
)  # fmt: skip
def test_opencv_has_threads_of_its_own_for_pairs_alone(tmp_path, monkeypatch, baseline, asked, seen):
    """And with ``--threads 1`` nobody has any."""
    found = []

    def look(frames, options, *arguments, **others):
        found.append((cv2.getNumThreads(), options.threaded))
        raise InputError("enough was seen")

    (tmp_path / "frames").mkdir()
    opened = SimpleNamespace(camera=SimpleNamespace(baseline=baseline))
    monkeypatch.setattr(sequences, "open_sequence", lambda *arguments, **options: opened)
    monkeypatch.setattr(sequence, "track", look)
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        assert run(["track", str(tmp_path / "frames"), "-o", str(tmp_path / "out"), *asked]) == 1
    finally:
        cv2.setNumThreads(before)
    assert found == [seen]
