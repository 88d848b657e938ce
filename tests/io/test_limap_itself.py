# SPDX-License-Identifier: BSD-3-Clause
"""LIMAP 2 itself reads the structures that groma writes, and the other way round.

It runs where LIMAP can be imported, or where the environment variable GROMA_LIMAP_PYTHON names a Python that can.
"""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from _comparison import near
from _limap import LIMAP_PYTHON, through_limap
from _models import rig_scene

from groma.io import read_scene, write_colmap
from groma.io.limap.structures import read_limap, write_limap
from groma.scene import Scene
from groma.scene.synthetic.scenes import holistic

DATA = Path(__file__).parents[1] / "data" / "limap"

pytestmark = pytest.mark.skipif(not LIMAP_PYTHON, reason="needs pylimap 2.0 (or GROMA_LIMAP_PYTHON)")


@pytest.mark.parametrize("form", ["binary", "text"])
@pytest.mark.parametrize("scene", ["rig", "holistic"])
def test_limap_reads_what_groma_writes_and_back(tmp_path, form, scene):
    scene = rig_scene() if scene == "rig" else holistic(15, seed=2).truth
    write_colmap(scene, tmp_path / "groma", form)
    told = through_limap(tmp_path / "groma", tmp_path / f"limap_{form}")
    made = read_limap(tmp_path / "groma")
    assert told["valid"]
    assert told["images"] == scene.images.ids.tolist()
    for row, number in enumerate(scene.lines.ids.tolist()):
        assert told["lines"][str(number)] == scene.lines.segments[row].ravel().tolist()
        one = made.lines.track[made.lines.start[row] : made.lines.start[row + 1]].tolist()
        assert [tuple(pair) for pair in told["tracks"][str(number)]] == one
    for image in made.images:
        assert told["segments"][str(image.image_id)] == image.lines["ends"].tolist()
        if form == "binary":
            assert told["owners"][str(image.image_id)] == image.lines["line_id"].tolist()
        assert [group[3] for group in told["flat"][str(image.image_id)]] == [group.group_id for group in image.groups]
    for group in made.groups:
        kind, params, points, lines, track = told["groups"][str(group.id)]
        assert kind == ("PLANE" if group.kind == 1 else "VP")
        np.testing.assert_allclose(params, group.params, rtol=1e-15, atol=1e-16)
        assert (points, lines) == (group.points["id"].tolist(), group.lines["id"].tolist())
        assert [tuple(pair) for pair in track] == group.track.tolist()
    assert [tuple(edge) for edge in told["edges"]] == sorted(made.wireframe.tolist())
    # LIMAP's copy, read by groma: exact in binary, six digits in text.
    back = _sorted(read_scene(tmp_path / f"limap_{form}"))
    if (tmp_path / "groma" / "structures" / "groma.npz").exists():
        shutil.copy(tmp_path / "groma" / "structures" / "groma.npz", tmp_path / f"limap_{form}" / "structures")
        back = _sorted(read_scene(tmp_path / f"limap_{form}"))
    result = near(_sorted(read_scene(tmp_path / "groma")), back, 1e-12 if form == "binary" else 2e-4)
    assert result, result.reason


def _sorted(scene: Scene) -> Scene:
    pairs = scene.relations.point_on_line
    order = np.lexsort((pairs[:, 1], pairs[:, 0]))
    return scene.replace(relations=replace(scene.relations, point_on_line=pairs[order]))


def test_files_of_limap_survive_groma(tmp_path):
    """LIMAP's files, read and written by groma, with and without a scene in between, read and written by LIMAP."""
    before = through_limap(DATA / "binary", tmp_path / "a_binary")
    shutil.copytree(DATA / "binary", tmp_path / "copy")
    structures = read_limap(DATA / "binary")
    write_limap(structures, tmp_path / "copy" / "structures", force=True)
    assert through_limap(tmp_path / "copy", tmp_path / "b_binary") == before
    write_colmap(read_scene(DATA / "binary"), tmp_path / "scene", like=structures)
    after = through_limap(tmp_path / "scene", tmp_path / "c_binary")
    for told in (before, after):  # image 3 has no pose and is not in the scene
        for name in ("segments", "owners", "flat"):
            told[name].pop("3", None)
        told["images"] = [number for number in told["images"] if number != 3]
        told["tracks"] = {k: [pair for pair in v if pair[0] != 3] for k, v in told["tracks"].items()}
    assert after == before
