"""From photographs to a map: what is refused, resuming, and a real church front."""

import cv2
import numpy as np
import pytest

from groma.errors import InputError
from groma.evaluation.poses import evaluate_poses
from groma.io import read_scene
from groma.pipelines import map as mapping
from groma.pipelines.map import MapOptions, map_images
from groma.scene.synthetic import holistic


@pytest.fixture
def model():
    return holistic(4, seed=0).start.points_only()


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
    with pytest.raises(InputError, match="at least 3"):
        map_images(tmp_path / "empty", tmp_path / "work")


def test_wrong_size_and_unreadable_images_are_refused(tmp_path, model):
    folder = write_images(tmp_path / "small", model, (100, 100))
    with pytest.raises(InputError, match=r"100x100 pixels, its camera 1024x768"):
        map_images(folder, tmp_path / "work", model)
    (folder / model.images.names[0]).write_bytes(b"not an image")
    with pytest.raises(InputError, match="cannot be read as an image"):
        map_images(folder, tmp_path / "work", model)


def test_black_images_give_an_explained_empty_map(tmp_path, model):
    folder = write_images(tmp_path / "black", model)
    result = map_images(folder, tmp_path / "work", model)
    assert result.scene.num_lines == 0
    assert any("No line was mapped" in sentence for sentence in result.warnings)


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
    monkeypatch.setattr(mapping, "_detect", lambda *arguments: pytest.fail("segments were searched again"))
    again = map_images(folder / "images", tmp_path / "work", start, MapOptions())
    np.testing.assert_array_equal(again.scene.lines.plucker, scene.lines.plucker)
    np.testing.assert_array_equal(again.scene.frames.rig_from_world, scene.frames.rig_from_world)
