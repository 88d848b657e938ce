# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to a map: what is refused, going on after a kill, line matches from elsewhere, real photographs."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import _comparison as compare
import cv2
import numpy as np
import pytest
from _facade import facade

from groma.cli.main import run
from groma.errors import InputError, OutputError
from groma.evaluation.poses import evaluate_poses
from groma.features.external import ExternalMatches, write_matches
from groma.features.lsd import LsdDetector
from groma.features.matches import LineMatches
from groma.io import read_scene, write_scene
from groma.io.colmap.sfm import PointModelOptions, reconstruct_points
from groma.mapping import map as mapping
from groma.mapping.checkpoint_files import SCENE
from groma.mapping.checkpoints import Stages, digest, has_stages, remove_stages, stage
from groma.mapping.map import MapOptions, map_images
from groma.mapping.photographs import check_names, image_files, read_gray
from groma.scene import Planes, PointObservations, Points
from groma.scene.synthetic.scenes import holistic


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
    with pytest.raises(InputError, match=r"None of the .* images of the model is in"):
        map_images(tmp_path / "empty", tmp_path / "work", model)
    with pytest.raises(InputError, match="holds 1 image; a map needs at least 3"):
        map_images(tmp_path / "empty", tmp_path / "work")
    with pytest.raises(InputError, match="has 1 image with a pose"):
        map_images(tmp_path / "empty", tmp_path / "work", model.subset([0]))
    blind = model.replace(points=Points(), point_observations=PointObservations())
    with pytest.raises(InputError, match="has no points that its images observe"):
        map_images(tmp_path / "empty", tmp_path / "work", blind)
    for wrong, said in (("NOPE", r"one of SIMPLE_PINHOLE, .*got 'NOPE'"), ("BAL", "got 'BAL'")):
        with pytest.raises(InputError, match=said):
            PointModelOptions(wrong)
    with pytest.raises(InputError, match=r"4 parameters \(fx, fy, cx, cy\); got 2"):
        PointModelOptions("PINHOLE", (1.0, 2.0))
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

    def make(name, depends=lambda options: None):
        return stage(name, SCENE, depends)(lambda scene, options, say: made.append(name) or scene)

    for options in (1, 1, 2, 1):
        with Stages(tmp_path / "work", digest("input"), options) as stages:
            assert compare.equal(stages.run(make("a"), model), model)
            stages.run(make("b", lambda options: options), model)
            stages.run(make("c"), model)
    assert made == ["a", "b", "c", "b", "c", "b", "c"]
    with Stages(tmp_path / "work", digest("other input"), 1) as stages:
        stages.run(make("a"), model)
    assert made[7:] == ["a"]
    (damaged,) = (tmp_path / "work").glob("a-*.npz")
    damaged.write_bytes(b"PK")
    with Stages(tmp_path / "work", digest("other input"), 1) as stages:
        assert compare.equal(stages.run(make("a"), model), model)
    assert made[7:] == ["a", "a"]


def test_two_runs_in_one_folder_are_refused(tmp_path):
    with Stages(tmp_path / "work", "key", None):
        with (
            pytest.raises(OutputError, match=rf"Another run \(process {os.getpid()}\) works in"),
            Stages(tmp_path / "work", "key", None),
        ):
            pass
        remove_stages(tmp_path / "work")
        assert (tmp_path / "work").exists()
    with Stages(tmp_path / "work", "key", None):
        pass
    assert not has_stages(tmp_path / "work")
    remove_stages(tmp_path / "work")
    assert not (tmp_path / "work").exists()


def test_the_lock_is_found_before_anything_is_said(tmp_path, corner, monkeypatch, capsys):
    images, _ = corner
    monkeypatch.chdir(tmp_path)
    command = ["map", str(images), "-o", "out", "--model", str(images.parent / "model.npz")]
    with Stages(tmp_path / "out.work", "key", None):
        (tmp_path / "out.work" / "points-0123456789ab.npz").write_text("of the other run")
        assert run(command) == 1
    said = capsys.readouterr()
    assert said.out == "" and said.err.count("\n") == 1
    assert said.err.startswith(f"groma: Another run (process {os.getpid()}) works in out.work. Wait")


