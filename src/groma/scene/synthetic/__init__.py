# SPDX-License-Identifier: BSD-3-Clause
"""Seeded synthetic scenes with exact truth, for tests, docs and benchmarks.

In come counts, noise and a seed; out come a pair of scenes, the truth and a perturbed start, with the same noisy
measurements.
"""

from groma.scene.synthetic.scenes import FOCAL, HEIGHT, WIDTH, SyntheticScene, corridor, holistic

__all__ = ["FOCAL", "HEIGHT", "WIDTH", "SyntheticScene", "corridor", "holistic"]
