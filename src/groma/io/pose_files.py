# SPDX-License-Identifier: BSD-3-Clause
"""Poses of photographs from any file that holds some: which pose belongs to which photograph.

===============================================  ===================================================================
a model: COLMAP, ``transforms.json``,            images are found by name: the whole path, else its end, else
OpenSfM, Meshroom, Metashape, splats, ...        without ending, else in another folder, if just one photograph fits
a trajectory of TUM or EuRoC                     where the names of the photographs are times: the nearest within 20
                                                 ms; else in order, if there are as many of both
a trajectory of KITTI                            in order, if there are as many; else the numbers in the names are
                                                 lines, from 0
a pose graph of g2o                              the numbers in the names are ids; else in order, if there are as many
lines ``name x y z qx qy qz qw``                 by name, as of a model
``poses_bounds.npy`` of LLFF and NeRF            in order of the names, character by character, if there are as many
===============================================  ===================================================================

Anything else is refused. Conclusions that are not in the file are returned as sentences.
"""

from __future__ import annotations

import os
import posixpath
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from groma._counted import counted, natural_key
from groma._image_names import SEVERAL, rows_by_name, tell_partly
from groma._typing import FloatArray, IntArray
from groma.bounded.documents import begins_with
from groma.bounded.names import existing
from groma.bounded.text import read_lines
from groma.errors import FileFormatError, InputError
from groma.geometry import se3
from groma.io.g2o import looks_like_g2o, read_g2o
from groma.io.interchange.calibration import camera_table, shared
from groma.io.interchange.llff import MAGIC, read_llff
from groma.io.pose_conventions import NAMED
from groma.io.reading import reading
from groma.io.registry import HEAD_BYTES, formats, read_scene
from groma.io.survey.rows import is_measured_poses, read_measured_poses
from groma.io.trajectories import read_trajectory
from groma.scene import Cameras

#: Seconds by which a time may miss that of a photograph (convention: as in the TUM benchmark).
NEAR_SECONDS = 0.02
#: Digits from which a whole number is nanoseconds (derived from Unix time: seconds have ten
#: digits).
_NANOSECOND_DIGITS = 16


@dataclass(frozen=True, eq=False)
class PosesOfPhotographs:
    """Which photographs have a pose, and which."""

    #: Names of the photographs, in their folder.
    names: tuple[str, ...]
    #: (N, 7) their poses.
    cam_from_world: FloatArray
    #: Calibrations, and (N,) which each photograph has; None where the file holds none.
    cameras: Cameras | None
    camera_idx: IntArray
    #: What was concluded.
    sentences: tuple[str, ...]


def read_poses(path: str | os.PathLike[str], photographs: Sequence[str]) -> PosesOfPhotographs:
    """Read poses of photographs; see the module for the files and for what belongs to what.

    Parameters
    ----------
    path : path
        A file or the folder of a model. Points in it are not used.
    photographs : sequence of str
        Names in the folder of photographs.

    Raises
    ------
    InputError
        If no photograph has a pose, or poses cannot be assigned to photographs.
    FileFormatError
        If the file is damaged or of an unknown kind.
    """
    place = existing(path)
    head = b""
    if place.is_file():
        with reading(place, "file"), place.open("rb") as file:
            head = file.read(HEAD_BYTES)
    if place.is_dir() or any(one.recognise is not None and one.recognise(place, head) for one in formats()):
        return _of_model(place, photographs)
    if head.startswith(MAGIC):
        return _of_llff(place, photographs)
    if begins_with(head, b"{") or begins_with(head, b"["):
        raise FileFormatError(
            f"{place} is a JSON file of a kind that is not read for poses. Read are transforms.json, "
            "reconstruction.json, sfm_data.json, cameras.sfm and the cameras.json of splats; else lines of "
            "name x y z qx qy qz qw."
        )
    first = b""
    with reading(place, "file of poses"):
        first = next((line for _, line in read_lines(place)), "").encode()
    if is_measured_poses(first.decode(errors="replace")):
        return _of_measured(place, photographs)
    return _of_graph(place, photographs) if looks_like_g2o(first) else _of_trajectory(place, photographs)


