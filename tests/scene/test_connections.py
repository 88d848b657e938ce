# SPDX-License-Identifier: BSD-3-Clause
"""Which images hang together: two scenes side by side, and what joins them."""

from dataclasses import fields

import numpy as np

from groma.cli.main import run
from groma.io import read_scene, write_scene
from groma.scene import PointObservations, Relations, Scene, synthetic
from groma.scene.connections import connected_images


def side_by_side(first: Scene, second: Scene) -> Scene:
    """Two scenes as one, without anything in common."""
    moves = {item.name: len(getattr(first, item.name)) for item in fields(first)}
    tables = {}
    for item in fields(first):
        one, two = getattr(first, item.name), getattr(second, item.name)
        columns = {}
        for column in fields(one):
            a, b = getattr(one, column.name), getattr(two, column.name)
            refers = column.metadata["refers"]
            if isinstance(a, tuple):
                columns[column.name] = a + tuple(f"second_{word}" if column.name == "names" else word for word in b)
                continue
            shift = [moves[name] for name in refers] if refers else 10_000 * column.name.endswith("ids")
            if (item.name, column.name) == ("sensors", "camera_idx"):
                shift = moves["cameras"]
            columns[column.name] = np.concatenate([a, b + np.array(shift, b.dtype)]) if len(b) else a
        tables[item.name] = type(one)(**columns)
    return Scene(**tables)


def two() -> Scene:
    parts = [synthetic.holistic(count, seed=count).start.points_only() for count in (6, 5)]
    return side_by_side(*parts)


def test_groups_and_what_joins_them():
    scene = two()
    assert [group.tolist() for group in connected_images(scene)] == [list(range(6)), list(range(6, 11))]
    seen = scene.point_observations
    bridge = PointObservations([10], [0], [[5.0, 5.0]], [10_000])
    joined = scene.replace(
        point_observations=PointObservations(
            *(np.concatenate([getattr(seen, item.name), getattr(bridge, item.name)]) for item in fields(seen))
        )
    )
    assert len(connected_images(joined)) == 1
    planes = synthetic.holistic(6, seed=0).truth.planes.take([0])
    last = scene.num_points - 1
    tied = scene.replace(planes=planes, relations=Relations([[0, 0], [last, 0]]))
    assert len(connected_images(tied)) == 1
    assert connected_images(Scene()) == []


def test_covariances_of_two_groups_are_explained(tmp_path, capsys):
    write_scene(two(), tmp_path / "two.npz")
    arguments = ["adjust", str(tmp_path / "two.npz"), "-o", str(tmp_path / "out.npz")]
    assert run([*arguments, "--covariance", str(tmp_path / "c.npz")]) == 0
    said = capsys.readouterr().err
    assert "warning: " in said and "fall into 2 groups" in said
    assert "6 images (" in said and "5 images (second_" in said and "diagnose(problem)" not in said
    assert not (tmp_path / "c.npz").exists() and read_scene(tmp_path / "out.npz").num_images == 11
