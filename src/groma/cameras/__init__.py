# SPDX-License-Identifier: BSD-3-Clause
"""Camera models: projection, unprojection and their derivatives, one file per family."""

# Models are numbered in the order of import. A new family goes to the end, so that loops compiled for the others stay.
# isort: off
from groma.cameras.change import in_model
from groma.cameras.contract import CameraModel
from groma.cameras.fisheye import OPENCV_FISHEYE
from groma.cameras.opencv import FULL_OPENCV, OPENCV
from groma.cameras.pinhole import PINHOLE, SIMPLE_PINHOLE
from groma.cameras.radial import BAL, RADIAL, SIMPLE_RADIAL
from groma.cameras.registry import model, models, register_camera
from groma.cameras.rig import Rig
from groma.cameras.simple_fisheye import FISHEYE, RADIAL_FISHEYE, SIMPLE_FISHEYE, SIMPLE_RADIAL_FISHEYE
from groma.cameras.thin_prism import RAD_TAN_THIN_PRISM_FISHEYE, THIN_PRISM_FISHEYE
from groma.cameras.fov import FOV
from groma.cameras.division import DIVISION, SIMPLE_DIVISION
from groma.cameras.eucm import EUCM
from groma.cameras.equirectangular import EQUIRECTANGULAR

# isort: on

__all__ = [
    "BAL",
    "DIVISION",
    "EQUIRECTANGULAR",
    "EUCM",
    "FISHEYE",
    "FOV",
    "FULL_OPENCV",
    "OPENCV",
    "OPENCV_FISHEYE",
    "PINHOLE",
    "RADIAL",
    "RADIAL_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
    "SIMPLE_DIVISION",
    "SIMPLE_FISHEYE",
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "SIMPLE_RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "CameraModel",
    "Rig",
    "in_model",
    "model",
    "models",
    "register_camera",
]
