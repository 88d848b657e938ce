# SPDX-License-Identifier: BSD-3-Clause
"""What residuals tell about a model that does not fit: a lens with distortion that it lacks, a rig that moves."""
