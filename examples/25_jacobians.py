# SPDX-License-Identifier: BSD-3-Clause
"""Residuals and Jacobians of a factor as NumPy arrays, in any chart, and a check by differences."""

import numpy as np

import groma
from groma.geometry import Euclidean
from groma.geometry.charts.line_charts import LINE_CHARTS
from groma.geometry.charts.pose_charts import PoseLeft
from groma.problem.residuals import jacobians_of, residuals_of

# Three cameras, five lines, and a segment of every line in every image: all at random, nothing fits.
rng = np.random.default_rng(0)
pose_chart, line_chart = PoseLeft(), LINE_CHARTS["orthonormal_right"]
calibration = np.array([[800.0, 810.0, 320.0, 240.0]])
variables = {
    "poses": groma.Variables(pose_chart, pose_chart.random(rng, 3)),
    "lines": groma.Variables(line_chart, line_chart.random(rng, 5)),
    "calibrations": groma.Variables(Euclidean(4, "intrinsics"), calibration),
}
pose_idx, line_idx = np.divmod(np.arange(15), 5)
factor = groma.LineReprojection(
    pose=groma.Ref("poses", pose_idx),
    line=groma.Ref("lines", line_idx),
    intrinsics=groma.Ref("calibrations", 0 * pose_idx),
    camera_model="PINHOLE",
    segments=rng.uniform(0, 500, (15, 4)),
)


residuals, jacobians = residuals_of(factor, variables), jacobians_of(factor, variables)
print("residuals", residuals.shape, {name: block.shape for name, block in jacobians.items()})

# The same by central differences through the charts.
step = 1e-6
for slot, ref in factor.references():
    group = variables[ref.group]
    for k in range(group.manifold.dof):
        delta = np.zeros((len(group.state), group.manifold.dof))
        delta[:, k] = step
        sides = [
            residuals_of(factor, {**variables, ref.group: groma.Variables(group.manifold, moved)})
            for moved in (group.manifold.retract(group.state, sign * delta) for sign in (1, -1))
        ]
        difference = (sides[0] - sides[1]) / (2 * step)
        analytic = jacobians[slot.name][:, :, k]
        worst = np.abs(difference - analytic).max() / np.abs(analytic).max()
        assert worst < 1e-5, (slot.name, k, worst)
print("all blocks agree with differences")
