# SPDX-License-Identifier: BSD-3-Clause
"""What is wrong with a map, and what a query's pose is off by it.

What comes in is a map with the points and lines that queries are matched with. The errors of its poses and calibrations
(:mod:`common_errors`) are those of its adjustment or, of poses that were held, what its points say against them
(:mod:`held_poses`). What both do not explain shows where images are localised in what the others made
(:mod:`map_errors`, :mod:`left_out`). What goes out is added to the covariances of queries.
"""
