# SPDX-License-Identifier: BSD-3-Clause
"""JSON documents: what is not finite, too deep, of another kind or not to be written again is refused in one line."""

import numpy as np
import pytest

from groma.bounded.documents import begins_with, member, number, of_kind, read_document, size, table
from groma.errors import FileFormatError


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[" * 100_000, "nested too deeply"),
        (b'{"a":' * 100_000, "nested too deeply"),
        (b'{"a": NaN}', "expected finite numbers; got NaN"),
        (b"[-Infinity]", "expected finite numbers; got -Infinity"),
        (b'{"a": 1,\n"b": }', "not JSON from line 2, column 6"),
        (b"", "not JSON from line 1, column 1"),
        (b'{"a": "\xff"}', "not a text file"),
        (b'{"a": ' + b"1" * 5000 + b"}", "a number that is too long"),
    ],
)
def test_what_is_no_document(tmp_path, content, words):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(FileFormatError, match=words):
        read_document(tmp_path / "a.json")


def test_a_document_with_a_mark_at_its_beginning(tmp_path):
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf {"a": [1, 2.5]}')
    assert read_document(tmp_path / "a.json") == {"a": [1, 2.5]}
    assert begins_with(b"\xef\xbb\xbf\n {", b"{") and not begins_with(b"[{", b"{")


@pytest.mark.parametrize("value", [None, True, "1", 1e400, -1e305, 10**400, [1.0], {}])
def test_numbers(value):
    assert number({"a": 3}, "a", "here") == 3.0 and number({}, "a", "here", 2.0) == 2.0
    with pytest.raises(FileFormatError, match="here: expected 'a', a finite number; got"):
        number({"a": value}, "a", "here", 2.0)


@pytest.mark.parametrize("value", [0, -5, 2.5, 1e7])
def test_sizes(value):
    assert size({"w": 640.0, "h": 480}, ("w", "h"), "here") == (640, 480)
    with pytest.raises(FileFormatError, match="expected 'h', a size in pixels"):
        size({"w": 640, "h": value}, ("w", "h"), "here")


@pytest.mark.parametrize(
    "rows",
    [[[1, 2], [3]], [[1, "2"]], [[1, None]], [[1, 2, 3]], [None], [[1, 1e400]], [[1, 10**30]], ["ab"], [[True, False]]],
)
def test_tables(rows):
    np.testing.assert_array_equal(table([[1, 2.5], [3, 4]], (2,), "here"), [[1, 2.5], [3, 4]])
    assert table([], (3, 3), "here").shape == (0, 3, 3)
    with pytest.raises(FileFormatError, match="here: expected 2 finite numbers; got"):
        table(rows, (2,), "here")


@pytest.mark.parametrize("text", ["a\0b", "\ud800", "n" * 5000])
def test_texts_can_be_written_again(text):
    assert of_kind("é b.png", str, "here") == "é b.png"
    with pytest.raises(FileFormatError, match="here: expected a name"):
        of_kind(text, str, "here")


def test_members():
    assert member({"a": [1]}, "a", list, "here") == [1]
    with pytest.raises(FileFormatError, match="here: expected 'b', which is missing"):
        member({"a": [1]}, "b", list, "here")
    with pytest.raises(FileFormatError, match=r"here, 'a': expected an object \{...\}; got \[1\]"):
        member({"a": [1]}, "a", dict, "here")
