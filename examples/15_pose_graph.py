# SPDX-License-Identifier: BSD-3-Clause
"""A pose graph: odometry round a circle that drifts, and one loop closure that puts it right."""

import numpy as np

import groma
from groma.factors import PoseBetween
from groma.geometry import se3
from groma.geometry.charts.pose_charts import PoseLeft
from groma.solver.covariance.marginals import Covariances

# 24 poses cam_from_world on a circle, looking along it.
count = 24
turn = np.linspace(0, 2 * np.pi, count, endpoint=False)
world_from_cam = np.column_stack(
    [0 * turn, np.sin(turn / 2), 0 * turn, np.cos(turn / 2), 5 * np.cos(turn), 0 * turn, -5 * np.sin(turn)]
)
truth = se3.inverse(world_from_cam)

# Steps from each pose to the next, and from the last back to the first; noise in metres and radians.
first, second = np.arange(count), np.roll(np.arange(count), -1)
sigma = np.repeat([0.05, 0.01], 3)
noise = se3.exp(sigma * np.random.default_rng(0).normal(size=(count, 6)))
steps = se3.compose(se3.compose(truth[first], se3.inverse(truth[second])), noise)

# The start follows the odometry.
start = truth.copy()
for k in range(count - 1):
    start[k + 1] = se3.compose(se3.inverse(steps[k]), start[k])

problem = groma.Problem(
    variables={"poses": groma.Variables(PoseLeft(), start, constant=first == 0)},
    factors=[
        PoseBetween(
            first=groma.Ref("poses", first),
            second=groma.Ref("poses", second),
            first_from_second=steps,
            sqrt_information=np.broadcast_to(np.diag(1 / sigma), (count, 6, 6)),
            loss=groma.loss("huber", 1.0),
        )
    ],
)
solution = groma.solve(problem)


def drift(poses):
    """Root mean square distance of the centres from the truth, metres."""
    away = se3.inverse(poses)[:, 4:] - world_from_cam[:, 4:]
    return np.sqrt((away**2).sum(axis=1).mean())


print(solution.report.termination.sentence)
print(f"error of the positions: {drift(start):.3f} m -> {drift(solution['poses']):.3f} m")
middle = Covariances(solution.problem).of("poses", count // 2)[0]
print("standard deviations of the pose farthest away (m, rad):", np.sqrt(np.diag(middle)).round(3))
