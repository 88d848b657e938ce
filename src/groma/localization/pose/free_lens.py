# SPDX-License-Identifier: BSD-3-Clause
r"""What is estimated of a lens besides a pose.

Where nothing is known of a lens, its principal point :math:`c` and the shape of its pixels, :math:`f_x / f_y`, are not
known, either. Before a flat scene they do what a turn and another focal length do, so that a focal length that is
estimated with both held takes up what they are off: a facade's is wrong by a per cent if pixels are longer than wide by
two thousandths. Lenses are centred to about a hundredth of the longer side, and pixels nearly square; with that as
priors,

.. math:: c \sim \mathcal N(c_0, \sigma_c^2 I) , \qquad \log (f_x / f_y) \sim \mathcal N(0, \sigma_a^2) ,

both are estimated where the matches tell them, and what they do not tell is in the covariance of the rest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from groma._typing import FloatArray, IntArray
from groma.adjustment.terms.principal_points import GATES as PRINCIPAL_POINTS
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.gates import REFINEMENT

#: What is estimated: nothing; the focal length (several by one factor); that and the principal point; or these, with a
#: priors, the first distortion, and the shape of pixels.
LensUnknowns = Literal["none", "focal", "pinhole", "all"]
#: Largest step of focal length and principal point: what is near changes by more.
_FARTHEST = 0.3


@dataclass(frozen=True, eq=False)
class FreeLens:
    """The logarithm of the focal lengths, which change by one factor; the place of the principal point, in units of
    them; distortions; and half the logarithm of the shape of pixels.
    """

    focal: IntArray
    #: The coordinates of the principal point, and the distortions, that are estimated; none where they are held.
    center: IntArray
    distortion: IntArray
    #: Whether the shape of pixels is estimated.
    shape: bool
    #: (c,) where the prior has the principal point, and its standard deviation, pixels; infinite for none.
    expected: FloatArray
    sigma: float
    #: Standard deviation of half the logarithm of the shape.
    shape_sigma: float

    def directions(self, params: FloatArray) -> FloatArray:
        """Derivatives (p, k) of the parameters (p,) of a camera by these unknowns."""
        first, number = 1 + len(self.center), 1 + len(self.center) + len(self.distortion)
        found = np.zeros((len(params), number + self.shape))
        found[self.focal, 0] = params[self.focal]
        found[self.center, np.arange(1, first)] = params[self.focal].mean()
        found[self.distortion, np.arange(first, number)] = 1.0
        if self.shape:
            found[self.focal, -1] = params[self.focal] * (1.0, -1.0)
        return found

    def moved(self, params: FloatArray, step: FloatArray) -> FloatArray:
        """Parameters after a step (k,), which is cut off where it is large."""
        step, found = np.minimum(np.maximum(step, -_FARTHEST), _FARTHEST), params.copy()
        first, number = 1 + len(self.center), 1 + len(self.center) + len(self.distortion)
        found[self.center] += step[1:first] * params[self.focal].mean()
        found[self.distortion] += step[first:number]
        found[self.focal] *= np.exp(step[0])
        if self.shape:
            found[self.focal] *= np.exp(step[-1] * np.array([1.0, -1.0]))
        return found

    def prior(self, params: FloatArray) -> FloatArray:
        """Products (7 + k, 7 + k) of the derivatives and residuals of the priors, as of some more measurements."""
        count = len(self.center)
        record = np.zeros((count + self.shape, 8 + count + len(self.distortion) + self.shape))
        if not self.shape and not np.isfinite(self.sigma):
            return np.zeros((record.shape[1],) * 2)
        at = np.arange(count)
        record[at, 7 + at] = params[self.focal].mean() / self.sigma
        record[:count, -1] = (params[self.center] - self.expected) / self.sigma
        if self.shape:
            record[-1, -2:] = 1.0, 0.5 * np.log(params[self.focal[0]] / params[self.focal[1]])
            record[-1] /= self.shape_sigma
        return record.T @ record


def free_lens(camera: QueryCamera, lens: LensUnknowns) -> FreeLens | None:
    """Return what is estimated of a camera, whose principal point is where it is expected; None for nothing."""
    if lens == "none":
        return None
    kind, unknown = camera.kind, lens == "all"
    center = np.array(kind.principal_point_indices if lens != "focal" else (), np.int64)
    distortion = np.array(kind.extra_indices[:1] if unknown else (), np.int64)
    sigma = PRINCIPAL_POINTS.centred * max(camera.width, camera.height) if unknown else np.inf
    shape = unknown and len(kind.focal_indices) == 2
    focal = np.array(kind.focal_indices)
    return FreeLens(focal, center, distortion, shape, camera.params[center], sigma, 0.5 * REFINEMENT.square)
