# SPDX-License-Identifier: BSD-3-Clause
"""The stages that are announced before a map begins are those that it goes through, in this order."""

import pytest

from groma.mapping.map import map_images
from groma.mapping.options import MapOptions
from groma.mapping.plan import planned_stages


@pytest.mark.parametrize(
    "options",
    [MapOptions(), MapOptions(find_planes=False, refine_poses=False, refine_points=True)],
    ids=["usual", "points refined, poses held"],
)
def test_the_stages_of_a_map_from_a_model(tmp_path, corner, options):
    images, model = corner
    stages = []

    def note(name, done, total):
        if not stages or stages[-1] != name:
            stages.append(name)

    map_images(images, tmp_path / "work", model, options, note)
    planned, at = list(planned_stages(options, "model")), -1
    for name in stages:  # a further round goes back, and no stage is unknown or comes too early
        at = planned.index(name, at + 1) if name in planned[at + 1 :] else planned.index(name)
    assert stages[-1] == planned[-1] == "adjusting everything"
    assert set(stages) == set(planned)


@pytest.mark.parametrize(
    ("start", "named"), [("photographs", "placing cameras"), ("poses", "placing points at the poses"), ("model", None)]
)
def test_what_a_map_begins_with_changes_its_first_stages(start, named):
    stages = planned_stages(MapOptions(), start, surveyed=True, given_segments=True)
    assert stages[0] == "checking images"
    assert (named in stages) == (named is not None)
    assert "adjusting with measurements" in stages and "reading segments" in stages
    assert "finding segments" not in stages


def test_a_rolling_shutter_adds_an_adjustment_with_motions():
    stages = planned_stages(MapOptions(rolling_shutter="rows"))
    assert "adjusting points and motions" in stages and "adjusting points" not in stages
    assert stages[-1] == "adjusting with motions"
