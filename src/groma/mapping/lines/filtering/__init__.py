# SPDX-License-Identifier: BSD-3-Clause
"""Which lines are kept: named filters, each with the reason it gives to what it rejects.

In come lines with their observations. Out go lines that enough images show, that are well determined, that are no
texture and no duplicate of another.
"""
