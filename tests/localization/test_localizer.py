# SPDX-License-Identifier: BSD-3-Clause
"""Photographs in a map: the embedded cabinet, by motion capture poses; from Python and from the command line."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from threadpoolctl import threadpool_limits
from worlds import QUERIES, cabinet_in

from groma.cli.main import run
from groma.errors import InputError
from groma.evaluation import cabinet
from groma.execution import work_with
from groma.features.contract import ImageRetrieval
from groma.geometry import quaternion, so3
from groma.io import read_scene, write_scene
from groma.localization.features import find_corners, find_points, mirrored, unit
from groma.localization.localizer import LocalizeOptions, Localizer, check_photographs
from groma.localization.map_index import read_index
from groma.localization.matching import match_descriptors
from groma.localization.pose.camera import QueryCamera
from groma.localization.pose.hypotheses import max_errors
from groma.localization.pose.refinement import fitted
from groma.localization.pose.verdict import Verdict, doubted_if_mirrored
from groma.localization.retrieval import VladRetrieval
from groma.localization.run import localize_images, query_files


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder with a map of some frames, their images, and the others as queries."""
    return cabinet_in(tmp_path_factory.mktemp("cabinet"))


@pytest.fixture(scope="module")
def localizer(place):
    """The map, described."""
    return Localizer(place / "map.npz", place / "images")


@pytest.fixture
def opencv_threads():
    """Set the number of threads of OpenCV, and restore it."""
    before = cv2.getNumThreads()
    yield cv2.setNumThreads
    cv2.setNumThreads(before)


def _errors(found, truth, name):
    row = list(truth.images.names).index(name)
    R, R_true = (quaternion.to_matrix(pose[None, :4])[0] for pose in (found.cam_from_world, truth.cam_from_world[row]))
    angle = np.rad2deg(np.linalg.norm(so3.log((R @ R_true.T)[None])[0]))
    return np.linalg.norm(found.center - truth.cam_centers_in_world[row]), angle


def test_frames_between_those_of_the_map_are_placed(place, localizer):
    truth = read_scene(cabinet.folder() / "model")
    found = {name: localizer.localize(place / "queries" / name).pose for name in QUERIES}
    right = {name: pose for name, pose in found.items() if pose.status == "localized"}
    assert len(right) >= 4
    size = np.median(np.linalg.norm(truth.points.xyz - truth.points.xyz.mean(axis=0), axis=1))
    for name, pose in right.items():
        distance, angle = _errors(pose, truth, name)
        assert distance < 0.1 * size, name
        assert angle < 4.0, name


def test_poses_are_as_uncertain_as_the_map_is_wrong(place, localizer):
    """The part of the map's error grows with it, and does not fall below it however many matches there are."""
    name = sorted(QUERIES)[0]
    found = localizer.localize(place / "queries" / name).pose
    plain = replace(found.matches, shared_error=0.0)
    fit = fitted(found.camera, plain, found.cam_from_world, max_errors(plain))
    noise = fit.covariance(plain)
    for wrong in (1e-3, 1e-2):
        grown = fit.covariance(replace(plain, shared_error=wrong)) - noise
        assert np.linalg.eigvalsh(grown).min() > 0.0
        # One match in each of at most 48 cells, each off by so much: no axis is known better than by their mean.
        assert np.sqrt(np.linalg.eigvalsh(grown[3:, 3:]).min()) > wrong / np.sqrt(2.0 * 48.0)
    assert found.matches.shared_error == localizer.index.shared_error[int(len(found.line_inliers) > 0)]


def test_arrays_and_files_are_alike(place, localizer):
    path = place / "queries" / QUERIES[3]
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    first, second = localizer.localize(path).pose, localizer.localize(image).pose
    assert first.status == second.status == "localized"
    assert np.array_equal(first.cam_from_world, second.cam_from_world)


