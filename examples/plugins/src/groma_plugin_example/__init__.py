# SPDX-License-Identifier: BSD-3-Clause
"""One of everything that can be added to groma from outside."""
