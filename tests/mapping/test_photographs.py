# SPDX-License-Identifier: BSD-3-Clause
"""Photographs as they are stored: kinds of files, damaged ones, names that differ from the model's."""

import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from groma.errors import InputError
from groma.io.colmap.masks import Masks
from groma.io.sequences.images import images_in
from groma.localization.map_images import image_paths
from groma.mapping.photographs import (
    check_names,
    copies_among,
    copies_left_out,
    image_files,
    other_images,
    read_gray,
    smaller_copies,
)


def test_every_kind_of_image_is_read_as_it_is_stored(tmp_path):
    grey = (np.indices((24, 32)).sum(0) * 4).astype(np.uint8)
    colour = np.dstack([grey, grey, grey])
    kinds = {
        "a.png": grey,
        "b.jpg": colour,
        "c12.png": np.round(grey * (4095 / 255)).astype(np.uint16),
        "c16.png": grey.astype(np.uint16) * 257,
        "d16.tif": colour.astype(np.uint16) * 257,
        "e float.tif": colour.astype(np.float32) / 255,
        "f.bmp": colour,
        "größe.png": np.dstack([colour, grey]),
    }
    for name, image in kinds.items():
        content = cv2.imencode(os.path.splitext(name)[1], image)[1].tobytes()
        if name == "b.jpg":  # EXIF: turned by 90 degrees
            exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
            content = content[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + content[2:]
        (tmp_path / name).write_bytes(content)
    (tmp_path / "._a.png").write_bytes(b"a shadow file")
    files = image_files(tmp_path)
    assert [path.name for path in files] == sorted(kinds)
    for path in files:
        assert np.abs(read_gray(path).astype(int) - grey).max() <= 4, path.name


def test_folders_are_looked_into_unless_they_are_hidden(tmp_path):
    for name in ("b/c/2.JPG", "b/1.jpg", "a.png", ".thumbnails/a.png", "b/.trash/deep/3.jpg", "b/.jpg", "b/notes.txt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "folder.png").mkdir()
    assert [path.relative_to(tmp_path).as_posix() for path in image_files(tmp_path)] == [
        "a.png",
        "b/1.jpg",
        "b/c/2.JPG",
    ]


def test_links_to_folders_are_followed_once(tmp_path):
    """A link to what is there anyway adds nothing, nor does one to the folder itself, or above it."""
    for name in ("photos/a/1.png", "elsewhere/2.png", "elsewhere/deep/3.png"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    photos = tmp_path / "photos"
    for link, target in (("rgb", "elsewhere"), ("0", "photos/a"), ("again", "photos"), ("up", ".")):
        (photos / link).symlink_to(tmp_path / target)
    (tmp_path / "elsewhere/back").symlink_to(photos)
    found = [path.relative_to(photos).as_posix() for path in image_files(photos)]
    assert found == ["a/1.png", "rgb/2.png", "rgb/deep/3.png"]
    assert image_paths(["2.png"], photos) == [photos / "rgb/2.png"]


def test_copies_are_no_further_photographs(tmp_path):
    files = {"a (1).jpg": b"one", "a.jpg": b"one", "b/a.jpg": b"one", "b.jpg": b"two", "c.jpg": b"three"}
    for name, content in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(content)
    copies = copies_among(tmp_path, [*files, "missing.jpg"])
    assert copies == {"a (1).jpg": "a.jpg", "b/a.jpg": "a.jpg"}
    said = "2 of 5 images are copies of others and were not used: a (1).jpg of a.jpg, b/a.jpg of a.jpg."
    assert copies_left_out(copies, 5) == [said] and copies_left_out({}, 5) == []


def test_one_photograph_in_several_sizes_is_one(tmp_path, corner):
    """Its copies are known by their edges: however they were made smaller, saved, or made brighter."""
    images, _ = corner
    files = sorted(images.iterdir())
    first, second = (cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in files[:2])
    shifted = cv2.warpAffine(
        first, np.array([[1.0, 0, 2], [0, 1, 0]]), first.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )

    def made(name, image, size, way, quality=90):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        small = cv2.resize(image, size, interpolation=way)
        cv2.imwrite(str(tmp_path / name), small, [cv2.IMWRITE_JPEG_QUALITY, quality] if name.endswith("jpg") else [])

    for name, image in {"a.png": first, "b.png": second}.items():
        cv2.imwrite(str(tmp_path / name), image)
    made("half/a.jpg", first, (240, 180), cv2.INTER_AREA)
    made("quarter/b.jpg", second, (120, 90), cv2.INTER_LANCZOS4, 60)
    made("third/b.png", np.uint8(255 * (second / 255.0) ** 0.7), (161, 121), cv2.INTER_CUBIC)
    made("moved.png", shifted, (240, 180), cv2.INTER_AREA)  # by a pixel
    made("stretched.png", first, (240, 200), cv2.INTER_AREA)
    cv2.imwrite(str(tmp_path / "again.jpg"), first, [cv2.IMWRITE_JPEG_QUALITY, 90])  # of the same size
    sizes = {
        path.relative_to(tmp_path).as_posix(): cv2.imread(str(path), 0).shape[::-1] for path in image_files(tmp_path)
    }
    copies = {"half/a.jpg": "a.png", "quarter/b.jpg": "b.png", "third/b.png": "b.png"}
    assert smaller_copies(tmp_path, sizes) == copies
    assert smaller_copies(tmp_path, {"a.png": sizes["a.png"], "b.png": sizes["b.png"]}) == {}


def test_photographs_that_are_not_read_are_told(tmp_path):
    """Telephones write HEIC; a raw file beside its JPEG is no further photograph."""
    for name in ("a.HEIC", "b.heic"):
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(InputError, match=r"2 photographs of a kind that is not read: a.HEIC, b.heic. Convert them"):
        image_files(tmp_path)
    for name in ("c.jpg", "c.dng", "d.JPG"):
        (tmp_path / name).write_bytes(b"")
    names = [path.name for path in image_files(tmp_path)]
    assert names == ["c.jpg", "d.JPG"]
    said = "2 photographs of a kind that is not read: a.HEIC, b.heic. Convert them to JPEG or PNG."
    assert other_images(tmp_path, names) == [said] and other_images(tmp_path, ["a.jpg", "b.jpg", "c.jpg"]) == []


def test_masks_beside_photographs_are_no_photographs(tmp_path):
    masks = ["a_mask.png", "b/c.jpg.png"]
    for name in ("a.jpg", "b/c.jpg", "the_mask.png", "d.png", *masks):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    names = [path.relative_to(tmp_path).as_posix() for path in image_files(tmp_path)]
    assert names == ["a.jpg", "b/c.jpg", "d.png", "the_mask.png"]
    said = f"2 images beside photographs are not mapped, but taken for their masks ({', '.join(masks)})"
    assert other_images(tmp_path, names) == [f"{said}; --masks {tmp_path} uses them."]
    # as masks they are found where they are, and no photograph is its own
    assert Masks.of(tmp_path, names).file_of == {"a.jpg": tmp_path / masks[0], "b/c.jpg": tmp_path / masks[1]}
    assert images_in(tmp_path) == [tmp_path / name for name in ("a.jpg", "d.png", "the_mask.png")]


def test_the_whole_disk_is_no_folder_of_images(monkeypatch):
    monkeypatch.setattr(os, "walk", None)  # it is not even looked at
    with pytest.raises(InputError, match=r"is the whole disk, .* Pass the folder that holds the photographs"):
        image_files(Path(Path.cwd().anchor))


@pytest.mark.skipif(os.name == "nt" or os.uname().sysname == "Darwin", reason="such names cannot be made")
@pytest.mark.parametrize("name", [b"bad\xff.png", b"two\nlines.png", b"in\x1b/a.png"])
def test_names_that_are_no_text_are_refused(tmp_path, name):
    path = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + name))
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(b"")
    with pytest.raises(InputError, match=r"cannot stand in a model: it must be UTF-8, in one line. Rename it") as told:
        image_files(tmp_path)
    str(told.value).encode()  # can be printed


def test_a_jpeg_that_ends_too_early_is_refused(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (80, 90), dtype=np.uint8)
    content = cv2.imencode(".jpg", noise)[1].tobytes()
    (tmp_path / "a.jpg").write_bytes(content + b"some camera's appendix")
    assert read_gray(tmp_path / "a.jpg").shape == (80, 90)
    (tmp_path / "a.jpg").write_bytes(content[: len(content) // 2])
    with pytest.raises(InputError, match="ends in the middle of the picture"):
        read_gray(tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("rename", "said"),
    [
        (lambda name: f"left/{name}", r"Pass the folder photos/left\."),
        (lambda name: name.upper(), "upper and lower case"),
        (lambda name: name.rsplit(".", 1)[0] + ".webp", "of another kind"),
        (lambda name: "other" + name, "names must match"),
    ],
)
def test_names_that_differ_are_compared_with_the_models(model, rename, said):
    model = model.replace(
        images=type(model.images)(**{**vars(model.images), "names": ("a.jpg", "b.jpg", "c.jpg", "d.jpg")})
    )
    with pytest.raises(InputError, match=said):
        check_names(Path("photos"), [rename(name) for name in model.images.names], model)


def test_the_models_folder_is_named(model):
    model = model.replace(images=type(model.images)(**{**vars(model.images), "names": ("p/a", "p/b", "p/c", "p/d")}))
    with pytest.raises(InputError, match=r"Pass the folder .*home\."):
        check_names(Path("/home/p"), ["a", "b", "c", "d"], model)
    with pytest.raises(InputError, match="begin with 'p'"):
        check_names(Path("/home/q"), ["a", "b", "c", "d"], model)
