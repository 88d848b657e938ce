# SPDX-License-Identifier: BSD-3-Clause
"""Depth maps in files: three kinds, units, names, what is unknown, and files that are wrong or made to harm."""

import zipfile

import cv2
import numpy as np
import pycolmap
import pytest

from groma.errors import FileFormatError, GromaError, InputError
from groma.io.depth_maps import DepthMaps

SIZE = (6, 4)  # width, height
DEPTH = np.arange(1, 25, dtype=np.float64).reshape(4, 6) / 8.0


@pytest.fixture
def folder(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), np.round(1000 * DEPTH).astype(np.uint16))
    np.save(tmp_path / "b.npy", DEPTH)
    np.savez_compressed(tmp_path / "c.npz", depth=DEPTH.astype(np.float32), other=np.zeros(3))
    np.save(tmp_path / "d.npy", np.round(1000 * DEPTH).astype(np.int32))
    np.savez(tmp_path / "e.npz", DEPTH[None])
    (tmp_path / "f.jpg.geometric.bin").write_bytes(b"6&4&1&" + DEPTH.astype("<f4").tobytes())
    cv2.imwrite(str(tmp_path / "g.tiff"), DEPTH.astype(np.float32))
    return tmp_path


@pytest.mark.parametrize("name", ["a.png", "b.npy", "c.npz", "d.npy", "e.npz", "f.jpg.geometric.bin", "g.tiff"])
def test_every_kind_is_read_in_metres(folder, name):
    read = DepthMaps(folder).read(folder / name, SIZE)
    assert read.dtype == np.float32
    assert read == pytest.approx(DEPTH, abs=1e-6)


def test_maps_of_colmap_belong_to_the_whole_name_of_a_photograph(folder):
    from_colmap = pycolmap.DepthMap()
    from_colmap.read(folder / "f.jpg.geometric.bin")
    assert DepthMaps(folder).read(folder / "f.jpg.geometric.bin", SIZE) == pytest.approx(from_colmap.to_array())
    (folder / "f.jpg.photometric.bin").write_bytes(b"6&4&1&" + bytes(96))
    (folder / "h.jpg.photometric.bin").write_bytes(b"6&4&1&" + bytes(96))
    names = ["f.jpg.geometric.bin", "h.jpg.photometric.bin"]
    assert DepthMaps(folder).files(["f.jpg", "h.jpg"]) == [folder / name for name in names]


def test_maps_of_another_resolution_are_read_at_the_nearest_pixel(folder):
    """Centres of pixels: those of 12 x 8 fall in pairs on those of 6 x 4, those of 3 x 2 between pairs."""
    maps = DepthMaps(folder)
    assert maps.read(folder / "b.npy", (12, 8)) == pytest.approx(DEPTH.repeat(2, 0).repeat(2, 1))
    assert maps.read(folder / "b.npy", (3, 2)) == pytest.approx(DEPTH[1::2, 1::2])
    assert maps.read(folder / "b.npy", (61, 40)).shape == (40, 61)  # 6.1 x 4 pixels, off by less than one
    for size in ((60, 20), (6, 5), (5, 4)):
        with pytest.raises(FileFormatError, match="proportions of the photographs"):
            maps.read(folder / "b.npy", size)


def test_the_scale_is_that_of_the_files(folder):
    assert DepthMaps(folder, 5000.0).read(folder / "a.png", SIZE) == pytest.approx(DEPTH / 5.0, abs=1e-6)
    assert DepthMaps(folder, 2.0).read(folder / "b.npy", SIZE) == pytest.approx(DEPTH / 2.0)
    for wrong in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="must be positive"):
            DepthMaps(folder, wrong)


def test_what_is_unknown_is_zero(tmp_path):
    raw = np.array([[0, 65535, 7, 65534]], np.uint16)
    cv2.imwrite(str(tmp_path / "a.png"), raw)
    assert DepthMaps(tmp_path).read(tmp_path / "a.png", (4, 1)).tolist()[0] == pytest.approx([0, 0, 0.007, 65.534])
    np.save(tmp_path / "b.npy", np.array([[np.nan, -1.0, np.inf, 2.0]]))
    assert DepthMaps(tmp_path).read(tmp_path / "b.npy", (4, 1)).tolist() == [[0, 0, 0, 2.0]]