@pytest.mark.parametrize(
    ("of_points", "lines"),
    [
        ({"status": "localized"}, False),
        ({"status": "uncertain"}, True),
        ({"status": "uncertain", "contradicted": True}, False),
        ({"status": "failed"}, True),
    ],
)
def test_lines_are_matched_where_points_do_not_decide(place, localizer, monkeypatch, of_points, lines):
    """The map has no lines; those that are matched, and what is said of the place, are given."""
    some = localizer.localize(place / "queries" / QUERIES[0]).pose
    said = [replace(some, status="failed"), replace(some, **of_points), replace(some, status="localized")]
    matched = []

    def pose(self, query, part, camera, options, images, found, *rest):
        matched.append(found)
        return said[len(matched) - 1], found

    monkeypatch.setattr(Localizer, "_pose", pose)
    monkeypatch.setattr("groma.localization.localizer.lines_alike", lambda *given: np.zeros((1, 2), np.int64))
    found = localizer.localize(place / "queries" / QUERIES[0]).pose
    assert found is said[1 + lines]
    assert [len(one.lines) > 0 for one in matched] == [False, False, *[True] * lines]
    if lines:
        assert np.array_equal(matched[1].points, matched[2].points)


@pytest.mark.parametrize(("settled", "times"), [(True, 1), (False, 2)])
def test_all_is_matched_only_where_it_may_change_what_is_said(place, localizer, monkeypatch, settled, times):
    some = localizer.localize(place / "queries" / QUERIES[0]).pose
    said = [replace(some, status="uncertain", settled=settled), replace(some, status="localized")]
    matched = []

    def pose(self, query, part, camera, options, images, found, *rest):
        matched.append(part)
        return said[len(matched) - 1], found

    monkeypatch.setattr(Localizer, "_pose", pose)
    assert localizer.localize(place / "queries" / QUERIES[0]).pose is said[times - 1]
    assert len(matched) == times


def test_a_calibration_of_the_map_that_does_not_fit_is_estimated(place, localizer, monkeypatch):
    query = place / "queries" / QUERIES[0]
    some, said = localizer.localize(query).pose, {}
    said[False] = replace(some, status="uncertain", settled=True, other_focal=True)
    monkeypatch.setattr(Localizer, "_pose", lambda *given: (said[given[4].refine_lens], given[6]))
    for said[True] in (some, replace(some, status="uncertain")):
        found = localizer.localize(query).pose
        assert (found is not said[False]) == ("calibration was estimated" in found.sentence) == (said[True] is some)
        assert localizer.localize(query, some.camera).pose is said[False]  # it was given


@pytest.mark.parametrize("estimated", [(True, False), (False, False)])
def test_the_bits_do_not_depend_on_the_number_of_threads(place, tmp_path, opencv_threads, estimated):
    """Of the index and of poses; poses of the map estimated, or held, whose noise is estimated, too."""
    scene = read_scene(place / "map.npz").subset(range(5))
    bits = []
    for threads in (1, 2):
        opencv_threads(threads)
        with work_with(threads), threadpool_limits(threads):
            index = tmp_path / f"{threads}.npz"
            localizer = Localizer(scene, place / "images", index, LocalizeOptions(estimated=estimated))
            poses = [localizer.localize(place / "queries" / name).pose for name in QUERIES[:1]]
        with np.load(index) as file:
            bits.append({name: file[name].tobytes() for name in file.files})
        for name, pose in zip(QUERIES, poses, strict=False):
            assert pose.cam_from_world is not None
            bits[-1][name] = pose.cam_from_world.tobytes() + pose.covariance.tobytes() + pose.sentence.encode()
    assert bits[0] == bits[1]


