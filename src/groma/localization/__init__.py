# SPDX-License-Identifier: BSD-3-Clause
"""Where was this photograph taken: the pose of a camera in a map that is there already.

What comes in is a map (a scene with its photographs, :mod:`map_index`) and a photograph, or matches that somebody else
made. :mod:`retrieval` says which images of the map to compare with, :mod:`matching` pairs points and segments of the
query with landmarks, :mod:`hypotheses` proposes poses from few matches, :mod:`refinement` fits the pose to all that
agree, each weighted by its noise and by the uncertainty of its landmark, and :mod:`verdict` says how certain it is that
the place is right. :mod:`absolute_pose` is all of it for given matches, :mod:`localizer` for photographs,
:mod:`result` writes the folder.
"""
