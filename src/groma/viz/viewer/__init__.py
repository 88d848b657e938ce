# SPDX-License-Identifier: BSD-3-Clause
"""The viewer: a scene, or a running track, in the browser."""
