# SPDX-License-Identifier: BSD-3-Clause
"""Whether the orientations of measured poses are those of the photographs, or are written in another way.

Places alone bring a scene into the frame of measured poses. The orientations then have to agree with it; where most do
not, the ways in which files differ are tried, and the one that fits is named.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.adjustment.survey.similarity import GATES as SIMILARITY
from groma.errors import InputError
from groma.gates import NORMAL
from groma.geometry import quaternion
from groma.scene import Scene

#: By half a turn about x the axes of a camera of OpenGL become ours.
_HALF_TURN = np.array([[1.0, 0.0, 0.0, 0.0]])
#: From the axes x forward, y left, z up to ours, as a quaternion.
_VEHICLE = np.array([[-0.5, 0.5, -0.5, 0.5]])
#: Images that are tried for the global rotation, if positions do not determine it (cost: time).
_TRIED = 50


def check_orientations(scene: Scene, rotation: FloatArray | None) -> None:
    """Refuse measured poses whose orientations contradict those of the scene.

    Parameters
    ----------
    scene : Scene
        With measured poses.
    rotation : (3, 3) float or None
        From the scene to the frame of the poses, by their positions; None: the one that most of them support.

    Raises
    ------
    InputError
        With what the file seems to hold instead, if anything known fits.
    """
    table = scene.camera_poses
    if len(table) < 3:
        return
    own = quaternion.conjugate(scene.cam_from_world[table.image_idx, :4])
    given = quaternion.conjugate(table.cam_from_world[:, :4])
    apart = _apart(given, own, rotation)
    noise = np.degrees(np.sqrt(np.median(np.einsum("nii->ni", table.covariance)[:, 3:])))
    if apart <= max(SIMILARITY.apart_deg, NORMAL.far * noise):
        return
    back, wxyz = quaternion.conjugate(given), given[:, [1, 2, 3, 0]]
    others = {
        "have the axes of OpenGL (y up, looking along -z)": (quaternion.multiply(given, _HALF_TURN), rotation),
        "begin with qw": (wxyz, rotation),
        "are of the world in the camera (as in COLMAP's images.txt)": (back, None),
        "are of the world in the camera, and begin with qw": (quaternion.conjugate(wxyz), None),
        "have the axes of a vehicle (x forward, y left, z up)": (quaternion.multiply(given, _VEHICLE), rotation),
    }
    angles = {words: _apart(turns, own, whole) for words, (turns, whole) in others.items()}
    best = min(angles, key=lambda words: angles[words])
    hint = (
        f" They fit to {angles[best]:.2g} degrees if they {best}." if angles[best] * SIMILARITY.better < apart else ""
    )
    raise InputError(
        f"The orientations of the measured poses contradict the photographs: most are off by {apart:.0f} degrees or "
        f"more.{hint} Expected are qx qy qz qw from the camera (x right, y down, z forward) to the world."
    )


def _apart(given: FloatArray, own: FloatArray, rotation: FloatArray | None) -> float:
    """Return the median angle, degrees, between orientations (N, 4), the second ones turned as a whole."""
    if rotation is not None:
        wholes = quaternion.from_matrix(rotation[None])
    else:
        chosen = np.unique(np.linspace(0, len(own) - 1, min(len(own), _TRIED)).astype(int))
        wholes = quaternion.multiply(given[chosen], quaternion.conjugate(own[chosen]))
    medians = []
    for whole in wholes:
        off = quaternion.multiply(quaternion.conjugate(given), quaternion.multiply(whole[None], own))
        medians.append(np.median(np.linalg.norm(quaternion.log(off), axis=1)))
    return float(np.degrees(min(medians)))
