# SPDX-License-Identifier: BSD-3-Clause
"""From ray to pixel and back, each with its derivative: one file per family of camera models."""

from groma.cameras.change import in_model
from groma.cameras.contract import CameraModel
from groma.cameras.fisheye import OPENCV_FISHEYE
from groma.cameras.opencv import FULL_OPENCV, OPENCV
from groma.cameras.pinhole import PINHOLE, SIMPLE_PINHOLE
from groma.cameras.radial import BAL, RADIAL, SIMPLE_RADIAL
from groma.cameras.registry import model, models, register_camera
from groma.cameras.rig import Rig

__all__ = [
    "BAL",
    "FULL_OPENCV",
    "OPENCV",
    "OPENCV_FISHEYE",
    "PINHOLE",
    "RADIAL",
    "SIMPLE_PINHOLE",
    "SIMPLE_RADIAL",
    "CameraModel",
    "Rig",
    "in_model",
    "model",
    "models",
    "register_camera",
]