def test_maps_have_the_names_of_photographs(folder):
    maps = DepthMaps(folder)
    assert maps.files(["b.jpg", "x.jpg", "a.jpg"]) == [folder / "b.npy", None, folder / "a.png"]
    assert maps.files(["left/b.jpg", "left/c.jpg"]) == [folder / "b.npy", folder / "c.npz"]
    (folder / "left").mkdir()
    np.save(folder / "left" / "b.npy", DEPTH)
    assert maps.files(["left/b.jpg", "left/c.jpg"]) == [folder / "left" / "b.npy", None]
    np.save(folder / "a.npy", DEPTH)
    with pytest.raises(InputError, match="two depth maps"):
        maps.files(["a.jpg"])
    with pytest.raises(InputError, match=r"none of the 1 photographs; it holds .*, the first photograph is 'x.jpg'"):
        maps.files(["x.jpg"])
    (folder / "exr").mkdir()
    (folder / "exr" / "x.exr").touch()
    with pytest.raises(InputError, match=r"a kind that is not read, for example 'x.exr'. Save them as 16-bit PNG"):
        DepthMaps(folder / "exr").files(["x.jpg"])
    with pytest.raises(InputError, match="not a folder of depth maps"):
        DepthMaps(folder / "a.png").files(["a.jpg"])


def test_wrong_files_are_refused_in_one_line(folder):
    cv2.imwrite(str(folder / "grey.png"), np.ones((4, 6), np.uint8))
    cv2.imwrite(str(folder / "colour.png"), np.ones((4, 6, 3), np.uint8))
    (folder / "text.png").write_text("depth")
    (folder / "text.npy").write_text("depth")
    (folder / "cut.jpg.geometric.bin").write_bytes(b"6&4&1&" + bytes(95))
    (folder / "text.bin").write_text("depth")
    cv2.imwrite(str(folder / "grey.tif"), np.ones((4, 6), np.uint8))
    (folder / "cut.npy").write_bytes((folder / "b.npy").read_bytes()[:-8])
    np.save(folder / "stack.npy", np.zeros((2, 4, 6)))
    np.save(folder / "words.npy", np.full((4, 6), "deep"))
    np.savez(folder / "two.npz", first=DEPTH, second=DEPTH)
    for name, said in {
        "grey.png": "1 channel of 8 bits; expected a grey PNG of 16 bits",
        "colour.png": "3 channels of 8 bits",
        "text.png": "cannot be read as a PNG",
        "cut.jpg.geometric.bin": "no depth map of COLMAP, or is damaged",
        "text.bin": "no depth map of COLMAP, or is damaged",
        "grey.tif": "1 channel of 8 bits",
        "text.npy": "no header",
        "cut.npy": "needs 192 bytes but 184 follow",
        "stack.npy": r"shape \(2, 4, 6\); expected \(height, width\), \(4, 6\)",
        "words.npy": "expected numbers",
        "two.npz": "the arrays first, second; expected one",
    }.items():
        with pytest.raises(FileFormatError, match=said) as caught:
            DepthMaps(folder).read(folder / name, SIZE)
        assert "\n" not in str(caught.value)
    with pytest.raises(FileFormatError, match=r"6x4 pixels, its photograph 4x6\. It is turned by 90 degrees"):
        DepthMaps(folder).read(folder / "b.npy", (4, 6))
    with pytest.raises(InputError, match="Cannot read"):
        DepthMaps(folder).read(folder / "nowhere.npy", SIZE)


def test_nothing_is_expanded_that_has_another_size(tmp_path):
    """A header that asks for much, and zeros that shrink to nothing: refused before memory is taken."""
    with (
        zipfile.ZipFile(tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED) as file,
        file.open("depth.npy", "w") as member,
    ):
        np.lib.format.write_array_header_1_0(
            member, {"descr": "<f4", "fortran_order": False, "shape": (1 << 15, 1 << 14)}
        )
        for _ in range(64):
            member.write(bytes(1 << 20))
    with open(tmp_path / "liar.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": "<f8", "fortran_order": False, "shape": (1 << 30, 1 << 10)}
        )
    for name in ("bomb.npz", "liar.npy"):
        with pytest.raises(GromaError, match=r"pixels, its photograph 6x4|far more than an archive"):
            DepthMaps(tmp_path).read(tmp_path / name, SIZE)
