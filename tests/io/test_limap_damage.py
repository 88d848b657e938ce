# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP 2's structures that are inconsistent, incomplete or damaged: refused by name, never believed."""

import shutil
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _models import rig_scene
from hypothesis import given, settings
from hypothesis import strategies as st

from groma.errors import FileFormatError, GromaError, InputError
from groma.io import read_scene, write_colmap
from groma.io.limap.files import TRACK
from groma.io.limap.structures import Group3d, from_scene, read_beside, read_limap, with_structures, write_limap
from groma.scene import Scene

DATA = Path(__file__).parents[1] / "data" / "limap"
FILES = ("structures2d", "lines3D", "groups3D", "wireframe3D")


def test_refusals(tmp_path):
    scene = read_scene(DATA / "binary")
    structures = read_limap(DATA / "binary")
    track = structures.lines.track.copy()
    track["idx"][0] = 4
    with pytest.raises(FileFormatError, match="2D line 4 of image 1, which has 4"):
        with_structures(scene, replace(structures, lines=replace(structures.lines, track=track)))
    for params in ([0, 0, 0, 1.0], [np.nan, 0, 1, 0], [1e-13, 0, 0, 1]):
        with pytest.raises(FileFormatError, match=r"no normal|not finite"):
            with_structures(scene, replace(structures, groups=(Group3d(1, 1, np.array(params)),)))
    huge = replace(structures.lines, ids=structures.lines.ids + np.uint64(2**63))
    with pytest.raises(FileFormatError, match="too large"):
        with_structures(scene, replace(structures, lines=huge))
    with pytest.raises(InputError, match="from 0"):
        from_scene(scene.replace(lines=scene.lines.replace(ids=[-1, 2, 3])))
    with pytest.raises(InputError, match="binary"):
        write_limap(structures, tmp_path / "out", "json")
    assert structures.lines.track.dtype == TRACK


@pytest.mark.parametrize("name", FILES)
def test_a_missing_file_is_named(tmp_path, name):
    shutil.copytree(DATA / "binary", tmp_path / "model")
    (tmp_path / "model" / "structures" / f"{name}.bin").unlink()
    with pytest.raises(FileFormatError, match=f"{name}.bin is missing"):
        read_scene(tmp_path / "model")


@pytest.mark.parametrize(("form", "suffix"), [("binary", ".bin"), ("text", ".txt")])
@pytest.mark.parametrize("name", FILES)
def test_every_truncation_is_refused(tmp_path, name, form, suffix):
    shutil.copytree(DATA / form, tmp_path / "model")
    path = tmp_path / "model" / "structures" / (name + suffix)
    content = path.read_bytes()
    whole = read_scene(tmp_path / "model")
    for length in range(0, len(content) - (3 if form == "text" else 0), 5):
        # A shortened last word of text would be another number: cut at the end of a word.
        cut = content[:length] if form == "binary" else content[:length].rpartition(b" ")[0]
        path.write_bytes(cut)
        with pytest.raises(FileFormatError, match=name):
            read_beside(whole, tmp_path / "model")


@pytest.mark.parametrize("name", FILES)
def test_a_count_that_is_too_large_is_refused(tmp_path, name):
    shutil.copytree(DATA / "binary", tmp_path / "model")
    path = tmp_path / "model" / "structures" / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", 2**60) + path.read_bytes()[8:])
    with pytest.raises(FileFormatError, match=f"{name}.*promises"):
        read_scene(tmp_path / "model")


NUMBERS = [struct.pack("<d", value) for value in (float("nan"), float("inf"), 1e308, -1.0, 0.0)]
NUMBERS += [struct.pack("<Q", value) for value in (2**64 - 1, 2**63, 2**40, 2**31, 2**20, 0, 1)]
WORDS = [b" nan ", b" inf ", b" -1 ", b" 1e400 ", b" 99999999999999999999999 ", b"\n", b"\0", b"#", b"\xff", b" x "]


@pytest.mark.filterwarnings("ignore:.*were left out")
@pytest.mark.timeout(60)
@pytest.mark.parametrize("form", ["binary", "text"])
def test_damaged_files_give_a_scene_or_an_error(tmp_path, form):
    """Single damages to one of the files, groma.npz among them: a valid scene or an error of groma."""
    scene = rig_scene()
    write_colmap(scene.with_lines(scene.lines.plucker + 0.01), tmp_path / "own", form)
    shutil.copytree(DATA / form, tmp_path / "limap")
    folders = [tmp_path / "own" / "structures", tmp_path / "limap" / "structures"]
    source = {path: path.read_bytes() for folder in folders for path in folder.iterdir()}
    assert any(path.name == "groma.npz" for path in source)

    @settings(max_examples=100)
    @given(
        st.sampled_from(sorted(source)),
        st.sampled_from(["truncate", "flip", "overwrite", "insert", "remove"]),
        st.floats(0, 1, exclude_max=True),
        st.sampled_from(NUMBERS + WORDS),
        st.integers(0, 7),
    )
    def run(path, kind, place, blob, bit):
        content = source[path]
        at = int(place * len(content))
        head, tail = content[:at], content[at:]
        path.write_bytes(
            {
                "truncate": head,
                "flip": head + bytes([tail[0] ^ 1 << bit]) + tail[1:],
                "overwrite": head + blob + tail[len(blob) :],
                "insert": head + blob + tail,
                "remove": head + tail[len(blob) :],
            }[kind]
        )
        try:
            assert isinstance(read_scene(path.parents[1]), Scene)
        except GromaError as error:
            assert str(error)
        finally:
            path.write_bytes(content)

    run()