# ------------------------------------------------------------------------------------------------------------- kinds
def _of_model(place: Path, photographs: Sequence[str]) -> PosesOfPhotographs:
    scene = read_scene(place)
    if not scene.num_images:
        raise InputError(f"{place} holds no image with a pose. Pass a file of poses.")
    found, sentences = _by_name(place, scene.images.names, photographs)
    rows = [row for row, name in enumerate(found) if name is not None]
    missing = len(found) - len(rows)
    if missing:
        example = next(name for name, match in zip(scene.images.names, found, strict=True) if match is None)
        sentences += (
            f"{missing} of {counted(len(found), 'poses')} in {place} have no photograph, for example {example!r}.",
        )
    return PosesOfPhotographs(
        tuple(str(found[row]) for row in rows),
        scene.cam_from_world[rows],
        scene.cameras,
        scene.images.camera_idx[rows],
        sentences,
    )


def _of_trajectory(place: Path, photographs: Sequence[str]) -> PosesOfPhotographs:
    trajectory = read_trajectory(place)
    poses, names = trajectory.cam_from_world, sorted(photographs, key=natural_key)
    count = len(poses)
    times, numbers = _times(names), _numbers(names)
    has_times = bool((np.diff(trajectory.timestamps, prepend=-1.0) != 1.0).any())
    if has_times and times is not None:
        order = np.argsort(trajectory.timestamps, kind="stable")
        of_pose = trajectory.timestamps[order]
        at = np.clip(np.searchsorted(of_pose, times), 1, max(1, count - 1))
        at = np.where(times - of_pose[at - 1] < of_pose[np.minimum(at, count - 1)] - times, at - 1, at)
        at = np.minimum(at, count - 1)
        apart = np.abs(of_pose[at] - times)
        near = apart <= NEAR_SECONDS
        if near.any():
            said = (
                ()
                if apart[near].max() < 1e-4
                else (f"Poses are those nearest in time to the names, {1e3 * apart[near].max():.2g} ms away at most.",)
            )
            return _without_calibration(
                [name for name, use in zip(names, near, strict=True) if use], poses[order[at[near]]], said
            )
    if count == len(names):
        return _in_order(place, names, poses)
    if not has_times and numbers is not None and numbers.max() < count and numbers.min() == 0:
        said = (f"The numbers in the names were taken as lines of {place}, from 0.",)
        return _without_calibration(names, poses[numbers], said)
    raise _unclear(place, count, names, "times" if has_times else "lines, counted from 0")


def _of_measured(place: Path, photographs: Sequence[str]) -> PosesOfPhotographs:
    given = read_measured_poses(place)
    found, said = _by_name(place, given.names, photographs)
    rows = [row for row, name in enumerate(found) if name is not None]
    poses = NAMED.cam_from_world(given.world_from_cam[rows, 3:], given.world_from_cam[rows, :3])
    return _without_calibration([str(found[row]) for row in rows], poses, said)


def _of_llff(place: Path, photographs: Sequence[str]) -> PosesOfPhotographs:
    poses, of_photograph = read_llff(place)
    names = sorted(photographs)
    if len(poses) != len(names):
        raise InputError(
            f"{place} holds {counted(len(poses), 'poses')} without names, and there are "
            f"{counted(len(names), 'photographs')}: it cannot be told which is whose. Keep only the photographs with a "
            "pose, or pass a file with names (transforms.json, or the COLMAP model that it was made from)."
        )
    calibrations, camera_idx = shared(of_photograph)
    return replace(
        _in_order(place, names, poses),
        cameras=camera_table(calibrations, place),
        camera_idx=np.array(camera_idx, np.int64),
    )


