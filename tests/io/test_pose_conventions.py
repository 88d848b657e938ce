# SPDX-License-Identifier: BSD-3-Clause
"""The table of how files hold poses: each row against the axes of a camera written down by its words, help and docs."""

import inspect
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groma.cli.commands.map import map_
from groma.geometry import quaternion
from groma.io.pose_conventions import NAMED, POSE_CONVENTIONS
from groma.io.survey import rows

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("convention", POSE_CONVENTIONS, ids=lambda one: one.name.split(":")[0])
def test_a_camera_written_by_the_words_of_the_table(convention):
    """Rows of the file's rotation are the file's camera axes in the world, or columns, and nothing else is needed."""
    right, down, forward = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    center, point = np.array([3.0, -2.0, 5.0]), np.array([1.0, 7.0, -4.0])
    axes = np.array({
        "ours": [right, down, forward], "OpenGL": [right, -down, -forward], "LLFF": [down, right, -forward]
    }[convention.axes])  # fmt: skip
    matrix = axes if convention.direction == "cam_from_world" else axes.T
    is_shift = convention.place == "shift" and convention.direction == "cam_from_world"
    place = -axes @ center if is_shift else center
    x, y, z, w = Rotation.from_matrix(matrix).as_quat()
    written = {
        "matrix": matrix,
        "axis and angle": Rotation.from_matrix(matrix).as_rotvec(),
        "qx qy qz qw": [x, y, z, w],
        "qw qx qy qz": [w, x, y, z],
    }[convention.rotation]
    pose = convention.cam_from_world(np.array([written]), place[None])
    seen = quaternion.rotate(pose[:, :4], point[None])[0] + pose[0, 4:]
    np.testing.assert_allclose(seen, np.array([right, down, forward]) @ (point - center), atol=1e-12)


def test_help_and_documentation_quote_the_table():
    line = NAMED.name.removeprefix("lines ")
    helped = str(inspect.signature(map_).parameters["poses"].annotation.__metadata__[0].help)
    assert line in helped and line in rows.__doc__
    for page in ("formats.md", "measurements.md", "poses.md"):
        assert line in (DOCS / page).read_text(encoding="utf-8"), page
    assert "```{pose-conventions}" in (DOCS / "formats.md").read_text(encoding="utf-8")
    assert '"_pose_conventions"' in (DOCS / "conf.py").read_text(encoding="utf-8")