def test_what_is_not_in_the_map_is_not_found(place, localizer):
    rng = np.random.default_rng(0)
    image = cv2.imread(str(place / "queries" / QUERIES[3]), cv2.IMREAD_GRAYSCALE)
    nothing = {
        "black": np.zeros_like(image),
        "grey": np.full_like(image, 128),
        "noise": rng.integers(0, 256, image.shape, dtype=np.uint8),
        "shuffled": np.ascontiguousarray(
            rng.permutation(image.reshape(12, 40, 16, 40).swapaxes(1, 2).reshape(-1, 40, 40))
            .reshape(12, 16, 40, 40).swapaxes(1, 2).reshape(image.shape)
        ),
    }  # fmt: skip
    for name, picture in nothing.items():
        assert localizer.localize(picture).pose.status != "localized", name


def test_mirrored_photographs_of_the_place_are_not_localized(place, localizer):
    for name in QUERIES[::2]:
        image = cv2.imread(str(place / "queries" / name), cv2.IMREAD_GRAYSCALE)
        assert localizer.localize(np.ascontiguousarray(image[:, ::-1])).pose.status != "localized", name


def test_photographs_in_shuffled_pieces_are_not_localized(place, localizer):
    rng = np.random.default_rng(1)
    for name in QUERIES[1::2]:
        image = cv2.imread(str(place / "queries" / name), cv2.IMREAD_GRAYSCALE)
        blocks = rng.permutation(image.reshape(3, 160, 4, 160).swapaxes(1, 2).reshape(-1, 160, 160))
        shuffled = np.ascontiguousarray(blocks.reshape(3, 4, 160, 160).swapaxes(1, 2).reshape(image.shape))
        assert localizer.localize(shuffled).pose.status != "localized", name


def test_a_photograph_of_which_one_part_shows_the_place_is_doubted(place, localizer):
    """Its left and right thirds are those of another photograph, as wrong a place as can be for what is seen there."""
    image, other = (
        cv2.imread(str(place / "queries" / name), cv2.IMREAD_GRAYSCALE) for name in (QUERIES[3], QUERIES[0])
    )
    assert localizer.localize(image).pose.status == "localized"
    pieced = other.copy()
    pieced[160:320, 160:480] = image[160:320, 160:480]
    assert localizer.localize(pieced).pose.status != "localized"


def test_the_mirror_image_of_descriptors_is_that_of_the_image(place):
    image = cv2.imread(str(place / "queries" / QUERIES[3]), cv2.IMREAD_GRAYSCALE)
    flipped = np.ascontiguousarray(image[:, ::-1])
    for find in (find_points, find_corners):
        straight, back = find(image), mirrored(find(flipped), image.shape[1])
        pairs = match_descriptors(unit(straight.descriptors), unit(back.descriptors))
        apart = np.linalg.norm(straight.pixels[pairs[:, 0]] - back.pixels[pairs[:, 1]], axis=1)
        assert np.mean(apart < 2.0) > 0.9
        assert len(pairs) > 0.7 * len(straight)


def test_photographs_whose_mirror_image_has_more_of_the_most_alike_matches_are_doubted():
    right = Verdict("localized", 1.0, "all agree.")
    assert doubted_if_mirrored(right, 10, 20).status == "uncertain"
    assert "mirror" in doubted_if_mirrored(right, 10, 20).sentence
    # What is symmetric fits both ways, and most photographs are not mirrored.
    assert doubted_if_mirrored(right, 20, 10) is right
    assert doubted_if_mirrored(right, 0, 0) is right


