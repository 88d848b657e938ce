# SPDX-License-Identifier: BSD-3-Clause
"""Stereo pairs in the folders left and right: names, order, calibration, faults."""

import pytest

from groma.errors import InputError
from groma.io.sequences import open_sequence


def test_stereo_pairs_of_any_camera(kitti, tmp_path):
    """In left and right, with a calibration as of KITTI; paired by name, or by number."""
    expected = [(f.timestamp, int(f.gray[0, 0]), int(f.right[0, 0])) for f in open_sequence(kitti)]
    for place, names in enumerate((("left", "right"), ("Left", "Right"))):
        for side, name in enumerate(names):
            (kitti / (f"image_{side}" if place == 0 else ("left", "right")[side])).rename(kitti / name)
        sequence = open_sequence(kitti)
        assert (sequence.kind, sequence.camera.baseline) == ("stereo", 0.5)
        assert [(f.timestamp, int(f.gray[0, 0]), int(f.right[0, 0])) for f in sequence] == expected
        for name in names:  # ..., 2 and 10, whose order is that of numbers
            for row, path in enumerate(sorted((kitti / name).iterdir())):
                path.rename(path.with_name(f"{name}_{(1, 2, 10)[row]}.png"))
    (kitti / "Right" / "Right_2.png").unlink()
    sequence = open_sequence(kitti)
    assert [frame.right is None for frame in sequence] == [False, True, False]
    assert sequence.warnings == ["Left_2.png has no right image."]
    mono = open_sequence(kitti, kind="mono", camera="70 70 30 20")
    assert (mono.kind, mono.camera.baseline, next(iter(mono)).right) == ("mono", None, None)
    for damaged in (
        "P0: 70 0 30 0 0 70 20 0 0 0 1 0\n",
        "P0: 70 0 30 0 0 70 20 0 0 0 1 0\nP1: 70 0 30 9 0 70 20 0 0 0 1 0\n",
    ):
        (kitti / "calib.txt").write_text(damaged)
        with pytest.raises(InputError, match=r"does not say how the cameras lie. Write it: 'P0: f 0 cx .* --kind mono"):
            open_sequence(kitti)
    (kitti / "calib.txt").write_text("P0: 70 0 30 0 0 70 20 0 0 0 1 0\nP1: 70 0 30 -35 0 70 20 0 0 0 1 0\n")
    for number, path in enumerate((kitti / "Right").iterdir()):
        path.rename(path.with_name(f"{number + 50}.png"))
    with pytest.raises(InputError, match=r"No image of the left camera, such as Left_1.png, has the name or number"):
        open_sequence(kitti)
