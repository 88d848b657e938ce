# SPDX-License-Identifier: BSD-3-Clause
"""The report: a scene, a map or a track as one HTML file without network access."""