def test_the_index_is_kept_and_made_anew_for_another_map(place, localizer):
    path = place / "map.npz.index.npz"
    before = path.stat().st_mtime_ns
    again = Localizer(place / "map.npz")  # the images are where they were
    assert path.stat().st_mtime_ns == before
    assert np.array_equal(again.index.xyz, localizer.index.xyz)
    assert np.array_equal(again.index.shared_error, localizer.index.shared_error)
    assert read_index(path, "of another map") is None
    other = place / "damaged.npz"
    other.write_bytes(path.read_bytes()[:5000])
    assert read_index(other, "any") is None


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("point", lambda array: array + 10**6),
        ("begin", lambda array: array[::-1].copy()),
        ("pixel", lambda array: array[:-1]),
        ("xyz", lambda array: np.full_like(array, np.nan)),
        ("descriptor", lambda array: array.astype(float)),
        ("image", lambda array: array[:, :5]),
        ("digest", lambda array: np.array(3.5)),
    ],
)
def test_an_index_whose_arrays_do_not_fit_is_made_anew(place, localizer, tmp_path, name, value):
    with np.load(place / "map.npz.index.npz") as file:
        arrays = dict(file)
    digest = str(arrays["digest"])
    np.savez(tmp_path / "index.npz", **arrays)
    assert read_index(tmp_path / "index.npz", digest).is_of(localizer.scene)
    np.savez(tmp_path / "index.npz", **{**arrays, name: value(arrays[name])})
    assert read_index(tmp_path / "index.npz", digest) is None


def test_an_index_beside_nothing_that_can_be_written_is_not_kept(place, monkeypatch):
    from groma.errors import OutputError
    from groma.localization import map_index

    def refuse(*_):
        raise OutputError("Cannot write it.")

    monkeypatch.setattr(map_index.MapIndex, "write", refuse)
    scene = read_scene(place / "map.npz").subset(range(3))
    found = Localizer(scene, place / "images", index=place / "nowhere.npz")
    assert "cannot be written" in found.warning


def test_retrieval_keeps_its_contract(place):
    images = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted((place / "images").iterdir())[:4]]
    retrieval = VladRetrieval.learned([find_points(image).descriptors for image in images])
    assert isinstance(retrieval, ImageRetrieval)
    described = [retrieval.describe(image) for image in images]
    for row, one in enumerate(described):
        assert np.argmax(retrieval.similarity(one, described)) == row
    assert np.isfinite(retrieval.similarity(retrieval.describe(np.zeros((60, 80), np.uint8)), described)).all()


def test_maps_and_images_that_do_not_fit_are_refused(place, tmp_path):
    with pytest.raises(InputError, match="--images"):
        Localizer(place / "map.npz", place / "queries")
    with pytest.raises(InputError, match="--images"):
        Localizer(read_scene(place / "map.npz"))
    camera = QueryCamera("PINHOLE", np.array([500.0, 500.0, 160.0, 120.0]), 320, 240)
    with pytest.raises(InputError, match="pixels"):
        Localizer(place / "map.npz", place / "images").localize(place / "queries" / QUERIES[0], camera)


def test_photographs_of_several_sequences_are_where_the_summary_says(place, tmp_path):
    scene, sources = read_scene(place / "map.npz").subset([0, 1]), []
    write_scene(scene, tmp_path / "map")
    with pytest.raises(InputError, match="is unknown"):
        check_photographs(tmp_path / "map")
    for number, name in enumerate(scene.images.names):  # one name in both sequences
        (tmp_path / f"{number}" / "rgb").mkdir(parents=True)
        shutil.copy(place / "images" / name, tmp_path / f"{number}" / "rgb" / "frame.jpg")
        sources.append({"path": str(tmp_path / f"{number}"), "images": {name: "frame.jpg"}})
    (tmp_path / "map" / "summary.json").write_text(json.dumps({"sources": sources}))
    check_photographs(tmp_path / "map")
    assert Localizer(tmp_path / "map").files == [tmp_path / f"{one}" / "rgb" / "frame.jpg" for one in range(2)]
    (tmp_path / "1" / "rgb" / "frame.jpg").unlink()
    with pytest.raises(InputError, match="are not in"):
        Localizer(tmp_path / "map")


