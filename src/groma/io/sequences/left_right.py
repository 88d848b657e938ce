# SPDX-License-Identifier: BSD-3-Clause
"""Rectified stereo pairs of any camera: images in ``left`` and ``right``, and ``calib.txt`` as of KITTI.

``calib.txt`` has a line for the left camera, ``P0: f 0 cx 0 0 f cy 0 0 0 1 0``, and one for the right camera at a
baseline b, ``P1: f 0 cx -f*b 0 f cy 0 0 0 1 0``. Images are paired by their names, or by the last numbers in these;
times are found as those of a single camera (:mod:`groma.io.sequences.images`).
"""

from __future__ import annotations

from pathlib import Path

from groma.errors import InputError
from groma.io.sequences._calibration import from_opencv
from groma.io.sequences._reader import Entry, FileSequence, simple_sequence
from groma.io.sequences.images import camera_for, images_in, reference_of, times_of
from groma.io.sequences.kitti import baseline_of, projections
from groma.io.sequences.layouts import Wishes
from groma.io.sequences.two_folders import number_of

#: Folders of the left and the right camera (belongs to the format).
FOLDERS = (("left", "right"), ("Left", "Right"), ("image_left", "image_right"), ("image_l", "image_r"))


def is_left_right(folder: Path) -> bool:
    """Whether a folder has this layout."""
    return _images(folder) is not None


def open_left_right(folder: Path, wishes: Wishes) -> FileSequence:
    """Open a folder; see :func:`groma.io.sequences.open_sequence`."""
    found = _images(folder)
    assert found is not None
    lefts, rights = found
    kind = wishes.selection.kind_of("stereo")
    baseline, calibration, right_of = None, wishes.calibration, {}
    if kind == "stereo":
        path = folder / "calib.txt"
        matrices = projections(path) if path.is_file() else {}
        baseline = baseline_of(matrices.get("P0"), matrices.get("P1"))
        if baseline is None or baseline <= 0:
            raise InputError(
                f"{folder} holds stereo pairs, but {path.name} in it does not say how the cameras lie. Write it: "
                "'P0: f 0 cx 0 0 f cy 0 0 0 1 0' and, for the right camera at a baseline b, 'P1: f 0 cx -f*b 0 f cy 0 "
                "0 0 1 0', with numbers in place of the letters. Or follow the left camera alone: --kind mono."
            )
        calibration = calibration or from_opencv(matrices["P0"][[0, 1, 0, 1], [0, 1, 2, 2]])
        right_of = _partners(lefts, rights)
    calibration = calibration or camera_for(folder, wishes, folder, lefts[0].parent)
    entries = [
        Entry(time, left, right=right_of.get(left)) for time, left in zip(times_of(folder, lefts), lefts, strict=True)
    ]
    warnings: list[str] = []
    return simple_sequence(
        kind, wishes.selection.of(entries, warnings), calibration, reference_of(folder), warnings, baseline=baseline
    )


def _images(folder: Path) -> tuple[list[Path], list[Path]] | None:
    """Return the images of the left and of the right camera."""
    pairs = ((images_in(folder / left), images_in(folder / right)) for left, right in FOLDERS)
    return next((pair for pair in pairs if all(pair)), None)


def _partners(lefts: list[Path], rights: list[Path]) -> dict[Path, Path]:
    """Return the right image of each left one that has one: of the same name, or with the same number."""
    for name in (lambda path: path.stem, number_of):
        right_of = {name(right): right for right in rights}
        if found := {left: right_of[name(left)] for left in lefts if name(left) in right_of}:
            return found
    raise InputError(
        f"No image of the left camera, such as {lefts[0].name}, has the name or number of one of the right camera, "
        f"such as {rights[0].name}. Name them alike."
    )
