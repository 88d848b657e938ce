# SPDX-License-Identifier: BSD-3-Clause
"""Parameters of every camera model, and points in a cone around its axis."""

import numpy as np

from groma import cameras

#: Parameters per model, with an angle from the axis (radians) up to which their distortion is monotone.
CASES = {
    "SIMPLE_PINHOLE": ([500.0, 320.0, 240.0], 1.2),
    "PINHOLE": ([500.0, 510.0, 320.0, 240.0], 1.2),
    "SIMPLE_RADIAL": ([500.0, 320.0, 240.0, -0.15], 0.7),
    "RADIAL": ([500.0, 320.0, 240.0, -0.3, 0.12], 1.0),
    "BAL": ([500.0, -0.3, 0.12], 1.0),
    "OPENCV": ([500.0, 510.0, 320.0, 240.0, -0.28, 0.09, 0.001, -0.002], 0.75),
    "FULL_OPENCV": ([500.0, 510.0, 320.0, 240.0, 0.3, -0.1, 0.001, -0.002, 0.02, 0.5, 0.1, 0.01], 0.8),
    "OPENCV_FISHEYE": ([300.0, 310.0, 320.0, 240.0, 0.05, -0.01, 0.002, -0.0003], 2.2),
    "SIMPLE_FISHEYE": ([300.0, 320.0, 240.0], 2.5),
    "FISHEYE": ([300.0, 310.0, 320.0, 240.0], 2.5),
    "SIMPLE_RADIAL_FISHEYE": ([300.0, 320.0, 240.0, -0.02], 2.2),
    "RADIAL_FISHEYE": ([300.0, 320.0, 240.0, 0.05, -0.01], 1.6),
    "THIN_PRISM_FISHEYE": (
        [300.0, 310.0, 320.0, 240.0, 0.05, -0.01, 0.001, -0.002, 0.002, -0.0003, 0.003, -0.001],
        1.9,
    ),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        [300.0, 310.0, 320.0, 240.0, 0.05, -0.01, 0.002, -3e-4, 1e-4, -1e-5, 0.001, -0.002, 0.003, -0.001, 0.002, 5e-4],
        1.2,
    ),
    "FOV": ([500.0, 510.0, 320.0, 240.0, 0.9], 1.2),
    "SIMPLE_DIVISION": ([500.0, 320.0, 240.0, -0.3], 2.2),
    "DIVISION": ([500.0, 510.0, 320.0, 240.0, 0.1], 0.95),
    "EUCM": ([500.0, 510.0, 320.0, 240.0, 0.6, 1.1], 1.9),
    "EQUIRECTANGULAR": ([640.0, 480.0], 1.4),
}


PERSPECTIVE = [name for name in CASES if not cameras.model(name).sees_behind]


#: Models that can be shown in a plane, around their axis.
PLANAR = [name for name in CASES if name != "EQUIRECTANGULAR"]


#: Polynomial fisheyes: equidistant at the centre of the image.
FISHEYES = [name for name in CASES if name.endswith("FISHEYE")]


def params_of(name):
    return np.array(CASES[name][0])


def points_in_cone(rng, half_angle, count=40):
    theta = half_angle * np.sqrt(rng.uniform(size=count))
    around, depth = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.5, 5.0, count)
    unit = np.stack([np.sin(theta) * np.cos(around), np.sin(theta) * np.sin(around), np.cos(theta)], axis=1)
    return depth[:, None] * unit
