# SPDX-License-Identifier: BSD-3-Clause
"""The version; in a file of its own, so that whatever names it need not import the package."""

__version__ = "0.1.0"
