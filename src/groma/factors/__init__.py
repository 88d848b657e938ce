# SPDX-License-Identifier: BSD-3-Clause
"""Factors: one residual per file, each with its formula, its kernels, its class and its registration."""
