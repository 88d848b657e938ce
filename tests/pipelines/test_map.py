# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to a map: what is refused, going on after a kill, line matches from elsewhere, real photographs."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from _facade import facade

from groma.errors import InputError, OutputError
from groma.evaluation.poses import evaluate_poses
from groma.frontend.external import ExternalMatches
from groma.frontend.lsd import LsdDetector
from groma.frontend.matches import LineMatches
from groma.io import read_scene, write_scene
from groma.pipelines import map as mapping
from groma.pipelines._photographs import check_names, image_files, read_gray
from groma.pipelines._stages import Stages, digest, has_stages, remove_stages
from groma.pipelines.map import MapOptions, map_images
from groma.scene import compare
from groma.scene.synthetic import holistic


@pytest.fixture
def model():
    return holistic(4, seed=0).start.points_only()


@pytest.fixture(scope="module")
def corner(tmp_path_factory):
    """A folder with the photographs of a house corner, and their model."""
    folder = tmp_path_factory.mktemp("corner") / "images"
    scene = facade(folder, 4)
    write_scene(scene, folder.parent / "model.npz")
    return folder, scene


def write_images(folder, scene, shape=(768, 1024), value=0):
    folder.mkdir()
    for name in scene.images.names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.full(shape, value, np.uint8))
    return folder


