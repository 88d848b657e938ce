# SPDX-License-Identifier: BSD-3-Clause
"""Cameras of sequences, from a file or an option, and the maps that remove distortion.

Files of calibrations count pixels from the centre of the first pixel, COLMAP from its corner; groma counts as COLMAP
does. Half a pixel is therefore added to principal points, except those in lines of COLMAP.
"""

from __future__ import annotations

import os
from collections.abc import Sequence as Numbers
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from groma import cameras
from groma._typing import FloatArray, IntArray
from groma.bounded.documents import member, number, of_kind, read_document, size, table
from groma.bounded.text import finite, is_number, read_text, whole
from groma.errors import FileFormatError, InputError
from groma.io.reading import reading
from groma.io.registry import read_scene
from groma.io.sequences._yaml import yaml_entries, yaml_numbers
from groma.io.sequences.frame import SequenceCamera, checked_params

#: What callers may pass as a camera: a value, numbers, a line, or the name of a file.
CameraLike = SequenceCamera | Numbers[float] | str | os.PathLike[str]
#: Names under which a calibration may lie in the folder of a sequence.
FILE_NAMES = (
    "cameras.txt", "camera.txt", "calibration.txt", "calib.txt", "intrinsics.txt", "camera-intrinsics.txt",
    "camera_intrinsic.json", "cam_params.json",
)  # fmt: skip

#: Pixels whose rays are computed at a time (cost: memory).
_BAND = 1 << 18

_HELP = (
    "expected 'fx fy cx cy', 'fx fy cx cy k1 k2 p1 p2 [k3 [k4 k5 k6]]', a 3x3 or 4x4 matrix, a line of COLMAP's "
    "cameras.txt ('1 PINHOLE 640 480 fx fy cx cy'), a .yaml file of Kalibr, ROS, OpenCV or ORB-SLAM, a .json file "
    "of Open3D or Replica, or a COLMAP model or map of one camera"
)


@dataclass(frozen=True, eq=False)
class Calibration:
    """The camera as it took the images, in the pixel convention of groma."""

    #: Name of a camera model.
    model: str
    #: (k,) its parameters.
    params: FloatArray
    #: (width, height) in pixels; None: unknown.
    size: tuple[int, int] | None = None
    #: Depth values per metre, where the file of the camera tells; None: unknown.
    depth_scale: float | None = None

    @property
    def is_pinhole(self) -> bool:
        """Whether lines stay straight."""
        return self.model in ("PINHOLE", "SIMPLE_PINHOLE")

    def pinhole(self) -> FloatArray:
        """(4,) fx, fy, cx, cy."""
        model = cameras.model(self.model)
        focal, center = self.params[list(model.focal_indices)], self.params[list(model.principal_point_indices)]
        return np.array([focal[0], focal[-1], *center], float)