def test_a_place_that_cannot_be_written_is_said(tmp_path, model, monkeypatch):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="Cannot keep finished stages in"), Stages(tmp_path / "file", "key", None):
        pass

    def full(scene, path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("groma.mapping.checkpoint_files.write_archive", full)
    with (
        Stages(tmp_path / "work", "key", None) as stages,
        pytest.raises(OutputError, match=r"No space left.*Make room"),
    ):
        stages.run(stage("points", SCENE)(lambda *_: model))


def test_a_full_disk_ends_the_command_in_one_line_and_loses_nothing(tmp_path, corner, monkeypatch, capsys):
    images, _ = corner
    monkeypatch.chdir(tmp_path)
    command = ["map", str(images), "-o", "out", "--threads", "1"]
    usage = shutil.disk_usage(tmp_path)
    with monkeypatch.context() as patch:  # before points are looked for
        patch.setattr(shutil, "disk_usage", lambda folder: usage._replace(free=9 << 20))
        assert run(command) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "9 MiB left; the points of the images need 12 MiB. Make room" in error

    def full(*_, **__):
        raise OSError(28, "No space left on device", "a draft")

    command += ["--model", str(images.parent / "model.npz"), "--no-planes"]
    with monkeypatch.context() as patch:  # while the results are written
        patch.setattr("groma.mapping.result.write_report", full)
        assert run(command) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Cannot write out: No space left on device. Finished stages are kept in out.work: the same" in error
    assert not Path("out").exists() and has_stages(Path("out.work"))
    monkeypatch.setattr(mapping, "detect_segments", lambda *arguments: pytest.fail("segments were searched again"))
    assert run(command) == 0
    assert capsys.readouterr().out.startswith("Going on from the finished stages in out.work")
    assert os.listdir(tmp_path) == ["out"]


def test_a_model_with_two_images_of_one_name_is_refused(tmp_path, model):
    names = list(model.images.names)
    names[1] = names[0]
    twice = model.replace(images=model.images.replace(names=tuple(names)))
    with pytest.raises(InputError, match=f"more than one image named {names[0]!r}"):
        check_names(tmp_path, sorted(set(names)), twice)


def test_a_damaged_database_of_points_is_made_again(tmp_path, corner):
    """Here with images of which no two show the same: what is said is that of a fresh run."""
    _, scene = corner
    (tmp_path / "work").mkdir()
    (tmp_path / "work" / "database.db").write_bytes(b"no database" * 999)
    rng = np.random.default_rng(0)
    for name in scene.images.names:
        cv2.imwrite(str(tmp_path / name), cv2.GaussianBlur(rng.integers(0, 255, (90, 120), dtype=np.uint8), None, 2.0))
    with pytest.raises(InputError, match=r"[1-9]\d* points were found in them and 0 matches.*overlap too little"):
        reconstruct_points(tmp_path, tmp_path / "work", scene.images.names, PointModelOptions(threads=1))


#: Maps, and kills itself at an event: a stage of the progress, with how much of it is done, or a finished file of a
#: stage just before or just after it gets its name. Says which.
KILLED = """
import os, signal, sys
from groma.io import read_scene, write_scene
from groma.mapping.map import MapOptions, map_images

images, model, work, out, when = sys.argv[1:]

def event(*what):
    if " ".join(map(str, what)) == when:
        os.kill(os.getpid(), signal.SIGKILL)

replace = os.replace

def renamed(source, target):
    name = os.path.basename(str(target)).rpartition("-")[0] if str(target).startswith(work) else ""
    event("before", name)
    replace(source, target)
    event("after", name)

os.replace = renamed
result = map_images(
    images, work, None if model == "none" else read_scene(model), MapOptions(threads=1), lambda s, n, m: event(s, n)
)
os.replace = replace
write_scene(result.scene, out)
"""

posix = pytest.mark.skipif(os.name == "nt", reason="signals of POSIX systems")


@posix
def test_a_run_killed_at_every_kind_of_moment_ends_like_an_undisturbed_one(tmp_path, corner):
    images, _ = corner
    arguments = [sys.executable, "-c", KILLED, str(images), str(images.parent / "model.npz")]
    subprocess.run([*arguments, str(tmp_path / "calm"), str(tmp_path / "calm.npz"), "never"], check=True, timeout=300)
    work = tmp_path / "work"
    moments = {
        "before points": {"model"},
        "finding segments 2": {"model", "points"},
        "after lines": {"model", "points", "segments", "lines"},
        "before structure": {"model", "points", "segments", "lines", "joint", "final-lines"},
        "after adjusted": {"model", "points", "segments", "lines", "joint", "final-lines", "structure", "adjusted"},
    }
    for when, kept in moments.items():
        done = subprocess.run([*arguments, str(work), str(tmp_path / "out.npz"), when], timeout=300)
        assert done.returncode == -signal.SIGKILL, when
        assert {path.name.rpartition("-")[0] for path in work.glob("[!.]*.npz")} == kept, when
    subprocess.run([*arguments, str(work), str(tmp_path / "out.npz"), "never"], check=True, timeout=300)
    assert not list(work.glob(".*"))  # what killed runs left half written
    assert (tmp_path / "out.npz").read_bytes() == (tmp_path / "calm.npz").read_bytes()
    assert read_scene(tmp_path / "out.npz").num_lines > 20


def test_lines_are_mapped_again_while_the_poses_move(tmp_path, corner, monkeypatch):
    images, scene = corner
    moved = [0.2, 0.1, 0.2]
    monkeypatch.setattr(mapping, "moved_px", lambda *_: moved.pop(0))
    result = map_images(images, tmp_path / "work", scene, MapOptions(find_planes=False, threads=1))
    assert moved == [0.2]
    stages = {path.name.rpartition("-")[0] for path in (tmp_path / "work").glob("*.npz")}
    assert {"joint", "final-lines", "joint-2", "final-lines-2"} <= stages
    assert "joint-3" not in stages
    assert result.scene.num_lines > 20


@posix
@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("given", [True, False], ids=["model", "no model"])
def test_a_run_killed_again_and_again_ends_like_an_undisturbed_one(tmp_path, corner, given):
    """Killed at any time, while pycolmap works and while functions are compiled, whose cache begins empty."""
    images, _ = corner
    model = str(images.parent / "model.npz") if given else "none"
    arguments = [sys.executable, "-c", KILLED, str(images), model]
    subprocess.run([*arguments, str(tmp_path / "calm"), str(tmp_path / "calm.npz"), "never"], check=True)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    rng, patience, kills = np.random.default_rng(3), 4.0, 0
    while True:
        process = subprocess.Popen(
            [*arguments, str(tmp_path / "work"), str(tmp_path / "out.npz"), "never"], env=environment
        )
        try:
            assert process.wait(rng.uniform(1.0, patience)) == 0
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        kills += 1
        patience *= 1.1  # one function may take long to compile
    assert kills >= 3
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
    # a finished map as the model: what it held besides points is not carried over
    flat = result.scene.replace(planes=Planes([1], [[0.0, 0.0, 1.0, 0.0]]))
    none = map_images(images, tmp_path / "a", flat, options, line_matches=ExternalMatches(segments, {}))
    assert none.scene.num_lines == none.start.num_lines == none.scene.num_planes == 0
    with pytest.raises(InputError, match="do not hold them"):
        map_images(
            images, tmp_path / "b", scene, options, line_matches=ExternalMatches({names[0]: found[0].ends}, everything)
        )
    with pytest.raises(InputError, match="of no image of the model"):
        map_images(images, tmp_path / "b", scene, options, line_matches=ExternalMatches({"x": found[0].ends}, {}))


def test_line_matches_from_a_file_through_the_command(tmp_path, corner, monkeypatch, capsys):
    """Only what the file holds is mapped: two walls' worth of segments in, none found by the detector."""
    images, scene = corner
    names = scene.images.names
    found = [LsdDetector(min_length=25.0).detect(read_gray(images / name)) for name in names]
    pairs = {}
    for i, j in zip(*np.triu_indices(len(names), 1), strict=True):
        grid = np.stack(np.meshgrid(np.arange(len(found[i])), np.arange(len(found[j]))), axis=-1).reshape(-1, 2)
        pairs[names[j], names[i]] = LineMatches(grid[:, ::-1], np.ones(len(grid)))  # the other order is right, too
    segments = {name: item.ends for name, item in zip(names, found, strict=True)}
    monkeypatch.chdir(tmp_path)
    write_matches("matches.npz", ExternalMatches(segments, pairs))
    command = ["map", str(images), "--model", str(images.parent / "model.npz"), "--no-planes", "--threads", "1", "-o"]
    assert run([*command, "out", "--line-matches", "matches.npz", "--json", "-"]) == 0
    numbers = json.loads(capsys.readouterr().out)
    mapped = read_scene("out/scene.npz")
    assert numbers["num_lines"] == mapped.num_lines > 10
    assert sum(numbers["segments"].values()) == sum(len(item) for item in found)
    ends = np.concatenate([item.ends for item in found])
    for segment in mapped.line_observations.segment[:20]:
        either = [np.abs(ends - given).max(1).min() for given in (segment, segment[[2, 3, 0, 1]])]
        assert min(either) < 1e-9
    assert sorted(path.name for path in tmp_path.iterdir()) == ["matches.npz", "out"]
    # one line, and nothing left, where the file does not fit
    for content, said in (
        ({"segments|other.png": found[0].ends}, "Names must match"),
        ({"segments|" + names[0]: found[0].ends[:, :3]}, r"must be finite numbers of shape (N, 4)"),
        ({"lines": found[0].ends}, "is none of segments|IMAGE"),
        (
            {
                f"segments|{names[0]}": found[0].ends,
                f"segments|{names[1]}": found[1].ends,
                f"matches|{names[0]}|{names[1]}": np.array([[0, 9999]]),
            },
            "9999",
        ),
    ):
        np.savez("wrong.npz", **content)
        assert run([*command, "none", "--line-matches", "wrong.npz"]) == 1
        error = capsys.readouterr().err
        assert said in error and error.count("\n") == 1 and "Traceback" not in error
        assert not (tmp_path / "none").exists()


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


def test_the_command_is_one_call(tmp_path, corner, monkeypatch):
    """The same files byte by byte; pages and summaries apart from times."""
    images, model = corner
    monkeypatch.chdir(tmp_path)
    result = map_images(images, "work", model, MapOptions(find_planes=False))
    numbers = result.summary(result.diagnose())
    result.write("called", images, "Map of images", summary=numbers)
    command = ["map", str(images), "-o", "commanded", "--model", str(images.parent / "model.npz"), "--no-planes"]
    assert run([*command, "--quiet"]) == 0
    names = sorted(path.relative_to("called") for path in Path("called").rglob("*") if path.is_file())
    assert names == sorted(path.relative_to("commanded") for path in Path("commanded").rglob("*") if path.is_file())
    assert {"scene.npz", "lines.ply", "report.html", "summary.json"} <= {name.as_posix() for name in names}
    for name in names:
        if name.suffix not in (".html", ".json"):
            assert ("called" / name).read_bytes() == ("commanded" / name).read_bytes(), name
    ours, theirs = (json.loads((Path(folder) / "summary.json").read_text()) for folder in ("called", "commanded"))
    assert list(ours) == list(theirs) and ours["diagnosis"]["sentences"]
    assert ours["diagnosis"].pop("seconds") and theirs["diagnosis"].pop("seconds")
    assert [name for name in ours if ours[name] != theirs[name]] == ["seconds", "history"]
    with pytest.raises(OutputError, match="exists already"):
        result.write("called")
    result.write("called", force=True)
    assert json.loads(Path("called/summary.json").read_text())["diagnosis"] is None


def test_a_map_that_did_not_converge_says_so_and_given_cameras_change(tmp_path, corner, monkeypatch, capsys):
    """One step of each adjustment is too few; the cameras of the model come out in the model that was asked for."""
    images, model = corner
    monkeypatch.chdir(tmp_path)
    command = ["map", str(images), "-o", "map", "--model", str(images.parent / "model.npz"), "--no-planes"]
    assert run([*command, "--max-iterations", "1", "--camera-model", "OPENCV", "--no-diagnosis"]) == 0
    said = capsys.readouterr()
    assert "warning: Not converged after 1 step" in said.err
    numbers = json.loads(Path("map/summary.json").read_text())
    assert not numbers["converged"] and any(text.startswith("Not converged") for text in numbers["warnings"])
    assert set(read_scene("map/scene.npz").cameras.models) == {"OPENCV"} != set(model.cameras.models)
    with_params = [*command, "--camera-params", "1,2,3", "--force"]
    assert run(with_params) == 1 and "--camera-params is for images without a model" in capsys.readouterr().err
