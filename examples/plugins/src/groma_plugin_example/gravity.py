# SPDX-License-Identifier: BSD-3-Clause
r"""A factor: an accelerometer says which way is down, :math:`r = R\,(0, 0, -1)^\top - \tilde g_c`.

It ties the world's vertical, the z axis, and nothing else: the world may still move, and turn about that axis.
"""

from groma.factors import Invariance, factor


@factor(
    "gravity", slots=[("pose", "pose")], residual_size=3, data_size=3, invariance=Invariance(rotation=(0.0, 0.0, 1.0))
)
def Gravity(data, pose, out):  # noqa: N802 - becomes a class
    """Down, a unit vector in the camera, is measured."""
    for i in range(3):
        out[i] = -pose[i, 2] - data[i]
