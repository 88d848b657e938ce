# SPDX-License-Identifier: BSD-3-Clause
"""Lines have several minima: those that settled in a wrong one are found, placed anew, and solved on their own."""
