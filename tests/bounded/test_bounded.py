# SPDX-License-Identifier: BSD-3-Clause
"""Reading within bounds: sizes of images from their headers, names that stay in a folder, lines, numbers, arrays."""

import io
import struct
import zipfile

import cv2
import numpy as np
import pytest

from groma.bounded.arrays import form, opened_arrays, read_array
from groma.bounded.content import READING, expanded_limit, read_content
from groma.bounded.images import decoded, image_size
from groma.bounded.names import listed_file, outside, stays_inside
from groma.bounded.text import finite, read_lines, read_words, whole
from groma.errors import FileFormatError

COLOUR = np.random.default_rng(0).integers(0, 255, (37, 53, 3)).astype(np.uint8)
GRAY = np.ascontiguousarray(COLOUR[..., 0])


@pytest.mark.parametrize(
    ("ending", "image", "flags"),
    [
        *[(ending, image, []) for ending in (".png", ".jpg", ".bmp", ".webp", ".tif") for image in (COLOUR, GRAY)],
        (".jpg", COLOUR, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".webp", COLOUR, [cv2.IMWRITE_WEBP_QUALITY, 101]),  # without loss
        (".png", GRAY.astype(np.uint16), []),
        (".tif", GRAY.astype(np.float32), []),
        (".ppm", COLOUR, []),
        (".pgm", GRAY, []),
        (".pam", COLOUR, []),
    ],
)
def test_sizes_are_those_of_the_decoder(ending, image, flags):
    content = bytes(cv2.imencode(ending, image, flags)[1])
    assert image_size(content) == (53, 37)
    assert decoded(content, cv2.IMREAD_UNCHANGED).shape[:2] == (37, 53)
    for length in range(0, min(len(content), 400), 3):  # no cut makes it fail otherwise than by None
        image_size(content[:length])


@pytest.mark.parametrize("kind", ["WEBP", "TIFF", "JPEG"])
def test_sizes_behind_other_parts_of_the_file(kind):
    pillow = pytest.importorskip("PIL.Image")
    stream = io.BytesIO()
    extra = {"TIFF": {"big_tiff": True}}.get(kind, {"exif": b"Exif\0\0" + b"\xff\xc0" * 200})
    pillow.fromarray(COLOUR).save(stream, kind, **extra)
    assert image_size(stream.getvalue()) == (53, 37)


def test_images_larger_than_their_file_can_hold_are_refused():
    content = bytearray(cv2.imencode(".png", GRAY)[1])
    content[16:24] = struct.pack(">II", 20_000, 20_000)
    with pytest.raises(FileFormatError, match="promises 20000x20000 pixels"):
        decoded(bytes(content), cv2.IMREAD_GRAYSCALE)
    content = bytearray(cv2.imencode(".png", GRAY)[1])
    content[33:37] = struct.pack(">I", 1 << 30)  # of the first chunk of pixels
    assert decoded(bytes(content), cv2.IMREAD_GRAYSCALE) is None
    assert decoded(b"GIF89a" + bytes(100), cv2.IMREAD_GRAYSCALE) is None  # a kind that groma does not take
    assert decoded(b"", cv2.IMREAD_GRAYSCALE) is None


@pytest.mark.parametrize("name", ["a.png", "rgb/a.png", "a/../b.png", "./a", "..a", "a..", "é/ü.png"])
def test_names_that_stay(tmp_path, name):
    assert stays_inside(name) and listed_file(tmp_path, name, "here") == tmp_path / name


@pytest.mark.parametrize("name", ["", "..", "../a", "a/../../b", "/etc/passwd", "a\0b", ".//../x"])
def test_names_that_leave(tmp_path, name):
    assert not stays_inside(name) and outside([name, "good"]) == [name]
    with pytest.raises(FileFormatError, match="line 3: expected the name of a file"):
        listed_file(tmp_path, name, "list.txt, line 3")


