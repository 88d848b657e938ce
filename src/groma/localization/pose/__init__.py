# SPDX-License-Identifier: BSD-3-Clause
"""The pose of a camera from matches, many of them wrong.

What comes in are matches of points and segments with landmarks, and the noise of both (:mod:`matches`). Poses are
proposed from few of them (:mod:`hypotheses`), fitted to all that agree (:mod:`refinement`) and judged (:mod:`verdict`);
:mod:`absolute_pose` is all of it. What goes out is a pose, its covariance, what agrees, and how far to trust it.
"""
