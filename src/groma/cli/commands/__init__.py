# SPDX-License-Identifier: BSD-3-Clause
"""The commands, one per file: validate the options, call the library, write the results, print a summary."""