def test_bad_input_is_refused_in_one_sentence(tmp_path, model):
    with pytest.raises(InputError, match="not a folder"):
        map_images(tmp_path / "nowhere", tmp_path / "work", model)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no images"):
        map_images(tmp_path / "empty", tmp_path / "work", model)
    cv2.imwrite(str(tmp_path / "empty" / "a.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(InputError, match="are not in"):
        map_images(tmp_path / "empty", tmp_path / "work", model)
    with pytest.raises(InputError, match="holds 1 image; a map needs at least 3"):
        map_images(tmp_path / "empty", tmp_path / "work")
    with pytest.raises(InputError, match="has 1 image with a pose"):
        map_images(tmp_path / "empty", tmp_path / "work", model.subset([0]))
    assert not (tmp_path / "work").exists()


def test_wrong_size_and_unreadable_images_are_refused(tmp_path, model):
    folder = write_images(tmp_path / "small", model, (100, 100))
    with pytest.raises(InputError, match=r"100x100 pixels, its camera 1024x768"):
        map_images(folder, tmp_path / "work", model)
    (folder / model.images.names[0]).write_bytes(b"not an image")
    for given in (model, None):
        with pytest.raises(InputError, match="cannot be read as an image"):
            map_images(folder, tmp_path / "work", given)
    turned = write_images(tmp_path / "turned", model, (1024, 768))
    with pytest.raises(InputError, match="turned by 90 degrees"):
        map_images(turned, tmp_path / "work", model)
    assert not (tmp_path / "work").exists()


@pytest.mark.parametrize("value", [0, 130])
def test_images_of_one_colour_give_an_explained_empty_map(tmp_path, model, value):
    folder = write_images(tmp_path / "plain", model, value=value)
    result = map_images(folder, tmp_path / "work", model)
    assert result.scene.num_lines == 0
    assert any("No line was mapped" in sentence for sentence in result.warnings)


def test_images_of_one_colour_without_a_model(tmp_path, model):
    folder = write_images(tmp_path / "plain", model, (60, 80))
    with pytest.raises(InputError, match="0 points were found in them and 0 matches between them"):
        map_images(folder, tmp_path / "work")


def test_every_kind_of_image_is_read_as_it_is_stored(tmp_path):
    grey = (np.indices((24, 32)).sum(0) * 4).astype(np.uint8)
    colour = np.dstack([grey, grey, grey])
    kinds = {
        "a.png": grey,
        "b.jpg": colour,
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


# ---------------------------------------------------------------------------------------------------- finished stages


def test_stages_are_made_once_and_again_when_something_before_them_changes(tmp_path, model):
    made = []

    def make(name):
        return lambda: made.append(name) or model

    for options in (1, 1, 2, 1):
        with Stages(tmp_path / "work", digest("input")) as store:
            assert compare.equal(store.scene("a", make("a")), model)
            store.scene("b", make("b"), options)
            store.scene("c", make("c"))
    assert made == ["a", "b", "c", "b", "c", "b", "c"]
    with Stages(tmp_path / "work", digest("other input")) as store:
        store.scene("a", make("a"))
    assert made[7:] == ["a"]
    (damaged,) = (tmp_path / "work").glob("a-*.npz")
    damaged.write_bytes(b"PK")
    with Stages(tmp_path / "work", digest("other input")) as store:
        assert compare.equal(store.scene("a", make("a")), model)
    assert made[7:] == ["a", "a"]


def test_two_runs_in_one_folder_are_refused(tmp_path):
    with Stages(tmp_path / "work", "key"):
        with (
            pytest.raises(OutputError, match=rf"Another run \(process {os.getpid()}\) works in"),
            Stages(tmp_path / "work", "key"),
        ):
            pass
        remove_stages(tmp_path / "work")
        assert (tmp_path / "work").exists()
    with Stages(tmp_path / "work", "key"):
        pass
    assert not has_stages(tmp_path / "work")
    remove_stages(tmp_path / "work")
    assert not (tmp_path / "work").exists()


def test_a_place_that_cannot_be_written_is_said(tmp_path, model, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="Cannot keep finished stages in"), Stages(tmp_path / "file", "key"):
        pass

    def full(scene, path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("groma.pipelines._stages.write_archive", full)
    with Stages(tmp_path / "work", "key") as store, pytest.raises(OutputError, match=r"No space left.*Make room"):
        store.scene("points", lambda: model)


#: Maps, and kills itself at the given event: an event is a progress call, or a rename of a finished file.
KILLED = """
import os, signal, sys
import groma
from groma.io import read_scene, write_scene
from groma.pipelines.map import MapOptions, map_images

images, model, work, out, left = *sys.argv[1:5], int(sys.argv[5])
replace = os.replace

def event(*_):
    global left
    left -= 1
    if left == 0:
        os.kill(os.getpid(), signal.SIGKILL)

def renamed(source, target):
    mine = str(target).startswith(work)
    event() if mine else None
    replace(source, target)
    event() if mine else None

os.replace = renamed
result = map_images(images, work, read_scene(model), MapOptions(threads=1), event)
os.replace = replace
write_scene(result.scene, out)
"""


@pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")
def test_a_run_killed_again_and_again_ends_like_an_undisturbed_one(tmp_path, corner):
    images, _ = corner
    arguments = [sys.executable, "-c", KILLED, str(images), str(images.parent / "model.npz")]
    subprocess.run([*arguments, str(tmp_path / "calm"), str(tmp_path / "calm.npz"), "-1"], check=True, timeout=600)
    rng, kills = np.random.default_rng(3), 0
    while True:
        left = str(int(rng.integers(25, 75)))
        done = subprocess.run([*arguments, str(tmp_path / "work"), str(tmp_path / "out.npz"), left], timeout=600)
        if done.returncode == 0:
            break
        assert done.returncode == -signal.SIGKILL
        kills += 1
        assert kills < 30
    assert kills >= 2
    assert (tmp_path / "out.npz").read_bytes() == (tmp_path / "calm.npz").read_bytes()
    assert read_scene(tmp_path / "out.npz").num_lines > 20


# --------------------------------------------------------------------------------------------- matches from elsewhere


def test_line_matches_from_elsewhere(tmp_path, corner):
    images, scene = corner
    names = scene.images.names
    found = [LsdDetector(min_length=12.0).detect(read_gray(images / name)) for name in names]
    everything = {}
    for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
        grid = np.meshgrid(np.arange(len(found[i])), np.arange(len(found[j])))
        pairs = np.stack(grid, axis=-1).reshape(-1, 2)
        everything[names[i], names[j]] = LineMatches(pairs, np.ones(len(pairs)))
    segments = {name: item.ends for name, item in zip(names, found, strict=True)}
    options = MapOptions(find_planes=False)
    result = map_images(images, tmp_path / "a", scene, options, line_matches=ExternalMatches(segments, everything))
    assert result.scene.num_lines > 20
    none = map_images(images, tmp_path / "a", scene, options, line_matches=ExternalMatches(segments, {}))
    assert none.scene.num_lines == 0
    with pytest.raises(InputError, match="do not hold them"):
        map_images(
            images, tmp_path / "b", scene, options, line_matches=ExternalMatches({names[0]: found[0].ends}, everything)
        )
    with pytest.raises(InputError, match="of no image of the model"):
        map_images(images, tmp_path / "b", scene, options, line_matches=ExternalMatches({"x": found[0].ends}, {}))


# ------------------------------------------------------------------------------------------------------------ real data
@pytest.mark.shared
def test_church_front(shared_data, tmp_path, monkeypatch):
    """More lines than LIMAP finds there (242, 169 of them in four images), and poses no worse than the model's."""
    folder = shared_data / "strecha_herz_jesus_p8"
    start, reference = read_scene(folder / "sparse_inc"), read_scene(folder / "sparse_gt")
    result = map_images(folder / "images", tmp_path / "work", start, MapOptions())
    scene = result.scene
    seen = [
        len(np.unique(scene.line_observations.image_idx[scene.line_observations.line_idx == line]))
        for line in range(scene.num_lines)
    ]
    assert scene.num_lines >= 500
    assert sum(count >= 4 for count in seen) >= 400
    assert scene.num_planes >= 1
    assert evaluate_poses(scene, reference).rotation_deg_mean <= evaluate_poses(start, reference).rotation_deg_mean
    # a second call goes on from what is finished: no image is searched again, and the result is the same
    monkeypatch.setattr(mapping, "detect_segments", lambda *arguments: pytest.fail("segments were searched again"))
    again = map_images(folder / "images", tmp_path / "work", start, MapOptions())
    np.testing.assert_array_equal(again.scene.lines.plucker, scene.lines.plucker)
    np.testing.assert_array_equal(again.scene.frames.rig_from_world, scene.frames.rig_from_world)
