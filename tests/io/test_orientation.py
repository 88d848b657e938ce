# SPDX-License-Identifier: BSD-3-Clause
"""How photographs are turned upright, by their EXIF."""

import struct

import pytest

from groma.io.survey.exif import quarter_turns


@pytest.mark.parametrize("order", ["<", ">"])
def test_quarter_turns_that_show_a_photograph_upright(tmp_path, order):
    """Of the orientations of EXIF; mirrored ones, damaged ones and files of other kinds are not turned."""
    path = tmp_path / "a.jpg"
    for orientation, turns in {1: 0, 3: 2, 6: 1, 8: 3, 5: 0, 77: 0}.items():
        body = b"Exif\0\0" + (b"II*\0" if order == "<" else b"MM\0*")
        body += struct.pack(order + "IHHHIHHI", 8, 1, 0x0112, 3, 1, orientation, 0, 0)
        content = b"\xff\xd8\xff\xe1" + struct.pack(">H", len(body) + 2) + body + b"\xff\xda"
        path.write_bytes(content)
        assert quarter_turns(path) == turns
        for cut in range(len(content) - 8):  # the last bytes are not needed
            path.write_bytes(content[:cut])
            assert quarter_turns(path) == 0 or cut > len(content) - 12
    for other in (b"\x89PNG", b"\xff\xd8\xff\xe1\0\x0aExif\0\0"):
        path.write_bytes(other)
        assert quarter_turns(path) == 0
    assert quarter_turns(tmp_path / "missing.jpg") == 0