def _of_graph(place: Path, photographs: Sequence[str]) -> PosesOfPhotographs:
    graph = read_g2o(place)
    if graph.planar:
        raise InputError(f"{place} holds poses of the plane (SE2); photographs need poses of space (SE3).")
    poses, names = se3.inverse(graph.poses.world_from_body), sorted(photographs, key=natural_key)
    numbers, row_of = _numbers(names), {int(number): row for row, number in enumerate(graph.poses.ids)}
    if numbers is not None and all(int(number) in row_of for number in numbers):
        said = (f"The numbers in the names were taken as ids of {place}.",)
        return _without_calibration(names, poses[[row_of[int(number)] for number in numbers]], said)
    if len(poses) == len(names):
        return _in_order(place, names, poses[np.argsort(graph.poses.ids)])
    raise _unclear(place, len(poses), names, "ids")


def _in_order(place: Path, names: Sequence[str], poses: FloatArray) -> PosesOfPhotographs:
    said = (f"The {len(names)} poses of {place} were given to the photographs in the order of their names.",)
    return _without_calibration(names, poses, said)


def _without_calibration(names: Sequence[str], poses: FloatArray, said: tuple[str, ...]) -> PosesOfPhotographs:
    return PosesOfPhotographs(tuple(names), poses, None, np.zeros(len(names), np.int64), said)


def _unclear(place: Path, count: int, names: Sequence[str], what: str) -> InputError:
    return InputError(
        f"It cannot be told which of the {counted(count, 'poses')} in {place} is whose: there are "
        f"{counted(len(names), 'photographs')}, and their names, for example {names[0]!r}, are not {what} of the file. "
        "Name the photographs so, keep only those with a pose, or pass a file with names (transforms.json)."
    )


# ------------------------------------------------------------------------------------------------------------- names
def _by_name(place: Path, names: Sequence[str], photographs: Sequence[str]) -> tuple[list[str | None], tuple[str, ...]]:
    """Return the photograph of each name, None where there is none, and sentences about the matching."""
    rows = rows_by_name(names, photographs)
    if (unclear := np.flatnonzero(rows == SEVERAL)).size:
        raise InputError(
            f"It cannot be told which pose in {place} is whose: more than one photograph, or more than one name of the "
            f"file, fits {names[unclear[0]]!r}. Use whole paths in the file."
        )
    found = [photographs[int(row)] if row >= 0 else None for row in rows]
    again = Counter(name for name in found if name is not None).most_common(1)
    if not again:
        raise InputError(
            f"None of the {counted(len(names), 'names')} in {place} is that of a photograph: there it is for example "
            f"{names[0]!r}, here {photographs[0]!r}. Pass the folder that the file belongs to, or rename."
        )
    if again[0][1] > 1:
        raise InputError(f"{place} has {again[0][1]} poses for the photograph {again[0][0]!r}. Remove the wrong ones.")
    return found, tuple(tell_partly(rows, names, photographs, str(place)))


def _stems(names: Sequence[str]) -> list[str]:
    return [posixpath.splitext(posixpath.basename(name))[0] for name in names]


def _times(names: Sequence[str]) -> FloatArray | None:
    """Return the seconds that names are: with a decimal point, or whole nanoseconds; None where they are none."""
    stems = _stems(names)
    if all(re.fullmatch(r"\d+\.\d+", stem) for stem in stems):
        return np.array([float(stem) for stem in stems])
    if all(re.fullmatch(r"\d+", stem) and len(stem) >= _NANOSECOND_DIGITS for stem in stems):
        return np.array([int(stem) * 1e-9 for stem in stems])
    return None


def _numbers(names: Sequence[str]) -> IntArray | None:
    """Return the numbers at the ends of names that are the same before them; None where there are none."""
    found = [re.fullmatch(r"(.*?)(\d{1,15})", stem) for stem in _stems(names)]
    parts = [(match[1], int(match[2])) for match in found if match is not None]
    if len(parts) < len(names) or len({before for before, _ in parts}) != 1:
        return None
    numbers = np.array([number for _, number in parts], np.int64)
    return numbers if len(np.unique(numbers)) == len(numbers) else None
