# SPDX-License-Identifier: BSD-3-Clause
"""What is kept of a query: its pose, and what of the map was found in it. A file each, so that a run can go on."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.bounded.arrays import form, opened_arrays
from groma.geometry import quaternion
from groma.io import atomic_output
from groma.localization.localizer import LocalizedImage
from groma.localization.map_index import UNREADABLE
from groma.localization.pose.camera import QueryCamera

#: What each array of a file is.
_FORMS = {
    **dict.fromkeys(("name", "status", "sentence", "model"), form("U")),
    **dict.fromkeys(("pose", "params"), form("f", None)),
    **dict.fromkeys(("point", "line"), form("iu", None)),
    "covariance": form("f", None, None), "size": form("iu", 2), "pixel": form("f", None, 2),
    "segment": form("f", None, 4), "seconds": form("f"), "shared_error": form("f"),
    "feature_seconds": form("f"), "probability": form("f"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class StoredImage:
    """A query and its place; empty arrays where it has none."""

    name: str
    #: ``localized``, ``uncertain`` or ``failed``, and why.
    status: str
    sentence: str
    #: (7,) cam_from_world and (6, 6) covariance of its left twist, or (0,) and (0, 0).
    pose: FloatArray
    covariance: FloatArray
    #: Calibration; an empty model where the image could not be read.
    model: str
    params: FloatArray
    size: IntArray
    #: (n,) rows of the index and (n, 2) pixels of the points that agree; (m,) rows of the map and (m, 4) ends of the
    #: segments that agree.
    point: IntArray
    pixel: FloatArray
    line: IntArray
    segment: FloatArray
    #: Seconds beside finding features.
    seconds: float
    #: What parts of the map are off by, as seen from the camera, radians: part of the covariance.
    shared_error: float = 0.0
    #: Seconds of finding features.
    feature_seconds: float = 0.0
    #: That the place is right.
    probability: float = 0.0

    @property
    def is_whole(self) -> bool:
        """Whether the parts fit each other; those of a damaged file need not."""
        has_pose = len(self.pose) == 7 and self.covariance.shape == (6, 6) and bool(self.model)
        numbers = self.pose, self.params, self.pixel, self.segment
        return (
            (has_pose or not len(self.pose))
            and (len(self.point), len(self.line)) == (len(self.pixel), len(self.segment))
            and all(np.isfinite(part).all() for part in numbers)
        )

    @property
    def camera(self) -> QueryCamera:
        """The calibration."""
        return QueryCamera(self.model, self.params, int(self.size[0]), int(self.size[1]))

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``localized.json``."""
        entry: dict[str, Any] = {"status": self.status, "probability": self.probability}
        entry |= dict.fromkeys(("qvec", "tvec", "center", "center_sigma", "rotation_sigma_deg"))
        if len(self.pose):
            rotation = quaternion.to_matrix(self.pose[None, :4])[0]
            entry["qvec"], entry["tvec"] = self.pose[[3, 0, 1, 2]].tolist(), self.pose[4:].tolist()
            entry["center"] = (-rotation.T @ self.pose[4:]).tolist()
            if np.isfinite(self.covariance).all():
                shift = rotation.T @ self.covariance[:3, :3] @ rotation
                entry["center_sigma"] = np.sqrt(np.diag(shift)).tolist()
                entry["rotation_sigma_deg"] = float(np.rad2deg(np.sqrt(np.trace(self.covariance[3:, 3:]))))
        entry |= {"num_point_inliers": len(self.point), "num_line_inliers": len(self.line)}
        entry["shared_error_deg"] = float(np.rad2deg(self.shared_error))
        return entry | {"feature_seconds": self.feature_seconds, "seconds": self.seconds, "sentence": self.sentence}

    def write(self, path: Path, digest: str) -> None:
        """Write it whole or not at all."""
        with atomic_output(path, force=True) as draft, draft.open("wb") as file:
            arrays = {item.name: np.array(getattr(self, item.name)) for item in fields(self)}
            np.savez(file, **{"digest": np.array(digest), **arrays})  # type: ignore[arg-type]


def stored(name: str, found: LocalizedImage) -> StoredImage:
    """Return what is kept of a localised photograph."""
    pose, camera = found.pose, found.pose.camera
    lost = pose.cam_from_world is None or pose.covariance is None
    points, lines = np.flatnonzero(pose.point_inliers), np.flatnonzero(pose.line_inliers)
    if lost:
        points, lines = points[:0], lines[:0]
    return StoredImage(
        name,
        pose.status,
        pose.sentence,
        np.zeros(0) if pose.cam_from_world is None else pose.cam_from_world,
        np.zeros((0, 0)) if pose.covariance is None else pose.covariance,
        camera.model,
        camera.params,
        np.array([camera.width, camera.height]),
        found.point[points],
        pose.matches.points2d[points],
        found.line[lines],
        pose.matches.segments2d[lines].reshape(-1, 4),
        found.seconds,
        pose.matches.shared_error,
        found.feature_seconds,
        pose.probability,
    )


def unreadable(name: str, reason: str) -> StoredImage:
    """Return what is told of a file that cannot be localised at all."""
    none = np.zeros(0, np.int64)
    return StoredImage(
        name, "failed", reason, np.zeros(0), np.zeros((0, 0)), "", np.zeros(0), np.zeros(2, np.int64),
        none, np.zeros((0, 2)), none, np.zeros((0, 4)), 0.0,
    )  # fmt: skip


def read_stored(path: Path, digest: str) -> StoredImage | None:
    """Read a query that was finished; None where there is none, or another map or photograph."""
    try:
        with opened_arrays(path) as members:
            if str(members.read("digest")) != digest:
                return None
            values: dict[str, Any] = {name: members.read(name, check) for name, check in _FORMS.items()}
            for name in ("name", "status", "sentence", "model"):
                values[name] = str(values[name])
            for name in ("seconds", "shared_error", "feature_seconds", "probability"):
                values[name] = float(values[name])
            found = StoredImage(**values)
            if found.model:
                found.camera  # noqa: B018 - refuses a calibration that is none
    except UNREADABLE:
        return None
    return found if found.is_whole else None
