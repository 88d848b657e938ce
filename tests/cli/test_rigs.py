# SPDX-License-Identifier: BSD-3-Clause
"""``groma map`` with cameras on rigs: where the file is found, what is said, what excludes each other."""

import json

import pytest

from groma.cli.main import run
from groma.cli.shared import mapping
from groma.errors import InputError


@pytest.fixture
def photographs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for camera in ("left", "right"):
        (tmp_path / "images" / camera).mkdir(parents=True)
        for number in range(3):
            (tmp_path / "images" / camera / f"{number}.png").touch()
    cameras = [
        {"image_prefix": "left/", "ref_sensor": True},
        {"image_prefix": "right/", "cam_from_rig_rotation": [1, 0, 0, 0], "cam_from_rig_translation": [0, 0, 1]},
    ]
    return json.dumps([{"cameras": cameras}])


@pytest.fixture
def asked(monkeypatch):
    """The options that photographs would have been mapped with."""
    options = []

    def asked(console, images, work, start, wanted, *others):
        options.append(wanted)
        raise InputError("enough")

    monkeypatch.setattr(mapping, "run_map", asked)
    return options


def test_a_rig_is_found_in_the_folder_or_passed(tmp_path, photographs, asked, capsys):
    assert run(["map", "images", "-o", "out"]) == 1
    assert asked[-1].rigs == () and "rig" not in capsys.readouterr().out
    assert run(["map", "images", "--refine-rig", "-o", "out"]) == 1
    assert "--refine-rig acts only with --rig" in capsys.readouterr().err and len(asked) == 1
    (tmp_path / "other.json").write_text(photographs)
    assert run(["map", "images", "--rig", "other.json", "--refine-rig", "-o", "out"]) == 1
    assert len(asked[-1].rigs[0].cameras) == 2 and asked[-1].refine_rigs
    assert "Cameras on rigs by other.json. 1 rig: 3 frames of several images." in capsys.readouterr().out
    (tmp_path / "images" / "rig_config.json").write_text(photographs)
    assert run(["map", "images", "-o", "out"]) == 1
    assert len(asked[-1].rigs) == 1 and not asked[-1].refine_rigs
    assert "Found in the folder: cameras on rigs" in capsys.readouterr().out


def test_the_shortest_segment_is_that_of_detector_and_lines(photographs, asked):
    """Segments shorter than usual were detected and not used; longer ones were expected where none was looked for."""
    for length in (8.0, 30.0):
        assert run(["map", "images", "-o", "out", "--min-length", str(length)]) == 1
        assert asked[-1].min_segment_length == asked[-1].lines.min_length == length


def test_a_model_has_its_own_rigs(tmp_path, photographs, asked, capsys):
    (tmp_path / "images" / "rig_config.json").write_text(photographs)
    arguments = ["map", "images", "--model", "images", "-o", "out"]
    assert run([*arguments, "--rig", "images/rig_config.json"]) == 1
    assert "a model has its own rigs" in capsys.readouterr().err
    assert asked == []
