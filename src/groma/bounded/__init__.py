# SPDX-License-Identifier: BSD-3-Clause
"""Reading files that are not trusted: sizes are known before bytes are expanded, names stay in their folder.

In come files as they lie on disk; out come bytes, lines of text, arrays and images, each within a bound that follows
from the size of the file, or a :class:`~groma.errors.FileFormatError` with the bound. All readers stand on these
five: :mod:`~groma.bounded.content` (whole files, gzip, bzip2), :mod:`~groma.bounded.text` (lines, words, finite
numbers), :mod:`~groma.bounded.documents` (JSON), :mod:`~groma.bounded.arrays` (``.npz``, ``.npy``) and
:mod:`~groma.bounded.images` (headers before pixels).
:mod:`~groma.bounded.names` turns names that a file gives into paths, and :mod:`~groma.bounded.json_text` writes
numbers as JSON that every reader accepts.
"""
