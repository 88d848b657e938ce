# SPDX-License-Identifier: BSD-3-Clause
"""What a surveyor passes: files of measurements as they were read, and how they are meant."""

from __future__ import annotations

from dataclasses import dataclass

from groma.io.survey import ControlFile, DirectionsFile, DistancesFile, Places, PlanesFile, PosesFile


@dataclass(frozen=True, eq=False)
class Survey:
    """External measurements as read from files, and their standard deviations."""

    #: Positions of cameras: :func:`groma.io.survey.read_positions`, :func:`groma.io.survey.read_exif_positions`.
    positions: Places | None = None
    #: Control points and their marks: :func:`groma.io.survey.read_control`.
    control: ControlFile | None = None
    #: Distances between images, control points, points, lines and planes: :func:`groma.io.survey.read_distances`.
    distances: DistancesFile | None = None
    #: Objects on known planes, and known directions: :func:`groma.io.survey.read_known_planes`,
    #: :func:`groma.io.survey.read_directions`.
    planes: PlanesFile | None = None
    directions: DirectionsFile | None = None
    #: Poses of cameras: :func:`groma.io.survey.read_measured_poses`.
    poses: PosesFile | None = None
    #: Standard deviations of positions, of control points (one, or horizontal and vertical, or three), of distances and
    #: of distances from known planes, where files do not state them; units of the coordinates.
    position_sigma: tuple[float, ...] = ()
    control_sigma: tuple[float, ...] = ()
    distance_sigma: float | None = None
    plane_sigma: float | None = None
    #: The same of directions, degrees, and of poses: positions, and orientations in degrees.
    direction_sigma_deg: float | None = None
    pose_sigma: tuple[float, ...] = ()
    #: Standard deviation of a coordinate of a mark, pixels.
    mark_sigma_px: float = 1.0
    #: Names of control points held out as check points.
    check: tuple[str, ...] = ()
    #: Names and patterns (``old/*``) of images, control points and landmarks to hold fixed.
    hold: tuple[str, ...] = ()
    #: ``enu``, ``utm`` or a system such as ``EPSG:32632``; None: that of the files.
    crs: str | None = None

    def __bool__(self) -> bool:
        files = (self.positions, self.control, self.distances, self.planes, self.directions, self.poses)
        return bool(self.hold) or any(part is not None for part in files)
