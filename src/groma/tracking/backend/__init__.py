# SPDX-License-Identifier: BSD-3-Clause
"""Behind the frames: windows adjusted, loops closed, submaps joined, a stereo pair calibrated."""
