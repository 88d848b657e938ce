# SPDX-License-Identifier: BSD-3-Clause
"""The first adjustment: a synthetic scene of points, lines and planes from a perturbed start."""

# --- example
import groma
from groma.scene import synthetic

# 20 cameras on a sphere look at 200 points, 20 lines and 4 planes.
# The start is perturbed, the truth is known.
scene = synthetic.holistic(20, noise_px=1.0, seed=0)

result = groma.adjust(scene.start, groma.AdjustOptions(loss="none"))

print(result.report.termination.sentence)
for kind, rmse in result.report.to_dict()["rmse_px"].items():
    print(f"{kind}: {rmse['before']:.2f} px -> {rmse['after']:.2f} px")
groma.write_scene(result.scene, "adjusted.npz", force=True)
