# SPDX-License-Identifier: BSD-3-Clause
"""What groma imports: each module registers its part when it is imported."""

from groma_plugin_example import camera, chart, gravity, linear_solver, loss, segments_file

__all__ = ["camera", "chart", "gravity", "linear_solver", "loss", "segments_file"]
