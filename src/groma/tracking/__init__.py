# SPDX-License-Identifier: BSD-3-Clause
"""Track a camera through a sequence, and map points, lines and planes on the way."""

from groma.tracking.options import TrackOptions
from groma.tracking.tracker import TrackedFrame, Tracker, TrackResult

__all__ = ["TrackOptions", "TrackResult", "TrackedFrame", "Tracker"]
