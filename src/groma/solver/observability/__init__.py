# SPDX-License-Identifier: BSD-3-Clause
"""What the data determine and what they do not, in words.

In comes a problem; one linearisation of it (``inspection.py``) is looked at as a system, camera by camera and landmark
by landmark. Out come findings, each with a sentence that names the variables, the motion that is free, and a remedy
(``diagnosis.py``).
"""
