# SPDX-License-Identifier: BSD-3-Clause
"""Where the camera is: prediction, following, the estimate of one pose, its verification, and the search when lost."""
