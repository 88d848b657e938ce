# SPDX-License-Identifier: BSD-3-Clause
"""From photographs to a map: what is refused, line matches from elsewhere, real photographs, the command."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from groma.adjustment.terms.principal_points import near_the_middle
from groma.cli.main import run
from groma.errors import InputError, OutputError
from groma.evaluation.poses import evaluate_poses
from groma.features.external import ExternalMatches, write_matches
from groma.features.lsd import LsdDetector
from groma.features.matches import LineMatches
from groma.io import read_scene, write_scene
from groma.io.colmap.sfm import PointModelOptions
from groma.mapping import map as mapping
from groma.mapping.map import map_images
from groma.mapping.options import MapOptions
from groma.mapping.photographs import check_names, read_gray
from groma.scene import Planes, PointObservations, Points, PrincipalPointPriors
from groma.scene.synthetic.scenes import holistic


def write_images(folder, scene, shape=(768, 1024), value=0):
    folder.mkdir()
    for number, name in enumerate(scene.images.names):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), np.full(shape, value, np.uint8))
        with (folder / name).open("ab") as file:
            file.write(bytes([number]))  # no copies of each other
    return folder


def test_bad_input_is_refused_in_one_sentence(tmp_path, model):
    with pytest.raises(InputError, match="not a folder"):
        map_images(tmp_path / "nowhere", tmp_path / "work", model)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no images"):
        map_images(tmp_path / "empty", tmp_path / "work", model)
    write_scene(model, tmp_path / "model")
    with pytest.raises(InputError, match="holds a model, but no images"):
        map_images(tmp_path / "model", tmp_path / "work")
    cv2.imwrite(str(tmp_path / "empty" / "a.png"), np.zeros((10, 10), np.uint8))
    with pytest.raises(InputError, match=r"None of the .* images of the model is in"):
        map_images(tmp_path / "empty", tmp_path / "work", model)
    with pytest.raises(InputError, match="holds 1 image; a map needs at least 3"):
        map_images(tmp_path / "empty", tmp_path / "work")
    shutil.copy(tmp_path / "empty" / "a.png", tmp_path / "empty" / "b.png")
    with pytest.raises(InputError, match="holds 1 image and copies; a map needs at least 3"):
        map_images(tmp_path / "empty", tmp_path / "work")
    with pytest.raises(InputError, match="has 1 image with a pose"):
        map_images(tmp_path / "empty", tmp_path / "work", model.subset([0]))
    blind = model.replace(points=Points(), point_observations=PointObservations())
    with pytest.raises(InputError, match=r"None of the .* images of the model is in"):
        map_images(tmp_path / "empty", tmp_path / "work", blind)  # poses alone will do; other photographs will not
    for wrong, said in (("NOPE", r"one of SIMPLE_PINHOLE, .*got 'NOPE'"), ("BAL", "got 'BAL'")):
        with pytest.raises(InputError, match=said):
            PointModelOptions(wrong)
    with pytest.raises(InputError, match=r"4 parameters \(fx, fy, cx, cy\); got 2"):
        PointModelOptions("PINHOLE", (1.0, 2.0))
    assert not (tmp_path / "work").exists()


def test_wrong_size_and_unreadable_images_are_refused(tmp_path, model):
    folder = write_images(tmp_path / "small", model, (100, 100))
    rest = f"Of {model.num_images} images {model.num_images - 1} more cannot be used: {model.images.names[1]}"
    with pytest.raises(InputError, match=rf"100x100 pixels, its camera 1024x768\..*{rest}"):  # all are named at once
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
    few = replace(result, num_photographs=29).diagnose()  # most were not placed: that is what the report begins with
    assert few.sentences[0].startswith("25 of 29 photographs were not placed. All findings are about the other 4.")
    assert not any("is determined" in sentence for sentence in few.sentences)
    assert any("is determined" in sentence for sentence in replace(result, num_photographs=5).diagnose().sentences)


def test_calibrations_that_nobody_gave_are_estimated_in_the_end(tmp_path):
    guessed = near_the_middle(holistic(10, seed=2).start.points_only())
    folder = write_images(tmp_path / "plain", guessed)
    for number, (model, refine) in enumerate(
        ((guessed, None), (guessed, False), (guessed.replace(principal_point_priors=PrincipalPointPriors()), None))
    ):
        found = map_images(folder, tmp_path / str(number), model, MapOptions(refine_intrinsics=refine, threads=1))
        is_estimated = number == 0
        numbers = found.summary()
        assert numbers["estimated"] == {"poses": True, "intrinsics": is_estimated}
        assert (found.scene.cameras.params != model.cameras.params).all() == is_estimated
        assert found.pose_uncertainty()["calibration"] == ("none" if is_estimated else "all")
        assert len(found.scene.principal_point_priors) == len(model.principal_point_priors)


def test_images_of_one_colour_without_a_model(tmp_path, model):
    folder = write_images(tmp_path / "plain", model, (60, 80))
    with pytest.raises(InputError, match="0 points were found in them and 0 matches between them"):
        map_images(folder, tmp_path / "work")


# ---------------------------------------------------------------------------------------------------- finished stages


def test_a_model_with_two_images_of_one_name_is_refused(tmp_path, model):
    names = list(model.images.names)
    names[1] = names[0]
    twice = model.replace(images=model.images.replace(names=tuple(names)))
    with pytest.raises(InputError, match=f"more than one image named {names[0]!r}"):
        check_names(tmp_path, sorted(set(names)), twice)


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
@pytest.mark.slow
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
    known, told = result.scene.lines.confidence, ours["line_confidence"]
    assert len(known) > 20 and known.min() >= MapOptions().min_confidence == 0.5
    assert told["expected_right"] == pytest.approx(known.sum())
    assert told["lines_by_tenth"][:5] == [0] * 5 and sum(told["lines_by_tenth"]) == len(known)
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
    assert run(with_params) == 1 and "--camera-params acts only on images without a model" in capsys.readouterr().err
