# SPDX-License-Identifier: BSD-3-Clause
"""Lines that converged to a wrong local minimum are detected, triangulated again and solved with cameras held."""
