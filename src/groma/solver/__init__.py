# SPDX-License-Identifier: BSD-3-Clause
"""From a problem to its minimum, and to covariances."""
