# SPDX-License-Identifier: BSD-3-Clause
r"""Where the camera will be: constant velocity, with a noise learnt from how well that held so far.

The velocity is a twist per second, :math:`v = \mathrm{Log}(T_k T_{k-1}^{-1}) / \Delta t`, so missing
frames are bridged. Errors of positions count in shares of the usual depth, so that the unit of length does not matter.
"""

from __future__ import annotations

import numpy as np

from groma._typing import FloatArray
from groma.geometry import se3
from groma.tracking.gates import DEFAULT, MotionGates


class MotionModel:
    """Constant velocity and the noise of its predictions."""

    def __init__(self, gates: MotionGates = DEFAULT.motion) -> None:
        self._gates = gates
        self._floor = np.repeat([gates.shift_floor, gates.turn_floor], 3)
        self._velocity = np.zeros(6)
        self._last_time: float | None = None
        self._step = 0.0
        self._error = np.full(6, gates.start)
        #: What errors count in: depth, radians.
        self._unit = np.ones(6)
        self._predicted: FloatArray | None = None
        #: Frames since the last pose: as long as no step is known, each counts for one.
        self._asked = 0
        #: Whether so many frames had no pose before the last prediction, or were missing, that it is not extrapolated.
        self.after_gap = False

    def predict(self, pose: FloatArray, timestamp: float, depth: float = 1.0) -> tuple[FloatArray, FloatArray]:
        """Return the pose expected at a time, and the standard deviations (6,) of that expectation.

        ``depth`` is that of what the camera sees, scene units.
        """
        gap = timestamp - self._last_time if self._last_time is not None else 0.0
        self._asked += 1
        steps = gap / self._step if self._step > 0 else float(self._asked)
        self.after_gap = steps > self._gates.max_steps
        gap = min(gap, self._gates.max_steps * self._step) if self._step > 0 else 0.0
        twist = self._velocity * gap
        predicted = se3.compose(se3.exp(twist[None]), pose[None])[0]
        self._predicted, self._unit = predicted, np.repeat([depth, 1.0], 3)
        sigma = np.maximum(self._floor, self._gates.safety * self._error) * self._unit * max(1.0, steps)
        sigma += self._gates.velocity_share * np.abs(twist)
        return predicted, sigma

    def update(self, before: FloatArray | None, pose: FloatArray, timestamp: float) -> None:
        """Learn from a pose that was found; ``before`` is the one of the frame before, None if it had none."""
        if before is not None and self._last_time is not None and timestamp > self._last_time:
            self._step = timestamp - self._last_time
            twist = se3.log(se3.compose(pose[None], se3.inverse(before[None])))[0]
            if self._predicted is not None:
                miss = np.abs(se3.log(se3.compose(pose[None], se3.inverse(self._predicted[None])))[0])
                grouped = np.repeat([np.linalg.norm(miss[:3]), np.linalg.norm(miss[3:])], 3) / self._unit
                self._error = np.maximum(
                    (1.0 - self._gates.learnt) * self._error + self._gates.learnt * grouped, self._gates.last * grouped
                )
            self._velocity = twist / self._step
        else:
            self._velocity = np.zeros(6)
            self._error = np.full(6, self._gates.start)
        self._last_time, self._asked = timestamp, 0
