# SPDX-License-Identifier: BSD-3-Clause
"""Endings of the names of images and videos, in lower case."""

IMAGES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm")
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")

__all__ = ["IMAGES", "VIDEOS"]
