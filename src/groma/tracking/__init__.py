# SPDX-License-Identifier: BSD-3-Clause
"""Track a camera through a sequence and map points, lines and planes.

In come frames, one by one (:class:`Tracker`) or as a sequence (:func:`track`). Each frame gets a pose (``frame``,
``pose``); now and then one becomes a keyframe of a growing map (``map``), which is adjusted, closed in loops and joined
behind the frames (``backend``). Out come a trajectory, a scene and what became of each frame.
"""

from groma.tracking.options import TrackOptions
from groma.tracking.outcome import TrackedFrame, TrackResult
from groma.tracking.sequence import SequenceResult, TrackProgress, track
from groma.tracking.tracker import Tracker

__all__ = ["SequenceResult", "TrackOptions", "TrackProgress", "TrackResult", "TrackedFrame", "Tracker", "track"]
