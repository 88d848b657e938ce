# SPDX-License-Identifier: BSD-3-Clause
"""Compiled code on this machine: everything compiled ahead (``warmup``), and the time that compiling takes (``time``).

In come the names of what is going to be done. For ``groma warmup`` small scenes are adjusted, mapped and tracked
(``runs``); a command that has to compile is helped by processes that go through a recorded list (``ahead``,
``needed``). Out come compiled functions on disk, and how many were compiled and loaded.
"""
