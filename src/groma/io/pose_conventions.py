# SPDX-License-Identifier: BSD-3-Clause
"""How files hold poses: one table, that readers go by, that the documentation shows and that options quote.

A file holds a rotation and a place. The rotation takes the world to the camera or the camera to the world; the place is
the shift that goes with it, or the camera centre (from the camera to the world, both are the same). The camera has our
axes (x right, y down, z forward), those of OpenGL (x right, y up, looking along -z) or those of LLFF (x down, y right,
looking along -z).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from groma._typing import FloatArray
from groma.geometry import quaternion

#: Axes of a camera of OpenGL in ours, as signs: diag(1, -1, -1).
FLIP = np.array([1.0, -1.0, -1.0])


@dataclass(frozen=True)
class PoseConvention:
    """How one kind of file holds the pose of a camera."""

    #: The usual name of the kind of file.
    name: str
    direction: Literal["cam_from_world", "world_from_cam"]
    #: How the rotation is written; quaternions by the order of their numbers.
    rotation: Literal["matrix", "axis and angle", "qx qy qz qw", "qw qx qy qz"]
    place: Literal["shift", "camera centre"]
    axes: Literal["ours", "OpenGL", "LLFF"] = "ours"

    def cam_from_world(self, rotation: FloatArray, place: FloatArray) -> FloatArray:
        """Return poses (N, 7) [qx qy qz qw tx ty tz] of rotations and places (N, 3), as the file has them.

        Rotations are (N, 3, 3), (N, 4) or (N, 3), depending on :attr:`rotation`; they are valid rotations.
        """
        turn = self.quaternions(rotation)
        if self.direction == "world_from_cam":
            turn = quaternion.conjugate(turn)
        is_center = self.place == "camera centre" or self.direction == "world_from_cam"
        shift = -quaternion.rotate(turn, place) if is_center else place
        if self.axes == "OpenGL":
            half_turn = np.array([1.0, 0.0, 0.0, 0.0])  # by pi about x, which is FLIP
            turn, shift = quaternion.multiply(half_turn, turn), FLIP * shift
        elif self.axes == "LLFF":
            half_turn = np.sqrt([0.5, 0.5, 0.0, 0.0])  # by pi about (1, 1, 0): exchanges x and y
            turn, shift = quaternion.multiply(half_turn, turn), shift[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
        return np.hstack([turn, shift])

    def quaternions(self, rotation: FloatArray) -> FloatArray:
        """Return rotations as the file has them as quaternions (N, 4) [qx qy qz qw]."""
        if self.rotation == "matrix":
            return quaternion.from_matrix(rotation)
        if self.rotation == "axis and angle":
            return quaternion.exp(rotation)
        return quaternion.from_wxyz(rotation) if self.rotation == "qw qx qy qz" else np.asarray(rotation, float)


COLMAP = PoseConvention("COLMAP, text and binary", "cam_from_world", "qw qx qy qz", "shift")
TRANSFORMS = PoseConvention(
    "transforms.json: nerfstudio, instant-ngp", "world_from_cam", "matrix", "camera centre", "OpenGL"
)
SPLATS = PoseConvention("cameras.json: Gaussian splats", "world_from_cam", "matrix", "camera centre")
LLFF = PoseConvention("poses_bounds.npy: LLFF, NeRF", "world_from_cam", "matrix", "camera centre", "LLFF")
OPENSFM = PoseConvention("reconstruction.json: OpenSfM, OpenDroneMap", "cam_from_world", "axis and angle", "shift")
OPENMVG = PoseConvention("sfm_data.json: OpenMVG", "cam_from_world", "matrix", "camera centre")
MESHROOM = PoseConvention("cameras.sfm: Meshroom", "world_from_cam", "matrix", "camera centre")
METASHAPE = PoseConvention("cameras.xml: Metashape", "world_from_cam", "matrix", "camera centre")
NVM = PoseConvention("NVM_V3: VisualSFM", "cam_from_world", "qw qx qy qz", "camera centre")
NVM_MATRIX = PoseConvention("NVM_V3_R9T: VisualSFM", "cam_from_world", "matrix", "shift")
BUNDLER = PoseConvention("bundle.out: Bundler", "cam_from_world", "matrix", "shift", "OpenGL")
BAL = PoseConvention("BAL", "cam_from_world", "axis and angle", "shift", "OpenGL")
TUM = PoseConvention("trajectory of TUM: time x y z qx qy qz qw", "world_from_cam", "qx qy qz qw", "camera centre")
NAMED = PoseConvention("lines name x y z qx qy qz qw", "world_from_cam", "qx qy qz qw", "camera centre")
KITTI = PoseConvention("trajectory of KITTI: 12 numbers", "world_from_cam", "matrix", "camera centre")
LOG = PoseConvention("trajectory .log: Redwood, Open3D", "world_from_cam", "matrix", "camera centre")
EUROC = PoseConvention(
    "trajectory of EuRoC: time, x, y, z, qw, qx, qy, qz", "world_from_cam", "qw qx qy qz", "camera centre"
)
G2O = PoseConvention("g2o: VERTEX_SE3:QUAT id x y z qx qy qz qw", "world_from_cam", "qx qy qz qw", "camera centre")

#: All of them, as the documentation lists them.
POSE_CONVENTIONS = (
    COLMAP, TRANSFORMS, SPLATS, LLFF, OPENSFM, OPENMVG, MESHROOM, METASHAPE, NVM, NVM_MATRIX, BUNDLER, BAL, NAMED, TUM,
    KITTI, LOG, EUROC, G2O,
)  # fmt: skip
