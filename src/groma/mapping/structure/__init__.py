# SPDX-License-Identifier: BSD-3-Clause
"""Planes, shared directions, and which points and lines belong to them, by tests with the landmarks' covariances."""
