# SPDX-License-Identifier: BSD-3-Clause
r"""Where the camera can be after a gap: its motion so far, with its own noise, continued over the time without a pose.

The way of the camera, unrolled into the twists from frame to frame, is a path whose velocity is a random walk, seen
with the jitter of a hand or a vehicle:

.. math:: \dot p = v, \quad \dot v = w, \; w \sim N(0, q), \qquad z_k = p_k + n_k, \; n_k \sim N(0, \sigma^2) .

Jitter makes consecutive accelerations opposite, a changing velocity does not. A Kalman filter for each of some ratios
:math:`q / \sigma^2` tells how likely that ratio is, for translation and rotation apart, and :math:`\sigma` follows from
the innovations. The result is a mixture of Student's distributions with as many degrees of freedom as there were
innovations, so a short track says little. After :math:`n` steps the variance is
:math:`\sigma^2 (P_{pp} + 2 n P_{pv} + n^2 P_{vv} + n^3 q / 3 \sigma^2)`: after a long time anything is possible.

Reference: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and Navigation*, 2001,
sections 6.2.2 (white noise acceleration) and 11.6 (static multiple models).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import special

from groma._typing import FloatArray
from groma.geometry import se3
from groma.tracking.frame.camera import apart
from groma.tracking.gates import MotionGates

#: Ratios of the two noises, for steps of the length of the first: from a velocity that seems constant to one that is
#: anew at each step (cost: of a filter for each).
_RATIOS = 4.0 ** np.arange(-8, 7)


@dataclass(frozen=True)
class Reach:
    """The distribution of a pose."""

    #: (7,) its mean.
    pose: FloatArray
    #: (G, 2) variances of the parts of a mixture, of each coordinate of position and rotation, and their weights.
    variance: FloatArray
    weight: FloatArray
    #: Degrees of freedom.
    freedom: int
    #: A place is denied that the camera is so far off less often.
    level: float

    def denies(self, pose: FloatArray, view: float, depth: float) -> bool:
        """Whether the camera cannot have got to a pose that shows little of what is expected.

        A pose less than half a ``view`` (radians) and half the ``depth`` of the scene away is hardly another place.
        """
        shift, turn = apart(pose, self.pose)
        return (2.0 * shift > depth and self._excludes(0, shift)) or (2.0 * turn > view and self._excludes(1, turn))

    def tells(self, view: float, depth: float) -> bool:
        """Whether a pose that shows little of what is expected would be denied."""
        return self._excludes(0, 0.5 * depth) and self._excludes(1, 0.5 * view)

    def _excludes(self, part: int, distance: float) -> bool:
        """Whether the pose is so far away too seldom."""
        ratio = distance**2 / (3.0 * self.variance[:, part])
        return bool(self.weight[:, part] @ special.fdtrc(3, self.freedom, ratio) < self.level)


class MotionHistory:
    """The motion of a camera so far."""

    def __init__(self, gates: MotionGates) -> None:
        #: (2,) least standard deviations of the jitter of translation and rotation.
        self._floor, self._level = np.array([gates.shift_floor, gates.turn_floor]), gates.level
        self._unit = 0.0
        #: (G, 2, 6) place, from where the camera was measured last, and velocity; (G, 2, 2) their covariance.
        self._state: FloatArray | None = None
        self._covariance = np.zeros((len(_RATIOS), 2, 2))
        self._log_det, self._squares, self._innovations = np.zeros(len(_RATIOS)), np.zeros((len(_RATIOS), 2)), 0

    def interrupt(self) -> None:
        """Forget place and velocity, but not the noise."""
        self._state = None

    def add(self, twist: FloatArray, seconds: float) -> None:
        """Add the motion (6,) from one frame to the next."""
        self._unit = self._unit or seconds
        step, P = seconds / self._unit, self._covariance
        if self._state is None:  # two places have been measured
            self._state = np.zeros((len(_RATIOS), 2, 6))
            self._state[:, 1] = twist / step
            P[:, 0, 0], P[:, 0, 1], P[:, 1, 0] = 1.0, 1.0 / step, 1.0 / step
            P[:, 1, 1] = 2.0 / step**2 + _RATIOS * step / 3.0
            return
        F = np.array([[1.0, step], [0.0, 1.0]])
        noise = np.array([[step**3 / 3.0, step**2 / 2.0], [step**2 / 2.0, step]])
        x, P = F @ self._state, F @ P @ F.T + _RATIOS[:, None, None] * noise
        missed, variance = twist - x[:, 0], P[:, 0, 0] + 1.0
        gain = P[:, :, 0] / variance[:, None]
        x += gain[:, :, None] * missed[:, None]
        x[:, 0] -= twist
        self._state, self._covariance = x, P - gain[:, :, None] * P[:, None, 0]
        self._log_det += np.log(variance)
        self._squares += (missed.reshape(-1, 2, 3) ** 2).sum(axis=2) / variance[:, None]
        self._innovations += 1

    def reach(self, pose: FloatArray, seconds: float) -> Reach | None:
        """Where the camera can be some time after it had a pose (7,); None where no motion is known."""
        if self._state is None or not self._innovations:
            return None
        freedom, step = 3 * self._innovations, seconds / self._unit
        squares = self._squares + freedom * self._floor**2
        log_likelihood = -1.5 * self._log_det[:, None] - 0.5 * freedom * np.log(squares)
        weight = np.exp(log_likelihood - log_likelihood.max(axis=0))
        weight /= weight.sum(axis=0)
        means = self._state[:, 0] + step * self._state[:, 1]
        mean = (np.repeat(weight, 3, axis=1) * means).sum(axis=0)
        at = np.array([1.0, step])
        variance = (at @ self._covariance @ at + _RATIOS * step**3 / 3.0 + 1.0)[:, None] * squares / freedom
        variance += ((means - mean).reshape(-1, 2, 3) ** 2).sum(axis=2) / 3.0
        # A heading that drifts off leads to elsewhere: half of it over the whole way, on the average.
        way = math.hypot(*mean[:3])
        variance[:, 0] += (0.5 * way) ** 2 * float(weight[:, 1] @ variance[:, 1])
        return Reach(se3.compose(se3.exp(mean[None]), pose[None])[0], variance, weight, freedom, self._level)
