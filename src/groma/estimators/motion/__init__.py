# SPDX-License-Identifier: BSD-3-Clause
"""Rigid, similarity and projective motions between two copies of the same lines and points.

Matched lines and points come in (:mod:`matches`: their noise and residuals), :mod:`groups` defines the kinds of
motions, :mod:`hypotheses` proposes motions of a few matches, :mod:`estimation` chooses, refines and judges. What goes
out is a motion with its covariance and what agrees with it, or an error that names what the matches do not determine.
"""
