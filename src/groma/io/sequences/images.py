# SPDX-License-Identifier: BSD-3-Clause
"""One camera: the images of a folder, or a video file, with a camera that is passed or lies beside the images.

Images are taken in order of the numbers in their names. Their times are the lines of ``times.txt`` if it is there, else
the names, where all are numbers of seconds (with a decimal point) or nanoseconds (16 digits and more), else the count
at 30 frames a second. A video has its own rate.
"""

from __future__ import annotations

import re
from collections.abc import Generator, Iterator
from itertools import repeat
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from groma._counted import natural_key
from groma.bounded.names import IMAGES, masks_among
from groma.bounded.text import finite, read_words
from groma.errors import FileFormatError, InputError
from groma.io.reading import reading
from groma.io.sequences._calibration import Calibration, find_calibration, rectification
from groma.io.sequences._reader import Entry, FileSequence, Selection, read_ahead, simple_sequence
from groma.io.sequences.frame import Frame, Kind, SequenceCamera
from groma.io.sequences.layouts import Wishes
from groma.io.trajectories import Trajectory, read_trajectory

#: Default frame rate, 1/s (convention: usual for video).
RATE = 30.0


def image_files(folder: Path) -> list[Path]:
    """Return the images of a folder (or of ``images`` or ``rgb`` in it) in order of the numbers in their names."""
    return next((found for place in (folder, folder / "images", folder / "rgb") if (found := images_in(place))), [])


def images_in(folder: Path) -> list[Path]:
    """Return the images of a folder itself in order of the numbers in their names; none where it is not there."""
    if not folder.is_dir():
        return []
    found = {path.name for path in folder.iterdir() if path.suffix.lower() in IMAGES and path.is_file()}
    return [folder / name for name in sorted(found - masks_among(found), key=natural_key)]


def camera_for(place: Path, wishes: Wishes, *folders: Path) -> Calibration:
    """Return the camera that is passed, or lies in one of the folders; InputError where there is none."""
    found = wishes.calibration or next((one for one in map(find_calibration, folders) if one is not None), None)
    if found is None:
        raise InputError(
            f"No camera is known for {place}. Pass one (--camera), such as 'fx fy cx cy', or the name of a file with a "
            "line of COLMAP's cameras.txt, or put it into cameras.txt beside the images. If it is unknown, groma map "
            "estimates it from some of the images: pass its OUT (--camera OUT)."
        )
    return found


def open_images(folder: Path, wishes: Wishes) -> FileSequence:
    """Open a folder of images; see :func:`groma.io.sequences.open_sequence`."""
    warnings: list[str] = []
    kind = wishes.selection.kind_of("mono")
    images = image_files(folder)
    calibration = camera_for(folder, wishes, folder, images[0].parent)
    entries = [Entry(time, path) for time, path in zip(times_of(folder, images), images, strict=True)]
    return simple_sequence(kind, wishes.selection.of(entries, warnings), calibration, reference_of(folder), warnings)


def open_video(path: Path, wishes: Wishes) -> VideoSequence:
    """Open a video file; see :func:`groma.io.sequences.open_sequence`."""
    wishes.selection.kind_of("mono")
    return VideoSequence(path, camera_for(path, wishes, path.parent), wishes.selection)


class VideoSequence:
    """A :class:`~groma.io.sequences.frame.Sequence` of the frames of a video; their number is not known before."""

    kind: Kind = "mono"
    num_frames: int | None = None
    reference: Trajectory | None = None

    def __init__(self, path: Path, calibration: Calibration, selection: Selection) -> None:
        self.warnings: list[str] = []
        self._path, self._selection = path, selection
        first = next(self._raw(), None)
        if first is None:
            raise FileFormatError(f"{path} is not a video that OpenCV can read, or it is empty. Convert it to MP4.")
        size = (first[1].shape[1], first[1].shape[0])
        if calibration.size not in (None, (0, 0), size):
            raise InputError(
                f"The camera is for images of {calibration.size}, but {path} has {size}. Pass the camera of the "
                "video: phones crop and scale differently for photographs."
            )
        target = calibration.pinhole()
        self.camera = SequenceCamera("PINHOLE", target, *size)
        self._maps = None if calibration.is_pinhole else rectification(calibration, target, size)

    def __iter__(self) -> Iterator[Frame]:
        source = self._raw()
        try:
            # The other thread pulls; here we only wait, so the decoder is used by one thread at a time.
            for frame in read_ahead(lambda _: self._next(source), repeat(None)):
                if frame is None:
                    break
                yield frame
        finally:
            source.close()

    def _next(self, source: Iterator[tuple[int, npt.NDArray[np.uint8], float]]) -> Frame | None:
        item = next(source, None)
        if item is None:
            return None
        number, image, time = item
        gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY) if image.ndim == 3 else image
        gray = np.asarray(gray, np.uint8)
        return Frame(time, gray if self._maps is None else self._maps.gray(gray), name=str(number))

    def _raw(self) -> Generator[tuple[int, npt.NDArray[np.uint8], float]]:
        """Yield the chosen frames: number, image, time."""
        capture = cv2.VideoCapture(str(self._path))
        try:
            rate = capture.get(cv2.CAP_PROP_FPS)
            rate = rate if np.isfinite(rate) and 0 < rate < 10000 else RATE
            number = given = 0
            while self._selection.max_frames is None or given < self._selection.max_frames:
                if not capture.grab():
                    return
                if number % self._selection.stride == 0:
                    good, image = capture.retrieve()
                    if good and image is not None:
                        given += 1
                        yield number, np.asarray(image, np.uint8), number / rate
                number += 1
        finally:
            capture.release()


def times_of(folder: Path, images: list[Path]) -> list[float]:
    """Return the seconds of images; see the module."""
    for name in ("times.txt", "timestamps.txt"):
        path = folder / name
        if path.is_file():
            with reading(path, "list of times"):
                times = [finite(row[:1], f"{path}, line {line}", "a finite time")[0] for line, row in read_words(path)]
                if len(times) != len(images):
                    raise FileFormatError(f"expected {len(images)} times, one per image; got {len(times)}.")
            return times
    stems = [path.stem for path in images]
    if all(re.fullmatch(r"\d+\.\d+", stem) for stem in stems):
        return [float(stem) for stem in stems]
    if all(re.fullmatch(r"\d{16,}", stem) for stem in stems):
        return [int(stem) * 1e-9 for stem in stems]
    return [number / RATE for number in range(len(images))]


def reference_of(folder: Path) -> Trajectory | None:
    """Return the trajectory in ``groundtruth.txt``, if it is there."""
    path = folder / "groundtruth.txt"
    return read_trajectory(path, "tum") if path.is_file() else None
