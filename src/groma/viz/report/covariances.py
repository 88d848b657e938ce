# SPDX-License-Identifier: BSD-3-Clause
"""Covariances of landmarks and camera centres, for measurements on the page (``groma adjust --covariance``)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.bounded.arrays import Header, opened_arrays
from groma.bounded.names import existing
from groma.errors import FileFormatError, InputError
from groma.io.reading import reading
from groma.scene import Scene


@dataclass(frozen=True)
class LandmarkCovariances:
    """Covariances in the order of a scene; NaN where they are not known."""

    #: Gauge: ``inner`` or ``held``.
    gauge: str
    #: (P, 3, 3) of points, (L, 6, 6) of Plücker coordinates (m, d), (K, 4, 4) of planes (n, w), (N, 3, 3) of centres.
    points: FloatArray
    lines: FloatArray
    planes: FloatArray
    centers: FloatArray

    def moved(self, offset: FloatArray) -> LandmarkCovariances:
        r"""Return the covariances of coordinates less an offset :math:`o`.

        .. math:: m' = m - o \times d, \qquad w' = w + n^\top o
        """
        x, y, z = offset
        line, plane = np.eye(6), np.eye(4)
        line[:3, 3:] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        plane[3, :3] = offset
        return LandmarkCovariances(
            self.gauge, self.points, line @ self.lines @ line.T, plane @ self.planes @ plane.T, self.centers
        )


def read_covariances(path: str | os.PathLike[str], scene: Scene) -> LandmarkCovariances:
    """Read the arrays that ``groma adjust --covariance FILE.npz`` wrote, in the order of a scene.

    Raises
    ------
    InputError
        If the file names none of the landmarks and images of the scene.
    FileFormatError
        If it is damaged or something else.
    """
    place = existing(path)
    if place.suffix.lower() != ".npz":
        raise InputError(
            f"Expected covariances as arrays (.npz); got {path}. Write them with groma adjust --covariance."
        )
    with reading(place, "file of covariances"), opened_arrays(place) as members:

        def array(name: str, *shape: int, kind: str = "f") -> np.ndarray:
            def check(header: Header) -> None:
                if header.dtype.kind not in kind or header.shape[1:] != shape or not header.shape:
                    raise FileFormatError(f"Array {name} must have shape (n, {shape}); got {header.shape}.")

            if name not in members:
                raise FileFormatError(f"Array {name} is missing. Expected what groma adjust --covariance writes.")
            return members.read(name, check)

        def of(kind: str, size: int, wanted: IntArray) -> FloatArray:
            return _matched(array(kind, size, size), array(f"{kind[:-1]}_ids", kind="iu"), wanted)

        names, frames = array("image_names", kind="U"), array("image_frames", kind="iu")
        centers = array("centers", 3, 3)
        row = {str(name): frame for name, frame in zip(names, frames.tolist(), strict=True)}
        found = LandmarkCovariances(
            "",
            of("points", 3, scene.points.ids),
            of("lines", 6, scene.lines.ids),
            of("planes", 4, scene.planes.ids),
            centers_of_images(scene, centers, np.array([row.get(name, -1) for name in scene.images.names], np.int64)),
        )
    known = [np.isfinite(one).any() for one in (found.points, found.lines, found.planes, found.centers)]
    if not any(known):
        raise InputError(f"{Path(path)} knows none of the landmarks and images of the scene. Pass that of this scene.")
    return found


def _matched(covariances: FloatArray, ids: IntArray, wanted: IntArray) -> FloatArray:
    """Return the covariances of the given identifiers; NaN for those not in the file."""
    if len(ids) != len(covariances):
        raise FileFormatError(f"Expected as many identifiers as covariances; got {len(ids)} and {len(covariances)}.")
    found = np.full((len(wanted), *covariances.shape[1:]), np.nan)
    if not len(ids):
        return found
    order = np.argsort(ids)
    place = order[np.minimum(np.searchsorted(ids[order], wanted), len(ids) - 1)]
    known = ids[place] == wanted
    found[known] = covariances[place[known]]
    return found


def centers_of_images(scene: Scene, centers: FloatArray, frames: IntArray) -> FloatArray:
    """Return the covariances of camera centres from those of frames; NaN for rigs, of which these are no cameras."""
    found = np.full((scene.num_images, 3, 3), np.nan)
    known = (frames >= 0) & (frames < len(centers))
    if scene.has_trivial_rigs:
        found[known] = centers[frames[known]]
    return found