@dataclass(frozen=True, eq=False)
class Rectification:
    """Maps from the images that frames hold to the images in files."""

    #: Fixed-point maps of OpenCV for grey values, and (H, W, 2) the nearest pixels for depth.
    gray_maps: tuple[npt.NDArray[np.int16], npt.NDArray[np.uint16]]
    nearest: npt.NDArray[np.int16]

    def gray(self, image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Grey image with linear interpolation; black where the file has no pixel."""
        return np.asarray(cv2.remap(image, *self.gray_maps, interpolation=cv2.INTER_LINEAR), np.uint8)

    def depth(self, image: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Depth of the nearest pixel; 0 where the file has none."""
        empty = np.zeros(self.nearest.shape[:2], np.uint16)
        return np.asarray(cv2.remap(image, self.nearest, empty, interpolation=cv2.INTER_NEAREST), np.float32)


def rectification(
    calibration: Calibration, target: FloatArray, size: tuple[int, int], camera_from_target: FloatArray | None = None
) -> Rectification:
    """Return the maps from a pinhole camera (4,) of the given size to a calibrated, possibly turned camera."""
    width, height = size
    # Band by band: rays take ten times the memory of the image.
    bands = np.array_split(np.arange(height), max(1, width * height // _BAND))
    pixels = np.concatenate([_pixels_of(calibration, target, width, rows, camera_from_target) for rows in bands])
    fixed, fraction = cv2.convertMaps(pixels[..., 0], pixels[..., 1], cv2.CV_16SC2)
    nearest = np.round(pixels).astype(np.int16)
    return Rectification((np.asarray(fixed, np.int16), np.asarray(fraction, np.uint16)), nearest)


def _pixels_of(
    calibration: Calibration, target: FloatArray, width: int, rows: IntArray, camera_from_target: FloatArray | None
) -> npt.NDArray[np.float32]:
    """Return where the pixels of some rows of the target are in the file, (rows, W, 2), as OpenCV counts."""
    u, v = np.meshgrid(np.arange(width) + 0.5, rows + 0.5)
    directions = np.stack([(u - target[2]) / target[0], (v - target[3]) / target[1], np.ones_like(u)], -1)
    rays: FloatArray = directions.reshape(-1, 3).astype(np.float64)
    if camera_from_target is not None:
        rays = rays @ camera_from_target.T
    pixels = cameras.model(calibration.model).project(calibration.params, rays)
    # derived from the range of 16 bits that OpenCV keeps places in; far outside there is no pixel
    pixels[(rays[:, 2] <= 0) | ~np.isfinite(pixels).all(1)] = -100.0
    # OpenCV counts from the centre of the first pixel; derived from the same range.
    return np.clip(pixels - 0.5, -100.0, 16000.0).reshape(len(rows), width, 2).astype(np.float32)


def calibration_of(camera: CameraLike) -> Calibration:
    """Return the calibration that an option means.

    Raises
    ------
    InputError
        If it is neither numbers, nor a line, nor a readable file that holds one.
    """
    if isinstance(camera, SequenceCamera):
        return Calibration(camera.model, camera.params, (camera.width, camera.height))
    if not isinstance(camera, (str, os.PathLike)):
        return from_opencv(camera)
    text = os.fspath(camera)
    words = text.replace(",", " ").split()
    # Path.is_file fails where a text is too long for a name.
    if isinstance(camera, str) and not os.path.isfile(camera) and (len(words) >= 4 or all(map(is_number, words))):
        return _from_text(camera, "camera")
    return read_calibration(Path(text))


def read_calibration(path: Path) -> Calibration:
    """Read a calibration from a file in one of the accepted forms, or from a model of one camera."""
    if path.is_dir() or path.suffix.lower() == ".npz":
        return _of_model(path)
    with reading(path, "camera file"):
        if path.suffix.lower() in (".yaml", ".yml"):
            return calibration_in(yaml_entries(path), path)
        if path.suffix.lower() == ".json":
            return _from_document(read_document(path), path)
        return _from_text(read_text(path), str(path))


def calibration_in(entries: dict[str, str], path: Path) -> Calibration:
    """Return the camera in the entries of a YAML file of EuRoC, Kalibr, ROS, OpenCV or ORB-SLAM.

    Raises
    ------
    FileFormatError
        If it has none, or one of another model.
    """
    if first := next((name for name in ("Camera1", "Camera") if f"{name}.fx" in entries), None):
        return _of_orb_slam(entries, first, path)
    if "camera_matrix.data" in entries:
        lens = "distortion_coefficients.data"
        intrinsics = yaml_numbers(entries, "camera_matrix.data", path)[[0, 4, 2, 5]]
        width, height = (entries.get(f"image_{side}", "") for side in ("width", "height"))
        size = whole(width, f"{path}, image_width"), whole(height, f"{path}, image_height")
    else:
        intrinsics, resolution = yaml_numbers(entries, "intrinsics", path), yaml_numbers(entries, "resolution", path)
        lens = "distortion_coeffs" if "distortion_coeffs" in entries else "distortion_coefficients"
        size = int(resolution[0]), int(resolution[1])
        if entries.get("camera_model", "pinhole") != "pinhole":
            raise FileFormatError(f"{path}: camera_model must be pinhole; got {entries['camera_model']}.")
    kind = entries.get("distortion_model", "radial-tangential")
    distortion = yaml_numbers(entries, lens, path) if kind != "none" else np.zeros(0)
    if kind in ("radial-tangential", "radtan", "none", "plumb_bob", "rational_polynomial"):
        return from_opencv(np.append(intrinsics, distortion), size)
    if kind in ("equidistant", "fisheye"):
        center = intrinsics + np.array([0.0, 0.0, 0.5, 0.5])
        return _checked("OPENCV_FISHEYE", np.append(center, distortion), size, str(path))
    raise FileFormatError(f"{path}: distortion_model must be radial-tangential or equidistant; got {kind}.")


def _of_orb_slam(entries: dict[str, str], name: str, path: Path) -> Calibration:
    """Return the camera in the settings of ORB-SLAM: a pinhole with or without distortion, or KannalaBrandt8."""
    is_fisheye = entries.get("Camera.type") == "KannalaBrandt8"
    lens = ("k1", "k2", "k3", "k4") if is_fisheye else ("k1", "k2", "p1", "p2", "k3")
    words = [entries[f"{name}.{part}"] for part in ("fx", "fy", "cx", "cy")]
    words += [entries.get(f"{name}.{part}", "0") for part in lens]
    numbers, sides = np.array(finite(words, f"{path}, {name}")), ("Camera.width", "Camera.height")
    wide, high = (whole(entries.get(side, "0"), f"{path}, {side}") for side in sides)
    if "LEFT.K.data" in entries:  # of a pair that ORB-SLAM rectifies: the other camera is that of its rectified images
        matrix, distortion = (yaml_numbers(entries, f"LEFT.{letter}.data", path) for letter in "KD")
        return from_opencv(np.append(matrix[[0, 4, 2, 5]], distortion), (wide, high))
    if is_fisheye:
        numbers[2:4] += 0.5
        found = _checked("OPENCV_FISHEYE", numbers, (wide, high), str(path))
    else:
        found = from_opencv(numbers, (wide, high))
    factor = entries.get("RGBD.DepthMapFactor", entries.get("DepthMapFactor", "0"))
    return replace(found, depth_scale=finite([factor], f"{path}, DepthMapFactor")[0] or None)


def _of_model(path: Path) -> Calibration:
    """Return the camera of a COLMAP model, an archive or a map, if it has one."""
    known = read_scene(path).cameras
    if len(known) != 1:
        raise InputError(f"{path} has {len(known)} cameras; expected one. Pass the numbers of the one of the sequence.")
    return _checked(known.models[0], known.params_of(0), (int(known.width[0]), int(known.height[0])), str(path))


def _from_document(document: Any, path: Path) -> Calibration:
    """Return the camera in a JSON file: Open3D's matrix by columns, or numbers by name as for Replica."""
    content = of_kind(document, dict, path)
    if "intrinsic_matrix" in content:
        matrix = table([member(content, "intrinsic_matrix", list, path)], (9,), path)[0]
        return from_opencv(matrix.reshape(3, 3).T, size(content, ("width", "height"), path))
    content = of_kind(content.get("camera", content), dict, path)
    numbers = [number(content, name, path) for name in ("fx", "fy", "cx", "cy")]
    numbers += [number(content, name, path, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
    sides = ("w", "h") if "w" in content else ("width", "height")
    found = from_opencv(numbers, size(content, sides, path))
    return replace(found, depth_scale=number(content, "scale", path, 0.0) or None)


def find_calibration(folder: Path) -> Calibration | None:
    """Return the calibration that lies in a folder, or None."""
    for name in FILE_NAMES:
        if (folder / name).is_file():
            return read_calibration(folder / name)
    return None


def from_opencv(numbers: npt.ArrayLike, size: tuple[int, int] | None = None) -> Calibration:
    """Return the calibration for a 3x3 matrix, or fx, fy, cx, cy and 0, 4, 5 or 8 coefficients k1, k2, p1 ..."""
    try:
        array = np.asarray(numbers, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"camera cannot be read as a calibration ({error}); {_HELP}.") from error
    calibration = _from_numbers(array[[0, 1, 0, 1], [0, 1, 2, 2]] if array.shape == (3, 3) else array, "camera")
    return Calibration(calibration.model, calibration.params, size)


def _from_text(text: str, source: str) -> Calibration:
    lines = [line.partition("#")[0].replace(",", " ").split() for line in text.splitlines()]
    lines = [words for words in lines if words]
    if not lines:
        raise FileFormatError(f"{source} holds no camera; {_HELP}.")
    wrong = f"{source} cannot be read as a calibration"
    for skip in (0, 1):  # with or without the number of the camera
        words = lines[0][skip:]
        if len(words) > 3 and words[0][:1].isalpha():
            if len(lines) > 1:
                raise FileFormatError(f"{source} holds {len(lines)} cameras; expected one. Remove the others.")
            if len(words) == 1 + cameras.model(words[0]).num_parameters:
                return _checked(words[0], np.array(finite(words[1:], wrong)), None, source)
            size = whole(words[1], wrong, "the width"), whole(words[2], wrong, "the height")
            return _checked(words[0], np.array(finite(words[3:], wrong)), size, source)
    numbers = np.array(finite((word for words in lines for word in words), wrong, _HELP.removeprefix("expected ")))
    if len(lines) in (3, 4) and len(numbers) == len(lines) ** 2:  # ScanNet writes 4x4
        return _from_numbers(numbers.reshape(len(lines), -1)[[0, 1, 0, 1], [0, 1, 2, 2]], source)
    return _from_numbers(numbers, source)


def _from_numbers(numbers: FloatArray, source: str) -> Calibration:
    if numbers.ndim != 1 or len(numbers) not in (4, 8, 9, 12):
        raise InputError(f"{source} holds {numbers.size} numbers; {_HELP}.")
    params = numbers + np.array([0, 0, 0.5, 0.5, *[0] * (len(numbers) - 4)])
    if not params[4:].any():
        return _checked("PINHOLE", params[:4], None, source)
    if not params[8:].any():
        return _checked("OPENCV", params[:8], None, source)
    return _checked("FULL_OPENCV", np.append(params, np.zeros(12 - len(params))), None, source)


def _checked(model: str, params: FloatArray, size: tuple[int, int] | None, source: str) -> Calibration:
    return Calibration(model, checked_params(model, params, source), size)
