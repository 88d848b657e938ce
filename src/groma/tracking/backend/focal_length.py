# SPDX-License-Identifier: BSD-3-Clause
r"""A focal length of a stereo pair or a single camera that the images contradict.

With a focal length that is too long by a factor s, the depth :math:`z = f b / d` of all points is too large by s, and
so are motions along the optical axis. Where the camera only drives ahead that is another scene, as good as the right
one; where it turns, the images contradict. So the focal length is freed in a few steps from where the adjustment of all
keyframes ended. What did not fit the given one was left out while tracking, so the correction that comes out is smaller
than the error.

Of a single camera, errors that all points share, such as of its distortion or of followed patches, change the focal
length by several of its standard deviations, so that more is needed there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from groma.adjustment.assemble import assemble, first_camera_gauge
from groma.gates import NORMAL
from groma.scene import Cameras
from groma.solver.covariance.marginals import Covariances
from groma.solver.options import SolverOptions
from groma.solver.solve import solve
from groma.tracking.backend.local_adjustment import job_of
from groma.tracking.frame.camera import TrackCamera
from groma.tracking.gates import RectificationGates
from groma.tracking.map.map_scene import TRACKING
from groma.tracking.map.track_map import TrackMap

#: A pinhole with one focal length, and the group of its parameters in a problem.
_MODEL = "SIMPLE_PINHOLE"
_GROUP = f"intrinsics/{_MODEL}"


def focal_length_that_does_not_fit(track_map: TrackMap, camera: TrackCamera, gates: RectificationGates) -> list[str]:
    """Say so where the images of a map surely ask for another focal length of their camera or rectified pair."""
    living = track_map.living()
    job = job_of(track_map, camera, living, np.arange(len(living)) == 0, False) if len(living) > 1 else None
    if job is None:
        return []
    one = Cameras.of([1], [_MODEL], [camera.params[[0, 2, 3]]], [camera.width, camera.height])
    # Depths that features had where the map was lost are columns under the given focal length.
    scene = job.scene.replace(cameras=one, point_depths=job.scene.point_depths.take(np.zeros(0, np.int64)))
    is_pair = camera.baseline > 0
    if is_pair and len(scene.right_columns) < gates.min_columns:
        return []
    held = first_camera_gauge(scene, first=0)
    options = replace(TRACKING, lines=False, planes=False, refine_intrinsics=True, held_frames=held)
    settings = SolverOptions(max_iterations=gates.focal_iterations, threads=1)
    solved = solve(assemble(scene, options).problem, settings).problem
    change = float(solved.variables[_GROUP].state[0, 0] / camera.fx) - 1.0
    sigma = float(Covariances(solved).of(_GROUP, 0)[0, 0, 0] ** 0.5 / camera.fx)
    if not abs(change) > max(gates.focal_share if is_pair else gates.focal_share_alone, NORMAL.sure * sigma):
        return []
    which = "longer" if change > 0.0 else "shorter"
    wrong = "Lengths along the optical axis are wrong by as much." if is_pair else "Path and map are bent."
    return [
        f"The focal length does not fit the images: one {100.0 * abs(change):.1f} ± {100.0 * sigma:.1f} % {which} than "
        f"{camera.fx:.1f} px fits better, and the error may be larger. {wrong} Check the calibration."
    ]
