# SPDX-License-Identifier: BSD-3-Clause
"""Write a corridor scene for the contestants: ``make_corridor.py points|points_lines SIZE FOLDER``.

``points``: a BAL file, focal lengths 1 % too long. ``points_lines``: an archive for groma, the same as text for the
Ceres program, whose head describes it, and as a COLMAP model with lines beside it for LIMAP. SIZE is a name or a number
of images.
"""

from __future__ import annotations

import io
import os
import sys
from pathlib import Path

import numpy as np

from groma.geometry import quaternion
from groma.io import write_archive, write_bal, write_scene
from groma.scene import Scene, synthetic


def write_text(scene: Scene, path: Path) -> None:
    """Write cameras, points and lines for ``ceres_points_lines``."""
    points, lines = scene.point_observations, scene.line_observations
    poses = scene.cam_from_world
    focal, _, center_x, center_y = scene.cameras.params_of(0)
    text = io.StringIO()
    text.write(f"{len(poses)} {scene.num_points} {scene.num_lines} {len(points)} {len(lines)} ")
    text.write(f"{float(focal)!r} {float(center_x)!r} {float(center_y)!r}\n")
    for table in (np.hstack([quaternion.log(poses[:, :4]), poses[:, 4:]]), scene.points.xyz, scene.lines.segments):
        np.savetxt(text, table.reshape(len(table), -1), fmt="%.17g")
    np.savetxt(text, np.column_stack([points.image_idx, points.point_idx, points.pixel]), fmt="%d %d %.17g %.17g")
    rows = np.column_stack([lines.image_idx, lines.line_idx, lines.segment])
    np.savetxt(text, rows, fmt="%d %d %.17g %.17g %.17g %.17g")
    path.write_text(text.getvalue())


def main() -> None:
    kind, size, folder = sys.argv[1:]
    start = synthetic.corridor(int(size) if size.isdigit() else size).start
    name = Path(folder) / f"corridor_{size}_{kind}"
    draft = name.with_suffix(".draft.npz")
    if kind == "points":
        start = start.points_only()
        draft = name.with_suffix(".draft.txt")
        write_bal(start.with_params(start.cameras.params * [1.01, 1.01, 1, 1]), draft, force=True)
        os.replace(draft, name.with_suffix(".txt"))
        return
    write_text(start, name.with_suffix(".txt"))
    write_scene(start, name, format="colmap", force=True)
    write_archive(start, draft, force=True)
    os.replace(draft, name.with_suffix(".npz"))


if __name__ == "__main__":
    main()