def test_command(place, localizer, tmp_path, capsys):
    queries = tmp_path / "queries"
    shutil.copytree(place / "queries", queries)
    (queries / "bad.jpg").write_text("no image")
    cv2.imwrite(str(queries / "black.png"), np.zeros((480, 640), np.uint8))
    out = tmp_path / "out"
    assert (
        run(["localize", str(place / "map.npz"), str(queries), "-o", str(out), "--images", str(place / "images")]) == 0
    )
    assert "localized" in capsys.readouterr().out
    told = json.loads((out / "localized.json").read_text())
    assert sorted(told) == sorted([*QUERIES, "bad.jpg", "black.png"])
    keys = {
        "status", "qvec", "tvec", "center", "center_sigma", "rotation_sigma_deg", "num_point_inliers",
        "num_line_inliers", "feature_seconds", "seconds", "sentence", "shared_error_deg", "probability",
    }  # fmt: skip
    assert all(set(entry) == keys for entry in told.values())
    assert told["bad.jpg"]["status"] == told["black.png"]["status"] == "failed"
    right = [name for name, entry in told.items() if entry["status"] == "localized"]
    rows = [line.split() for line in (out / "poses.txt").read_text().splitlines()]
    assert [row[0] for row in rows] == right
    alone = localize_images(localizer, query_files([place / "queries"]), tmp_path / "alone")  # without workers
    assert [one.to_dict()["qvec"] for one in alone] == [told[name]["qvec"] for name in QUERIES]
    for name, *numbers in rows:
        assert [float(number) for number in numbers] == told[name]["qvec"] + told[name]["tvec"]
    model = read_scene(out)
    assert set(right) <= set(model.images.names)
    image = list(model.images.names).index(right[0])
    assert model.cam_centers_in_world[image] == pytest.approx(told[right[0]]["center"], abs=1e-6)
    page = (out / "report.html").read_text()
    assert f'<td class="words">{told["black.png"]["sentence"]}' in page
    assert f'<td data-name="rotation">{told[right[0]]["rotation_sigma_deg"]:.2g}°</td>' in page
    assert not out.with_name("out.work").exists()


def test_an_interrupted_run_goes_on(place, tmp_path, monkeypatch, capsys):
    from groma.localization import localizer as module

    arguments = ["localize", str(place / "map.npz"), str(place / "queries"), "-o", str(tmp_path / "out")]
    arguments += ["--images", str(place / "images"), "--no-lines"]
    calls, really = [], module.Localizer.localize

    def counting(self, *given, **more):
        calls.append(1)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return really(self, *given, **more)

    monkeypatch.setattr(module.Localizer, "localize", counting)
    assert run(arguments) == 130
    assert "resumes there" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert run(arguments) == 0
    assert len(calls) == 1 + len(QUERIES)  # two were finished, one was begun twice


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--camera-model", "PINHOLE"], "belong together"),
        (["--camera-model", "PINHOLE", "--camera-params", "1,2"], "has 4 parameters"),
        (["--calibration", "magic"], "must be one of"),
    ],
)
def test_wrong_options_end_in_one_line(place, tmp_path, more, words, capsys):
    assert run(["localize", str(place / "map.npz"), str(place / "queries"), "-o", str(tmp_path / "out"), *more]) == 1
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1


def test_queries_that_are_not_there_and_bad_maps_end_in_one_line(place, tmp_path, capsys):
    empty, broken = tmp_path / "empty", tmp_path / "broken.npz"
    empty.mkdir()
    broken.write_bytes(b"not a scene")
    for map_, queries in ((place / "map.npz", empty), (place / "map.npz", tmp_path / "none"), (broken, empty)):
        assert run(["localize", str(map_), str(queries), "-o", str(tmp_path / "out")]) == 1
        assert capsys.readouterr().err.count("\n") == 1


def test_options_without_lines_use_none(place):
    found = Localizer(place / "map.npz", place / "images", options=LocalizeOptions(lines=False))
    pose = found.localize(place / "queries" / QUERIES[3]).pose
    assert pose.status == "localized"
    assert not pose.line_inliers.any()
