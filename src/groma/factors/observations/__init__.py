# SPDX-License-Identifier: BSD-3-Clause
"""Factors of what a camera measures: points, segments and planes in images, depths and disparities."""