def test_lines_and_numbers(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"# head\n1 2\r\n\n  3 # tail\n")
    assert list(read_lines(path)) == [(2, "1 2"), (4, "3")]
    assert list(read_words(path)) == [(2, ["1", "2"]), (4, ["3"])]
    path.write_bytes(b"1\n" + b"1" * (READING.line + 1))
    with pytest.raises(FileFormatError, match=r"line 2: it has 1048577 characters"):
        list(read_lines(path))
    assert finite(["1", "-2.5e3"], "x") == [1.0, -2500.0]
    for word in ("nan", "inf", "-inf", "1e400", "x", "", "1,5"):
        with pytest.raises(FileFormatError, match=r"f, line 1: expected two numbers; got "):
            finite(["1", word], "f, line 1", "two numbers")
    assert whole("-12", "x") == -12 and whole(str(2**63 - 1), "x") == 2**63 - 1
    for word in ("1.5", "9" * 5000, str(2**63), "", "nan"):
        with pytest.raises(FileFormatError, match="expected a whole number"):
            whole(word, "x")


def test_what_is_no_file_is_bounded(tmp_path):
    assert expanded_limit(0) == READING.free and expanded_limit(10) == READING.free + 10 * READING.ratio
    with pytest.raises(FileFormatError, match="gives more than"):
        read_content("/dev/zero")


def test_arrays(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.eye(3)[:2]), "c": np.array("text")}
    np.savez_compressed(tmp_path / "a.npz", **arrays)
    with opened_arrays(tmp_path / "a.npz") as members:
        assert members.names == ["a", "b", "c"] and "a" in members and "d" not in members
        for name, array in arrays.items():
            np.testing.assert_array_equal(members.read(name), array)
    np.save(tmp_path / "b.npy", arrays["b"])
    np.testing.assert_array_equal(read_array(tmp_path / "b.npy"), arrays["b"])
    np.savez(tmp_path / "objects.npz", a=np.array([{}, None], dtype=object))
    with opened_arrays(tmp_path / "objects.npz") as members, pytest.raises(FileFormatError, match="Python objects"):
        members.read("a")
    content = (tmp_path / "b.npy").read_bytes()
    good = bytes(content)
    broken = good.replace(b"{'descr'", b"((((((((")
    for damaged in (b"", good[:-1], good + b"x", b"no magic" + good[8:], broken):
        (tmp_path / "b.npy").write_bytes(damaged)
        with pytest.raises(FileFormatError):
            read_array(tmp_path / "b.npy")


def test_archives_of_a_later_version_of_the_format(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.arange(3.0))
    content = bytearray(path.read_bytes())
    content[content.index(b"PK\x01\x02") + 6] = 156  # version needed to read it
    path.write_bytes(content)
    with pytest.raises(zipfile.BadZipFile, match="version"), opened_arrays(path):
        pass


def test_text_that_is_none(tmp_path):
    """Beyond the last character of Unicode, Python has errors of its own."""
    np.savez(tmp_path / "a.npz", good=np.array("é"), bad=np.array([0x110000], "<u4").view("<U1"))
    with opened_arrays(tmp_path / "a.npz") as members:
        assert str(members.read("good")) == "é"
        with pytest.raises(FileFormatError, match="text that is none"):
            members.read("bad")


@pytest.mark.parametrize(("kinds", "shape"), [("f", (None, 3)), ("iu", (2, 3)), ("iu", (None, 2)), ("iu", (None,))])
def test_forms_of_arrays(tmp_path, kinds, shape):
    np.savez(tmp_path / "a.npz", a=np.zeros((2, 3), np.int32))
    with opened_arrays(tmp_path / "a.npz") as members:
        if (kinds, shape) == ("iu", (2, 3)):
            assert members.read("a", form(kinds, *shape)).shape == (2, 3)
        else:
            with pytest.raises(FileFormatError, match="expected"):
                members.read("a", form(kinds, *shape))
