# SPDX-License-Identifier: BSD-3-Clause
"""Image sequences on disk: one layout per module, recognised by :func:`open_sequence`."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from groma._counted import first_of
from groma.bounded.names import VIDEOS, existing
from groma.errors import InputError
from groma.io.colmap.masks import Masks
from groma.io.sequences._calibration import Calibration, CameraLike, calibration_of
from groma.io.sequences._reader import FileSequence, Selection
from groma.io.sequences.euroc import euroc_root, open_euroc
from groma.io.sequences.frame import Frame, Kind, Sequence, SequenceCamera
from groma.io.sequences.images import image_files, open_images, open_video
from groma.io.sequences.kitti import is_kitti, open_kitti
from groma.io.sequences.layouts import SequenceLayout, Wishes, layouts, register_layout
from groma.io.sequences.left_right import is_left_right, open_left_right
from groma.io.sequences.seven_scenes import open_seven_scenes, seven_scenes_root
from groma.io.sequences.tum_rgbd import is_tum_rgbd, open_tum_rgbd
from groma.io.sequences.two_folders import is_two_folders, open_two_folders


def open_sequence(
    path: str | os.PathLike[str],
    *,
    camera: CameraLike | None = None,
    depth_scale: float | None = None,
    stride: int = 1,
    max_frames: int | None = None,
    kind: Kind | None = None,
    masks: str | os.PathLike[str] | None = None,
) -> Sequence:
    """Open an image sequence; its layout is recognised from the folder. Frames are read on demand.

    Parameters
    ----------
    path : path
        A folder of TUM RGB-D (``rgb.txt``), 7-Scenes (``frame-000000.color.png``), KITTI odometry (``image_0``) or
        EuRoC (``mav0``), stereo pairs in ``left`` and ``right``, a folder with ``rgb`` or ``color`` and ``depth``, a
        folder of images, or a video file.
    camera : SequenceCamera, numbers, str or path, optional
        The camera, overriding that of the folder: ``fx fy cx cy [k1 k2 p1 p2 [k3 [k4 k5 k6]]]`` as OpenCV
        counts (the first pixel's centre is (0, 0)), a line of COLMAP's ``cameras.txt`` (the first pixel's centre is
        (0.5, 0.5)), or a file that holds one of these, a 3x3 matrix, YAML of Kalibr, ROS, OpenCV or ORB-SLAM, or JSON
        of Open3D or Replica. Distorted images are undistorted.
    depth_scale : float, optional
        Depth values per metre, overriding those of the camera's file, and these those of the layout (TUM 5000,
        7-Scenes 1000).
    stride : int
        Give every n-th frame.
    max_frames : int, optional
        Maximum number of frames.
    kind : str, optional
        ``mono`` leaves depth or right images out; other kinds must be what the files hold.
    masks : path, optional
        Folder of masks of the (left) images by their names, or one image for all: what is black is not used.

    Returns
    -------
    Sequence
        Iterate over it for frames; the camera is a pinhole, in the pixel convention of groma.

    Raises
    ------
    InputError
        If there is nothing at ``path``, the layout is not known, or no camera is known.
    FileFormatError
        If a list, a calibration or a reference in the folder is damaged. Damaged images are skipped with a warning.
    """
    place = existing(path)
    selection = Selection(stride, max_frames, kind)
    calibration = None if camera is None else calibration_of(camera)
    if depth_scale is None and calibration is not None:
        depth_scale = calibration.depth_scale
    if depth_scale is not None and not 0 < depth_scale < float("inf"):
        raise InputError(f"depth_scale must be positive (depth in files per metre); got {depth_scale}.")
    wishes = Wishes(calibration, depth_scale, selection)
    for layout in layouts():
        if (root := layout.find(place)) is not None:
            sequence = layout.open(root, wishes)
            return sequence if masks is None else _masked(sequence, existing(masks))
    if not place.is_dir():
        raise InputError(f"{place} is neither a folder nor a video ({', '.join(VIDEOS)}). Pass the sequence's folder.")
    readable = (one for one in sorted(place.iterdir()) if os.access(one, os.R_OK))
    inner = [one.name for one in readable if any(layout.find(one) for layout in layouts())]
    hint = f"It contains sequences: {first_of(inner, 3)}." if inner else "Check the path."
    signs = ", ".join(layout.sign for layout in layouts() if layout.sign)
    raise InputError(f"{place} is no sequence that groma knows: expected {signs}, or images. {hint}")


def _masked(sequence: Sequence, masks: Path) -> Sequence:
    if not isinstance(sequence, FileSequence):
        raise InputError("Masks are for sequences of image files, and this is another one. Take pictures out of it.")
    return replace(sequence, masks=Masks.of(masks, [entry.gray.name for entry in sequence.entries]))


def _here(has_layout: Callable[[Path], object]) -> Callable[[Path], Path | None]:
    return lambda place: place if has_layout(place) else None


def _is_video(place: Path) -> bool:
    return place.is_file() and place.suffix.lower() in VIDEOS


for _layout in (
    SequenceLayout("video", "", _here(_is_video), open_video),
    SequenceLayout("tum_rgbd", "rgb.txt or associations.txt (TUM)", _here(is_tum_rgbd), open_tum_rgbd),
    SequenceLayout("euroc", "mav0/cam0 (EuRoC)", euroc_root, open_euroc),
    SequenceLayout("kitti", "image_0 (KITTI)", _here(is_kitti), open_kitti),
    SequenceLayout("left_right", "left and right (stereo pairs)", _here(is_left_right), open_left_right),
    SequenceLayout("seven_scenes", "frame-000000.color.png (7-Scenes)", seven_scenes_root, open_seven_scenes),
    SequenceLayout("two_folders", "rgb or color with depth", _here(is_two_folders), open_two_folders),
    SequenceLayout("images", "", _here(image_files), open_images),
):
    register_layout(_layout)

__all__ = [
    "Calibration",
    "CameraLike",
    "Frame",
    "Kind",
    "Selection",
    "Sequence",
    "SequenceCamera",
    "SequenceLayout",
    "Wishes",
    "open_sequence",
    "register_layout",
]
