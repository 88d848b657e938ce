# SPDX-License-Identifier: BSD-3-Clause
"""Reconstructions of other programs, one file a format.

A file comes in; its axes, pixels, distortion and numbers are brought to ours (:mod:`groma.io.interchange.calibration`,
:mod:`groma.io.interchange.poses`); a scene goes out.
"""
