# SPDX-License-Identifier: BSD-3-Clause
"""Damaged files: 1 500 truncations and mutations give a valid scene or an error of groma, never anything else.

They run in this process: an abort, a hang (see the timeouts) or a foreign exception of any reader fails the test. Each
operation was chosen because it broke a reader once: huge counts made pycolmap read for hours.
"""

import bz2
import gzip
import shutil
import struct
import zlib
from pathlib import Path

import pytest
from _models import rig_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from groma.errors import FileFormatError, GromaError
from groma.io import read_scene, read_tum, write_archive, write_colmap
from groma.scene import Scene

BAL = Path(__file__).parents[1] / "data" / "bal"
EXAMPLES = settings(max_examples=100)

NUMBERS = [struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e308, -1.0, 0.0)]
NUMBERS += [struct.pack("<Q", value) for value in (2**64 - 1, 2**63, 2**40, 2**31, 2**20, 0, 1)]
WORDS = [
    b" nan ",
    b" inf ",
    b" -1 ",
    b" 1e400 ",
    b" 99999999999999999999 ",
    b" ",
    b"\n",
    b"\0",
    b"#",
    b"\xff\xfe",
    b" x ",
]


@st.composite
def damages(draw):
    """A damage to a file, as a function from bytes to bytes; places are fractions of the length."""
    kind = draw(st.sampled_from(["truncate", "flip", "overwrite", "insert", "remove", "append", "repeat"]))
    place = draw(st.floats(0, 1, exclude_max=True))
    size = draw(st.integers(1, 64))
    blob = draw(st.sampled_from(NUMBERS + WORDS) | st.binary(min_size=1, max_size=16))

    def damage(content: bytes) -> bytes:
        at = int(place * len(content))
        head, tail = content[:at], content[at:]
        return {
            "truncate": lambda: head,
            "flip": lambda: head + bytes([tail[0] ^ 1 << size % 8]) + tail[1:] if tail else head,
            "overwrite": lambda: head + blob + tail[len(blob) :],
            "insert": lambda: head + blob + tail,
            "remove": lambda: head + tail[size:],
            "append": lambda: content + blob,
            "repeat": lambda: head + tail[:size] * 3 + tail[size:],
        }[kind]()

    return damage


def reads_or_refuses(path: Path) -> None:
    try:
        scene = read_scene(path)
    except GromaError as error:
        assert str(error)
    else:
        assert isinstance(scene, Scene)


@pytest.fixture(scope="module")
def workshop(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("hostile")
    for form in ("binary", "text"):
        write_colmap(rig_scene(), folder / form, form=form)
    write_archive(rig_scene(), folder / "scene.npz")
    return folder


@pytest.mark.timeout(60)
@pytest.mark.parametrize("form", ["binary", "text"])
def test_colmap(workshop, form):
    source = {path.name: path.read_bytes() for path in (workshop / form).iterdir() if path.is_file()}
    shutil.rmtree(workshop / form / "structures", ignore_errors=True)

    @EXAMPLES
    @given(st.sampled_from(sorted(source)), damages(), st.booleans())
    def run(name, damage, with_rigs):
        for other, content in source.items():
            path = workshop / form / other
            path.write_bytes(damage(content) if other == name else content)
            if not with_rigs and path.stem in ("rigs", "frames"):
                path.unlink()
        reads_or_refuses(workshop / form)

    run()


@pytest.mark.timeout(60)
@pytest.mark.parametrize("suffix", ["txt", "bz2", "gz"])
def test_bal(tmp_path, suffix):
    text = (BAL / "dubrovnik-3-7-pre.txt").read_bytes()
    content = {"txt": lambda: text, "bz2": lambda: bz2.compress(text), "gz": lambda: _gzip_stored(text)}[suffix]()
    path = tmp_path / f"problem.{suffix}"

    @EXAMPLES
    @given(damages())
    def run(damage):
        path.write_bytes(damage(content))
        reads_or_refuses(path)

    run()


@pytest.mark.timeout(60)
def test_damage_inside_a_compressed_bal_file(tmp_path):
    text = (BAL / "dubrovnik-3-7-pre.txt").read_bytes()

    @EXAMPLES
    @given(damages())
    def run(damage):
        (tmp_path / "problem.bz2").write_bytes(bz2.compress(damage(text)))
        reads_or_refuses(tmp_path / "problem.bz2")

    run()


@pytest.mark.timeout(60)
def test_archive(workshop):
    content = (workshop / "scene.npz").read_bytes()

    @EXAMPLES
    @given(damages())
    def run(damage):
        (workshop / "damaged.npz").write_bytes(damage(content))
        reads_or_refuses(workshop / "damaged.npz")

    run()


@pytest.mark.timeout(60)
def test_tum(tmp_path):
    content = b"".join(b"%d.5 1 2 3 0 0.6 0 0.8\n" % row for row in range(4))

    @EXAMPLES
    @given(damages())
    def run(damage):
        (tmp_path / "trajectory.txt").write_bytes(damage(content))
        try:
            read_tum(tmp_path / "trajectory.txt")
        except GromaError as error:
            assert str(error)

    run()


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_a_count_that_is_too_large_is_named(tmp_path, name):
    write_colmap(rig_scene(), tmp_path / "model")
    path = tmp_path / "model" / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", 2**40) + path.read_bytes()[8:])
    with pytest.raises(FileFormatError, match=rf"{name}\.bin.*promises"):
        read_scene(tmp_path / "model")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_every_truncation_of_a_binary_model_is_refused(tmp_path, name):
    write_colmap(rig_scene(), tmp_path / "model")
    path = tmp_path / "model" / f"{name}.bin"
    content = path.read_bytes()
    for length in range(0, len(content), 7):
        path.write_bytes(content[:length])
        with pytest.raises(FileFormatError):
            read_scene(tmp_path / "model")


def _gzip_stored(text: bytes) -> bytes:
    """Wrap text as gzip without zlib's compressor, which pycolmap's wheel may have broken in this process."""
    block = b"\x01" + struct.pack("<HH", len(text), len(text) ^ 0xFFFF) + text
    packed = b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + block + struct.pack("<II", zlib.crc32(text), len(text))
    assert gzip.decompress(packed) == text
    return packed
