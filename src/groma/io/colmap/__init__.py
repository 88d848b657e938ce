# SPDX-License-Identifier: BSD-3-Clause
"""COLMAP models: files in and out, the way to pycolmap's objects and back, and a first model from photographs."""
