# SPDX-License-Identifier: BSD-3-Clause
"""From ray to pixel and back, each with its derivative: one file per family of camera models."""

from groma.cameras._camera import CameraModel, model, models, register_camera
from groma.cameras.pinhole import PINHOLE, SIMPLE_PINHOLE

__all__ = [
    "PINHOLE",
    "SIMPLE_PINHOLE",
    "CameraModel",
    "model",
    "models",
    "register_camera",
]
