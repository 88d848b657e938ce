# SPDX-License-Identifier: BSD-3-Clause
"""The commands, one per file: check what can be refused before any work, call the library, write, say."""
