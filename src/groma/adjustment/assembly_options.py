# SPDX-License-Identifier: BSD-3-Clause
"""What of a scene takes part in a problem, and how it is weighted."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from groma._typing import BoolArray, FloatArray
from groma.errors import InputError, did_you_mean
from groma.factors.losses import Loss, Trivial
from groma.geometry.charts.line_charts import LINE_CHARTS

#: How well landmarks keep to what they lie on, as a length in the images, pixels: walls are not flat.
SURFACE_SIGMA_PX = 0.2
#: How observed segments are compared with lines: see :mod:`groma.adjustment.terms.lines`.
LINE_RESIDUALS = ("endpoints", "bearing", "normal")
#: How planes measured in the camera are compared with planes: see :mod:`groma.adjustment.terms.plane_observations`.
PLANE_RESIDUALS = ("normal_offset", "quaternion")


@dataclass(frozen=True)
class RightTurnPrior:
    """The prior of the small rotation of right cameras from their rectified orientation."""

    #: (3,) angles about x, y and z (pitch, yaw, roll), radians.
    angles: FloatArray
    #: (3, 3) square root of their information.
    sqrt_information: FloatArray


@dataclass(frozen=True)
class AssemblyOptions:
    """What of a scene takes part, and how it is weighted."""

    #: Points and what was observed of them.
    points: bool = True
    #: Lines and what was observed of them.
    lines: bool = True
    #: Planes and directions; landmarks lie on lines without them too.
    planes: bool = True
    #: Move the cameras; otherwise they are held.
    refine_poses: bool = True
    #: (F,) frames that are held, besides what the gauge holds; (F, 6) coordinates of frames if that is ``free``.
    held_frames: BoolArray | None = None
    #: Move the landmarks; otherwise they are held.
    refine_landmarks: bool = True
    #: Estimate focal lengths and distortion; None: of cameras whose calibration was not given, which have a row in
    #: ``principal_point_priors``.
    refine_intrinsics: bool | None = False
    #: With the intrinsics: principal points too; None: of these cameras.
    refine_principal_point: bool | None = False
    #: Of a scene that is one part of a whole, in all parts: which cameras see landmarks, and how many lengths relations
    #: with planes compare with zero. None: as in the scene.
    seen_cameras: tuple[int, ...] | None = None
    num_lengths: int | None = None
    #: Estimate where cameras sit on their rig.
    refine_rigs: bool = False
    #: Estimate the common rotation of the right cameras of stereo pairs, with this prior. None:
    #: rectified pairs are right as they are.
    right_turn: RightTurnPrior | None = None
    #: How points move: ``auto``, far ones linearly in their inverse depth; or ``euclidean``.
    point_chart: str = "auto"
    #: A name of :data:`groma.geometry.charts.line_charts.LINE_CHARTS`.
    line_chart: str = "cartesian"
    #: How segments are compared with lines: ``endpoints``, the distances of the ends from the line in the image;
    #: ``bearing``, the angles between the rays of the ends and the plane through camera and line; ``normal``, the
    #: normal of that plane against the line's direction and the ray to its anchor.
    line_residual: str = "endpoints"
    #: How planes measured in the camera are compared: ``normal_offset``, in the camera; or ``quaternion``.
    plane_residual: str = "normal_offset"
    #: Standard deviation of the usual coordinate of a point, pixels; those of single observations are relative to it.
    point_sigma_px: float = 1.0
    #: The same of an end point of a segment, across it.
    line_sigma_px: float = 1.0
    #: Correlation of the errors of a segment's two ends, across it. Lines are measured where errors are independent:
    #: nearer to the middle of the segment if it is negative, as where a line was fitted to the pixels of an edge.
    line_end_correlation: float = 0.0
    #: How well points and lines keep to their planes and lines, as a length in the images, pixels; for relations
    #: without a standard deviation of their own.
    structure_sigma_px: float = SURFACE_SIGMA_PX
    #: Relations between landmarks as distances (``metric``, weighted by ``structure_sigma_px``) or as differences of
    #: pixels (``pixels``, weighted by the noise of the images). Those with a standard deviation are always distances.
    structure_form: str = "metric"
    #: Points on lines tie points to lines, and only one of the two can be eliminated. With more lines than this they
    #: are measured in pixels instead, which leaves points and lines uncoupled. The solver keeps no more unasked. Cost:
    #: memory and time.
    max_coupled_lines: int = 4000
    #: Hold lines together that meet. All of these stay in the reduced system: for scenes with some hundred of them.
    meeting_lines: bool = False
    #: Loss of what comes from matching, and of the relations between landmarks.
    loss: Loss = field(default_factory=Trivial)
    #: The scale of the loss of segments over that of points.
    line_loss_factor: float = 1.0
    #: Another loss of the relations between landmarks.
    relation_loss: Loss | None = None
    #: Leave out points that start behind their camera.
    drop_behind: bool = True
    #: Let points count for nothing while they are behind their camera; otherwise the formula holds there, too.
    require_in_front: bool = False
    #: ``free``: damping holds the scene; ``first_camera``: the first frame is held, and the scale by the farthest one
    #: unless measurements tell it; ``auto``: ``first_camera`` where lengths are measured in the cameras or between
    #: landmarks, which would shrink a scene of free scale, or at the ends of segments, which stay where they are when
    #: the scene moves; else ``free``.
    gauge: str = "auto"

    def __post_init__(self) -> None:
        # Here, so that a wrong name is refused whether the scene has such landmarks or not.
        for name, known in (
            ("point_chart", ("auto", "euclidean")),
            ("line_chart", LINE_CHARTS),
            ("line_residual", LINE_RESIDUALS),
            ("plane_residual", PLANE_RESIDUALS),
            ("structure_form", ("metric", "pixels")),
            ("gauge", ("auto", "first_camera", "free")),
        ):
            if getattr(self, name) not in known:
                given = getattr(self, name)
                raise InputError(
                    f"{name} must be one of {', '.join(sorted(known))}; got {given!r}.{did_you_mean(given, known)}"
                )
        if not abs(self.line_end_correlation) < 1.0:
            raise InputError(f"line_end_correlation must be between -1 and 1; got {self.line_end_correlation}.")

    @property
    def reach(self) -> float:
        r"""Where on a segment, from its middle in half lengths, errors are independent.

        The mean of the two ends' errors has the variance :math:`(1+\rho)\sigma^2/2` and half of their difference
        :math:`(1-\rho)\sigma^2/2`, independent of each other; so at :math:`\pm s` with
        :math:`s^2 = (1+\rho)/(1-\rho)` errors are independent too, of the variance :math:`(1+\rho)\sigma^2`. A line
        fitted to many pixels has :math:`\rho = -1/2`: its places are those of the quadrature of Gauss.
        """
        return math.sqrt((1.0 + self.line_end_correlation) / (1.0 - self.line_end_correlation))
