# SPDX-License-Identifier: BSD-3-Clause
"""Frames from image files, read ahead of time by one thread.

A layout makes a list of entries; the reader opens their files while the frames before them are worked on. What cannot
be read is left out, and said in ``warnings``: a frame without its image is skipped, one without its depth or right
image comes without.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from groma._typing import BoolArray
from groma.bounded.images import decoded
from groma.errors import FileFormatError, InputError
from groma.io.colmap.masks import Masks
from groma.io.depth_maps import at_size, has_proportions
from groma.io.sequences._calibration import Calibration, Rectification, rectification
from groma.io.sequences.frame import Frame, Kind, SequenceCamera
from groma.io.trajectories import Trajectory

#: Frames that are read ahead.
AHEAD = 2
#: How grey levels are read from files.
_GRAY = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
#: Images of a sequence that tell how many bits its levels have (cost: of reading them).
_ASKED = 8


@dataclass(frozen=True)
class Entry:
    """The files of one frame."""

    timestamp: float
    gray: Path
    depth: Path | None = None
    right: Path | None = None


@dataclass(frozen=True)
class Selection:
    """Which frames of a sequence are given."""

    #: Every n-th frame.
    stride: int = 1
    #: Maximum number of frames.
    max_frames: int | None = None
    #: Leave out what this kind does not hold.
    kind: Kind | None = None

    def __post_init__(self) -> None:
        if self.stride < 1 or (self.max_frames is not None and self.max_frames < 1):
            raise InputError(f"stride and max_frames must be at least 1; got {self.stride} and {self.max_frames}.")
        if self.kind not in (None, "rgbd", "stereo", "mono"):
            raise InputError(f"kind must be 'rgbd', 'stereo' or 'mono'; got {self.kind!r}.")

    def kind_of(self, available: Kind) -> Kind:
        """Return the kind to give where ``available`` is what the files hold."""
        if self.kind not in (None, "mono", available):
            others = "" if available == "mono" else " or 'mono'"
            raise InputError(
                f"The sequence is {available!r}, not {self.kind!r}. Pass {available!r}{others} as its kind."
            )
        return self.kind or available

    def of(self, entries: list[Entry], warnings: list[str]) -> list[Entry]:
        """Put entries in order of time, without repeated times, and choose."""
        ordered = sorted(entries, key=lambda entry: entry.timestamp)
        if any(a is not b for a, b in zip(ordered, entries, strict=True)):
            warnings.append("The times of the frames were not in order; the frames are given in order of time.")
        unique = ordered[:1]
        for entry in ordered[1:]:
            if entry.timestamp > unique[-1].timestamp:
                unique.append(entry)
            else:
                warnings.append(f"{entry.gray.name} has the time of {unique[-1].gray.name} and is left out.")
        return unique[:: self.stride][: self.max_frames]


@dataclass(frozen=True, eq=False)
class Preparation:
    """What happens to images after they are read."""

    gray: Rectification | None = None
    right: Rectification | None = None
    #: Depth in files per metre (convention: millimetres).
    depth_scale: float = 1000.0
    #: Depth (metres) from the depth camera to the camera that took ``gray``.
    register: Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]] | None = None


@dataclass(eq=False)
class FileSequence:
    """A :class:`~groma.io.sequences.frame.Sequence` of image files."""

    kind: Kind
    entries: list[Entry]
    camera: SequenceCamera
    preparation: Preparation
    #: Width and height of the images in the files.
    file_size: tuple[int, int]
    reference: Trajectory | None
    warnings: list[str]
    #: What may be used of the images in the files; None: all.
    masks: Masks | None = None
    num_frames: int | None = field(init=False)
    #: The brightest level of images of 16 bits.
    full_level: int = field(init=False)

    def __post_init__(self) -> None:
        self.num_frames = len(self.entries)
        self.full_level = full_level(self.entries)

    def __len__(self) -> int:
        return len(self.entries)

    @property
    def pictures(self) -> dict[str, Path]:
        """The files of frames by name; empty where frames are rectified, so that no file shows what was tracked."""
        return {} if self.preparation.gray is not None else {entry.gray.name: entry.gray for entry in self.entries}

    def __iter__(self) -> Iterator[Frame]:
        for frame, remarks in read_ahead(self._load, self.entries):
            self.warnings.extend(remark for remark in remarks if remark not in self.warnings)
            if frame is not None:
                yield frame

    def _load(self, entry: Entry) -> tuple[Frame | None, list[str]]:
        remarks: list[str] = []
        preparation, width, height = self.preparation, *self.file_size
        shape = (height, width)
        gray = _image(entry.gray, shape, self.full_level, remarks, "the frame is skipped")
        if gray is None:
            return None, remarks
        if preparation.gray is not None:
            gray = preparation.gray.gray(gray)
        depth = right = None
        if self.kind == "rgbd":
            depth = self._depth(entry.depth, entry.gray.name, remarks)
        if self.kind == "stereo" and entry.right is None:
            remarks.append(f"{entry.gray.name} has no right image.")
        elif self.kind == "stereo" and entry.right is not None:
            right = _image(entry.right, shape, self.full_level, remarks, "the frame comes without")
            if right is not None and preparation.right is not None:
                right = preparation.right.gray(right)
        return Frame(entry.timestamp, gray, depth, right, entry.gray.name, self._used(entry.gray.name)), remarks

    def _used(self, name: str) -> BoolArray | None:
        used = None if self.masks is None else self.masks.read(name, self.file_size)
        if used is None or self.preparation.gray is None:
            return used
        return np.asarray(self.preparation.gray.gray(used.astype(np.uint8) * 255) == 255, np.bool_)

    def _depth(self, path: Path | None, name: str, remarks: list[str]) -> npt.NDArray[np.float32] | None:
        if path is None:
            remarks.append(f"{name} has no depth image.")
            return None
        try:
            raw = _decode(path, cv2.IMREAD_UNCHANGED)
        except FileFormatError as error:
            remarks.append(f"{path.name}: {error}")
            return None
        width, height = self.file_size
        if raw is None or not has_proportions(raw.shape, self.file_size):
            what = "cannot be read" if raw is None else f"is {raw.shape[1]}x{raw.shape[0]}, not {width}x{height} grey"
            remarks.append(f"{path.name} {what}; the frame comes without.")
            return None
        if raw.dtype == np.uint8:  # a picture of depths; distances in so few steps would be taken for exact
            remarks.append(f"{path.name} has 8 bits, too few for distances (16 or floats); the frame comes without.")
            return None
        raw = at_size(raw, self.file_size)
        depth = raw.astype(np.float32) * np.float32(1.0 / self.preparation.depth_scale)
        # 65535 stands for no value in some data; NaN in images of floats.
        bad = raw == 65535 if raw.dtype == np.uint16 else ~(np.isfinite(depth) & (depth > 0))
        depth[bad] = 0.0
        if self.preparation.register is not None:
            depth = self.preparation.register(depth)
        elif self.preparation.gray is not None:
            depth = self.preparation.gray.depth(depth)
        return depth


def read_ahead(load: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    """Yield ``load(item)`` in order, computed by another thread up to ``AHEAD`` items ahead."""
    with ThreadPoolExecutor(1, thread_name_prefix="groma-frames") as pool:
        waiting: deque[Future[Any]] = deque()
        try:
            for item in items:
                waiting.append(pool.submit(load, item))
                if len(waiting) > AHEAD:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            for future in waiting:
                future.cancel()


def file_size(entries: list[Entry], calibration: Calibration) -> tuple[int, int]:
    """Return width and height that the first readable image has, and refuse a calibration of another size."""
    for entry in entries:
        image = _decode(entry.gray, _GRAY)
        if image is not None:
            size = (image.shape[1], image.shape[0])
            if calibration.size not in (None, (0, 0), size):
                raise InputError(
                    f"The camera is for images of {calibration.size}, but {entry.gray} has {size}. Pass the camera "
                    "of these images, or scale its focal lengths and principal point."
                )
            return size
    raise InputError(f"None of the {len(entries)} images can be read, such as {entries[0].gray if entries else 'any'}.")


def full_level(entries: list[Entry]) -> int:
    """Return the brightest level in the format of images of 16 bits: cameras of 10, 12 and 14 are stored in them.

    It is that of the least number of bits that some images fit into; with one for all, brightness stays as it is from
    frame to frame.
    """
    brightest = 0
    for entry in entries[:: max(1, len(entries) // _ASKED)]:
        try:
            image = _decode(entry.gray, _GRAY | cv2.IMREAD_ANYDEPTH)
        except FileFormatError:
            continue
        if image is not None and image.dtype != np.uint16:
            return 65535
        brightest = max(brightest, 0 if image is None else int(image.max()))
    return next(2**bits - 1 for bits in (8, 10, 12, 14, 16) if brightest < 2**bits)


def simple_sequence(
    kind: Kind,
    entries: list[Entry],
    calibration: Calibration,
    reference: Trajectory | None,
    warnings: list[str],
    preparation: Preparation | None = None,
    baseline: float | None = None,
) -> FileSequence:
    """Return a sequence of one camera (or a rectified pair) whose images are undistorted where necessary."""
    size = file_size(entries, calibration)
    preparation = preparation or Preparation()
    target = calibration.pinhole()
    if not calibration.is_pinhole:
        preparation = replace(preparation, gray=rectification(calibration, target, size))
    camera = SequenceCamera("PINHOLE", target, *size, baseline if kind == "stereo" else None)
    return FileSequence(kind, entries, camera, preparation, size, reference, warnings)


def _decode(path: Path, flags: int) -> npt.NDArray[Any] | None:
    """Return the image in a file, or None."""
    try:
        return decoded(path.read_bytes(), flags)
    except OSError:
        return None


def _image(
    path: Path, shape: tuple[int, int], full: int, remarks: list[str], otherwise: str
) -> npt.NDArray[np.uint8] | None:
    """Return the grey levels in a file in 8 bits; ``full`` is the brightest level of 16."""
    try:
        image = _decode(path, _GRAY | cv2.IMREAD_ANYDEPTH)
        if image is not None and image.dtype not in (np.uint8, np.uint16):
            image = _decode(path, _GRAY)
    except FileFormatError as error:
        remarks.append(f"{path.name}: {error}")
        return None
    if image is None:
        remarks.append(f"{path.name} cannot be read; {otherwise}.")
        return None
    if image.shape != shape:
        remarks.append(
            f"{path.name} is {image.shape[1]}x{image.shape[0]}, not {shape[1]}x{shape[0]} as the others; {otherwise}."
        )
        return None
    return np.asarray(image if image.dtype == np.uint8 else cv2.convertScaleAbs(image, alpha=255.0 / full), np.uint8)
